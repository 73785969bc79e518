"""Convert the error that ended a measurement to status and reason."""

from __future__ import annotations

from typing import Any

from harness.experiments.failure import build_failure_columns
from harness.reference.minimiser import UncertifiedError
from harness.reference.motion import NotIntegrable
from harness.reference.self_converged import NotConverged
from harness.reference.trajectory import UnpredictableMotion


class TimeLimitExceeded(Exception):
    """Simulation that reached its time limit; the message states its last frame."""


_STATUS_OF_ERROR: dict[type[Exception], str] = {
    TimeLimitExceeded: "time-limit",
    UncertifiedError: "uncertified",
    NotIntegrable: "uncertified",
    UnpredictableMotion: "uncertified",
    NotConverged: "uncertified",
}


def build_accuracy_failure_columns(error: Exception) -> dict[str, Any]:
    """Return the status and the reason of a measurement that ended with an error."""
    told = build_failure_columns(error)
    reason = str(error) if type(error) in _STATUS_OF_ERROR else told["reason"]
    return {"status": _STATUS_OF_ERROR.get(type(error), told["status"]), "reason": reason}

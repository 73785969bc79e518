"""Convert the error that ended a measurement to status and reason."""

from __future__ import annotations

from typing import Any

from springbench.harness.experiments.failure_columns import build_failure_columns
from springbench.harness.reference.certified_minimum import UncertifiedError
from springbench.harness.reference.equations_of_motion import NotIntegrable
from springbench.harness.reference.reference_trajectory import UnpredictableMotion
from springbench.harness.reference.self_converged_trajectory import NotConverged


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
    columns = build_failure_columns(error)
    reason = str(error) if type(error) in _STATUS_OF_ERROR else columns["reason"]
    return {"status": _STATUS_OF_ERROR.get(type(error), columns["status"]), "reason": reason}

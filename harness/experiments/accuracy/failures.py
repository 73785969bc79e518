"""Convert the error that ended a measurement to status and reason."""

from __future__ import annotations

from typing import Any

from harness.experiments.failure import failure
from harness.reference.minimiser import Uncertified
from harness.reference.motion import Unintegrable
from harness.reference.self_converged import NotConverged
from harness.reference.trajectory import Unpredictable


class OverTime(Exception):
    """Simulation that reached its time limit; the message states its last frame."""


_STATUS: dict[type[Exception], str] = {
    OverTime: "time-limit",
    Uncertified: "uncertified",
    Unintegrable: "uncertified",
    Unpredictable: "uncertified",
    NotConverged: "uncertified",
}


def lost(error: Exception) -> dict[str, Any]:
    """Return the status and the reason of a measurement that ended with an error."""
    told = failure(error)
    reason = str(error) if type(error) in _STATUS else told["reason"]
    return {"status": _STATUS.get(type(error), told["status"]), "reason": reason}

"""Verification status of a finished run: the result of the independent reference implementation.

The result depends on the scene and not on the solver. It is therefore computed once for all runs of a scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

from harness.config.sweep import RunSpec
from harness.scenes.bind import build
from harness.simulation.opinion.second import DISAGREES, second_opinion
from solvers.plugins import Plugin

SINGLE = "single opinion: the integrator comes from outside, and its formula is written once"


@dataclass(frozen=True, slots=True)
class _Formulas:
    """Cache key: a run's scene and other settings that determine its formulas."""

    key: tuple[str | int, ...]
    run: RunSpec = field(compare=False)


def standing(run: RunSpec) -> dict[str, str]:
    """Return the columns `status`, `second_opinion` and `reason` of a finished run that is verified.

    Columns that do not apply are left out.
    """
    if isinstance(run.integrator, Plugin):
        return {"status": "ok", "second_opinion": SINGLE}
    said = opinion(_Formulas((run.scene.digest, run.size, run.integrator), run))
    if said.startswith(DISAGREES):
        return {"status": "disputed", "second_opinion": said, "reason": f"the second opinion {said}"}
    return {"status": "ok", "second_opinion": said}


@lru_cache(maxsize=32)
def opinion(formulas: _Formulas) -> str:
    """Return the verification result for a run's scene, at its size and with its integrator."""
    run = formulas.run
    return second_opinion(run.scene, build(run.scene, run.size, run.integrator), run.integrator)

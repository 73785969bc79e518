"""How a run that was done stands: by what a second opinion says of its steps, where the run is judged.

The opinion is about a scene and not about a solver, so it is asked once for all that are run on it.
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
    """A run's scene, and what else determines how its steps are stated; two of one key are the same."""

    key: tuple[str | int, ...]
    run: RunSpec = field(compare=False)


def standing(run: RunSpec) -> dict[str, str]:
    """The columns `status`, `second_opinion` and `reason` of a run that was done and judged, as far as it has them."""
    if isinstance(run.integrator, Plugin):
        return {"status": "ok", "second_opinion": SINGLE}
    said = opinion(_Formulas((run.scene.digest, run.size, run.integrator), run))
    if said.startswith(DISAGREES):
        return {"status": "disputed", "second_opinion": said, "reason": f"the second opinion {said}"}
    return {"status": "ok", "second_opinion": said}


@lru_cache(maxsize=32)
def opinion(formulas: _Formulas) -> str:
    """The second opinion of a run's scene, at its size and with its integrator."""
    run = formulas.run
    return second_opinion(run.scene, build(run.scene, run.size, run.integrator), run.integrator)

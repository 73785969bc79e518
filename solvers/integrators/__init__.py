"""Time integrators by name: `single` has those of one unknown a step, the others are tableaux of unknowns (`base`)."""

from __future__ import annotations

from solvers.integrators.alpha import GENERALISED_ALPHA, HHT, NEWMARK, GeneralisedAlpha
from solvers.integrators.base import End, Motion, Solved, Unknown
from solvers.integrators.runge_kutta import ESDIRK3, ESDIRK4, SDIRK2, SDIRK3, SDIRK4, TR_BDF2, RungeKutta
from solvers.integrators.single import BDF2, IMPLICIT_EULER, MIDPOINT, OWN, Integrator
from solvers.plugins import Table, load

__all__ = [
    "EVERY",
    "IMPLICIT_EULER",
    "INTEGRATORS",
    "OWN",
    "AnyIntegrator",
    "End",
    "GeneralisedAlpha",
    "Integrator",
    "Motion",
    "RungeKutta",
    "Solved",
    "Staged",
    "Unknown",
    "find",
    "splits",
]

Staged = RungeKutta | GeneralisedAlpha
"""Those of one step and one unknown or more, with all forces where the unknown is.

order: of the error; unknowns: in a step; factor: c; speed: rate dt; starts: whether the acceleration at the
step's start is needed; embedded: the order of the method that the error is told by, 0 for none; step: the unknowns,
one by one.
"""

AnyIntegrator = Integrator | Staged

INTEGRATORS: dict[str, AnyIntegrator] = {
    "implicit-euler": IMPLICIT_EULER,
    "bdf2": BDF2,
    "midpoint": MIDPOINT,
    "generalised-alpha": GENERALISED_ALPHA,
    "hht": HHT,
    "newmark": NEWMARK,
    "sdirk-2": SDIRK2,
    "tr-bdf2": TR_BDF2,
    "sdirk-3": SDIRK3,
    "esdirk-3": ESDIRK3,
    "sdirk-4": SDIRK4,
    "esdirk-4": ESDIRK4,
    "own": OWN,
}
"""The shipped integrators by name."""

EVERY = Table("springbench.integrators", INTEGRATORS)
"""All that a config can name."""


def splits(method: AnyIntegrator) -> bool:
    """Whether filters of the velocity act before a step; an integrator that takes forces where they act has none."""
    return isinstance(method, Integrator) and method.splits


def find(name: str) -> AnyIntegrator:
    """The integrator of a name, which may be somebody's own."""
    return INTEGRATORS[name] if name in INTEGRATORS else load(EVERY[name])

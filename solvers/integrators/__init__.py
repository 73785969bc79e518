"""Time integrators by name: `single_stage` has those with one stage per step, the others have tableaux of stages."""

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
"""The one-step integrators with one or more stages that evaluate all forces at the stage.

Common attributes are order (of the error), unknowns (per step), factor (c), speed (rate
times dt), starts (whether the acceleration at the start of the step is needed), embedded (order
of the embedded method for the error estimate, 0 for none) and step (a generator of the stages).
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
"""The built-in integrators by name."""

EVERY = Table("springbench.integrators", INTEGRATORS)
"""All integrators that a config can name."""


def splits(method: AnyIntegrator) -> bool:
    """Return whether velocity filters act before a step.

    An integrator that evaluates forces at the stage has none.
    """
    return isinstance(method, Integrator) and method.splits


def find(name: str) -> AnyIntegrator:
    """Return the integrator of a name, which may be a third-party one."""
    return INTEGRATORS[name] if name in INTEGRATORS else load(EVERY[name])

"""Time integrators by name: single-stage, generalised-alpha and implicit Runge-Kutta methods."""

from __future__ import annotations

from springbench.solvers.model.integrators.generalised_alpha import GENERALISED_ALPHA, HHT, NEWMARK, GeneralisedAlpha
from springbench.solvers.model.integrators.implicit_runge_kutta import (
    ESDIRK3,
    ESDIRK4,
    SDIRK2,
    SDIRK3,
    SDIRK4,
    TR_BDF2,
    RungeKutta,
)
from springbench.solvers.model.integrators.integrator_stages import Motion, Stage, StageSolution, StepEnd
from springbench.solvers.model.integrators.single_stage import (
    BDF2,
    IMPLICIT_EULER,
    MIDPOINT,
    SUBSTEPPING,
    SingleStageIntegrator,
)
from springbench.solvers.plugins.plugin_discovery import PluginTable, load_target

__all__ = [
    "IMPLICIT_EULER",
    "INTEGRATORS",
    "INTEGRATOR_TABLE",
    "SUBSTEPPING",
    "AnyIntegrator",
    "GeneralisedAlpha",
    "Motion",
    "RungeKutta",
    "SingleStageIntegrator",
    "Stage",
    "StageSolution",
    "StagedIntegrator",
    "StepEnd",
    "find_integrator",
    "has_split_filters",
]

StagedIntegrator = RungeKutta | GeneralisedAlpha
"""The one-step integrators that evaluate all forces at their stages.

Common attributes are order (of the error), num_stages (per step), inertia_factor (c), velocity_factor (velocity_rate
times dt), needs_start_acceleration (whether the acceleration at the start of the step is needed), embedded_order (order
of the embedded method for the error estimate, 0 for none) and iterate_stages (a generator of the stages).
"""

AnyIntegrator = SingleStageIntegrator | StagedIntegrator
"""An integrator: an object of `SingleStageIntegrator`, `RungeKutta` or `GeneralisedAlpha`, or of a subclass.

A config names it, such as `./mine.py:MY_METHOD`.
"""

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
    "substepping": SUBSTEPPING,
}
"""The built-in integrators by name."""

INTEGRATOR_TABLE = PluginTable("springbench.integrators", INTEGRATORS)
"""All integrators that a config can name."""


def has_split_filters(method: AnyIntegrator) -> bool:
    """Return whether velocity filters act before a step.

    An integrator that evaluates forces at the stage has none.
    """
    return isinstance(method, SingleStageIntegrator) and method.has_split_filters


def find_integrator(name: str) -> AnyIntegrator:
    """Return the integrator of a name, which may be a third-party one.

    Example:
        >>> springbench.find_integrator("midpoint").inertia_factor
        4.0
    """
    return INTEGRATORS[name] if name in INTEGRATORS else load_target(INTEGRATOR_TABLE[name])

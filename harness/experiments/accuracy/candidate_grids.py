"""Grids of solvers and settings that a recommendation tries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import product
from typing import Any, get_args, get_type_hints

from springbench.harness.errors import InputError, InputMistake, format_allowed_names
from springbench.harness.experiments.accuracy.recommendation_goal import RecommendationGoal
from springbench.harness.reference.self_converged_trajectory import LIMIT_INTEGRATORS
from springbench.solvers.iteration.solver_info import LOCAL_GLOBAL_FAMILY
from springbench.solvers.registry import (
    OPTIONAL_SOLVERS,
    SOLVER_TABLE,
    SOLVERS,
    find_solver_info,
    is_engine,
    is_minimiser,
    load_target,
)

TIME_STEP_REFINEMENTS = (0.5, 1, 2, 4, 8)
"""Numbers of steps up to the horizon, relative to those at the scene's own time step."""

FIXED_ITERATIONS, FEWER_ITERATIONS = 50, [2, 5, 10, 20]
"""Iterations of methods without a tolerance; smaller numbers that are also tried where a wall time is given."""

ENGINE_SUBSTEPS = [1, 2, 4, 8, 16, 32, 64, 128]
"""Substeps of outside engines in a frame."""

ENGINE_ITERATIONS = [1, 4, 16]
"""Iterations of outside engines in a substep, of those that iterate."""

CANDIDATE_INTEGRATORS = ["implicit-euler", "bdf2", "midpoint", "sdirk-4"]
"""Integrators to try: one of each order and kind."""


def build_candidate_grid() -> list[dict[str, Any]]:
    """Return the grid that is measured where no rows exist.

    The first solver of each family runs with steps solved to a tolerance, or with 50 iterations or substeps. All
    adaptive solvers with their own integrator are included.
    """
    made = {name: load_target(target) for name, target in SOLVERS.items()}
    infos = {name: find_solver_info(solver, name) for name, solver in made.items()}
    own = [name for name, of in infos.items() if of.is_substepping and of.supports_error_control]
    first = {name: made[name] for name, of in infos.items() if of.is_family_default}
    implicit = [name for name, solver in first.items() if is_minimiser(solver)]
    fixed = [
        name for name, solver in first.items() if not is_minimiser(solver) or infos[name].family == LOCAL_GLOBAL_FAMILY
    ]
    return [  # solvers with the fewest kernels first, because their cost limits the time of all others
        {"solver": own, "max_iterations": 1, "integrator": ["substepping"]},
        {"solver": fixed, "max_iterations": FIXED_ITERATIONS},
        {"solver": implicit, "rtol": [1e-1, 1e-2, 1e-3], "max_iterations": 500, "integrator": CANDIDATE_INTEGRATORS},
    ]


def build_solver_grid(name: str) -> list[dict[str, Any]]:
    """Return the grid of one solver or outside engine.

    Args:
        name: its name.

    Raises:
        InputError: there is no solver of this name.
    """
    solver = _load_solver(name)
    info = find_solver_info(solver, name)
    if is_engine(solver):
        return [{"solver": [name], "max_iterations": ENGINE_SUBSTEPS, "integrator": [find_engine_integrator(solver)]}]
    if info.is_substepping and info.supports_error_control:
        return [{"solver": [name], "max_iterations": 1, "integrator": ["substepping"]}]
    fixed = {"solver": [name], "max_iterations": [*FEWER_ITERATIONS, FIXED_ITERATIONS]}
    if not is_minimiser(solver):
        return [fixed]
    solved = {"rtol": [1e-1, 1e-2, 1e-3], "max_iterations": 500}
    return [{"solver": [name], "integrator": CANDIDATE_INTEGRATORS, **solved}, fixed]


def list_solver_variants(name: str) -> list[dict[str, Any]]:
    """Return the sets of parameters with which a solver is tried.

    Parameters of outside engines vary; other solvers have their defaults.
    """
    solver = _load_solver(name)
    values: dict[str, Sequence[Any]] = {}
    for parameter in fields(solver) if is_engine(solver) else ():
        if parameter.name == "iterations_per_substep":
            values[parameter.name] = sorted({*ENGINE_ITERATIONS, parameter.default})
        elif parameter.name in ("mujoco_integrator", "newton_solver"):
            values[parameter.name] = get_args(get_type_hints(solver)[parameter.name])
    return [{"name": name, **dict(zip(values, chosen, strict=True))} for chosen in product(*values.values())]


def find_engine_integrator(solver: Any) -> str:
    """Return the name of the integrator with which an engine steps frames.

    It is `substepping` if the engine supports damping. Otherwise it is `implicit-euler`, whose damping acts before each
    frame.
    """
    return "substepping" if solver.supports_damping else "implicit-euler"


def _load_solver(name: str) -> Any:
    known = [*SOLVERS, *OPTIONAL_SOLVERS]
    if name not in known:
        raise InputError(InputMistake(f"got {name!r}; expected {format_allowed_names(name, known)}", key="--engine"))
    return load_target(SOLVER_TABLE[name])


@dataclass(frozen=True, slots=True)
class StudyCandidates:
    """Solvers of a study with their parameters, its grid, and refinements of the time step."""

    solvers: Sequence[dict[str, Any]]
    grid: Sequence[dict[str, Any]]
    refinements: Sequence[float]

    @classmethod
    def from_goal(cls, goal: RecommendationGoal, engine: str | None) -> StudyCandidates:
        """Return the candidates for a goal.

        Args:
            goal: limit of the error or of the wall time; with the latter, no step is longer than a frame.
            engine: name of the only solver or engine to consider; None for all.

        Raises:
            InputError: there is no solver or engine of this name.
        """
        refinements = [
            one for one in TIME_STEP_REFINEMENTS if one >= 1 or goal.max_error is not None
        ]  # a frame at most
        if engine:
            refinements = [1] if is_engine(_load_solver(engine)) else refinements
            return cls(list_solver_variants(engine), build_solver_grid(engine), refinements)
        grid = build_candidate_grid()
        if goal.max_error is None:
            fixed = [entry for entry in grid if entry["max_iterations"] == FIXED_ITERATIONS]
            grid += [{**entry, "max_iterations": FEWER_ITERATIONS} for entry in fixed]
        names = dict.fromkeys(name for entry in grid for name in entry["solver"])
        return cls([{"name": name} for name in names], grid, refinements)

    def restrict_to_contact(self) -> StudyCandidates:
        """Return the minimising solvers with integrators that support contact; all candidates if there are none."""
        grid = list[dict[str, Any]]()
        for entry in self.grid:
            names = [name for name in entry["solver"] if is_minimiser(_load_solver(name))]
            integrators = [one for one in entry.get("integrator", ["implicit-euler"]) if one in LIMIT_INTEGRATORS]
            grid += [{**entry, "solver": names, "integrator": integrators}] if names and integrators else []
        known = {name for entry in grid for name in entry["solver"]}
        solvers = [one for one in self.solvers if one["name"] in known]
        return StudyCandidates(solvers, grid, self.refinements) if solvers else self

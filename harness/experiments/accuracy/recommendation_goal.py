"""Goal of a recommendation, and the measured methods that it selects from."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from springbench.harness.config.accuracy_config import WorkSpec
from springbench.harness.config.shipped_configs import get_config_name
from springbench.solvers.registry import SOLVER_TABLE, find_solver_info, is_engine, load_target

BUDGET_REFERENCE_ERROR = 1e-3
"""Relative error that the reference must resolve where a wall time is given: a percent suffices there."""

CONTACT_BUDGET_ERROR = 0.02
"""BUDGET_REFERENCE_ERROR with contact: errors at a frame's time step are some percent, and references less accurate."""


@dataclass(frozen=True, slots=True)
class RecommendationGoal:
    """Limit on a method's error or wall time; one of them is given.

    Attributes:
        max_error: relative error at the end.
        frame_seconds: wall time [s] of a frame, which is a time step of the scene.
        budget_error: relative error that the reference must resolve where a wall time is given.
    """

    max_error: float | None = None
    frame_seconds: float | None = None
    budget_error: float = BUDGET_REFERENCE_ERROR

    @property
    def reference_error(self) -> float:
        """Relative error that the reference must resolve."""
        return self.budget_error if self.max_error is None else self.max_error

    def loosen_for_contact(self) -> RecommendationGoal:
        """Return the goal for a scene with contact, whose reference resolves larger errors only."""
        return replace(self, budget_error=CONTACT_BUDGET_ERROR)

    def select_methods(
        self, methods: Sequence[MeasuredMethod], frame: float, factor: float = 1.0
    ) -> list[MeasuredMethod]:
        """Return the methods within the goal's limit, the best one first.

        Args:
            methods: measured methods, the cheapest first.
            frame: time step of the scene [s].
            factor: multiple of the wall time.
        """
        if self.frame_seconds is None:
            return [method for method in methods if method.error <= self.reference_error]
        limit = factor * self.frame_seconds / frame
        within = [method for method in methods if method.seconds_per_simulated_second <= limit]
        return sorted(within, key=lambda method: method.error)


@dataclass(frozen=True, slots=True)
class MeasuredMethod:
    """Method that was measured on the scene.

    Attributes:
        work_spec: the simulation.
        error: relative error.
        seconds_per_simulated_second: wall time per simulated second.
        reference_kind: kind of the reference solution for the error.
        solver_description: what the solver selected automatically.
        sweep: name of the study that measured it.
    """

    work_spec: WorkSpec
    error: float
    seconds_per_simulated_second: float
    reference_kind: str
    solver_description: str
    sweep: str = ""

    def __str__(self) -> str:
        u = self.work_spec
        solver = load_target(SOLVER_TABLE[u.solver.name])
        if is_engine(solver):
            chosen = "".join(f", {key} {value}" for key, value in u.solver.parameters.items() if key != "device")
            substeps = f"{u.options['max_iterations']} substeps a frame"
            return f"{u.solver.name}{chosen}, {substeps} of {u.case.scene.time_step:.6g} s"
        if find_solver_info(solver, u.solver.name).is_substepping:
            return f"solver {u.solver.name}, {self.solver_description}, in each frame of {u.case.scene.time_step:.6g} s"
        tolerance = u.options["rtol"]
        stop = f"{u.options['max_iterations']} iterations" if tolerance is None else f"tolerance {tolerance:g}"
        return f"{u.case.integrator}, time step {u.case.scene.time_step:.6g} s, {stop}, solver {u.solver.name}"

    @property
    def kind(self) -> tuple[object, ...]:
        """Solver, integrator and parameters, which identify the method at any setting."""
        spec = self.work_spec
        return spec.solver.name, spec.case.integrator, *sorted(spec.solver.parameters.items())

    def format_command(self, scene: Path) -> str:
        """Return the command line for this method; empty where the solver's parameters need a sweep."""
        u, made = self.work_spec, load_target(SOLVER_TABLE[self.work_spec.solver.name])
        if made(**u.solver.parameters) != made():
            return ""
        steps = round(u.t_end / u.case.scene.time_step)
        given: dict[str, Any] = {"size": u.case.size or None, "solver": u.solver.name, "integrator": u.case.integrator}
        given |= {"time-step": repr(u.case.scene.time_step), "frames": steps, **u.options}
        named_values = ((name.replace("_", "-"), value) for name, value in given.items() if value is not None)
        options = (part for name, value in named_values for part in (f"--{name}", str(value)))
        return shlex.join(["springbench", "run", get_config_name(scene), *options])

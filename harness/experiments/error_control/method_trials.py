"""Trials of methods at one setting, and the result of a search among them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.harness.experiments.error_control.candidate_methods import Method
from springbench.harness.reference.reference_trajectory import compute_position_error
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.adaptive_stepping import StepObserver, Trajectory
from springbench.harness.simulation.energy_balance import (
    EnergyGain,
    EnergyGrowth,
    FrameDissipation,
    StepDissipation,
    compute_frame_balances,
)
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Run of a method at one setting.

    Attributes:
        method: the method.
        setting: setting of its stepper.
        trajectory: the computed motion.
        error_estimated: estimated relative error.
        order: order at which the error decreases with the step size: that of the method, or less if two settings show
            it.
    """

    method: Method
    setting: float
    trajectory: Trajectory
    error_estimated: float
    order: float

    @property
    def step_atol(self) -> float | None:
        """Tolerance on the local error [m]; None for fixed step sizes."""
        return None if self.method.stepper.has_fixed_step else self.setting

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of this trial, common to several tables."""
        return {
            "integrator": self.method.integrator,
            "error_estimated": self.error_estimated,
            "step_atol_m": self.step_atol,
            "num_accepted_steps": self.trajectory.num_accepted_steps,
            "num_rejected_steps": self.trajectory.num_rejected_steps,
            "num_factorisations": self.trajectory.num_factorisations,
        }

    def rerun_trial(self, observe: StepObserver | None = None) -> Trajectory:
        """Run the method again at the same setting; `observe` is called after each step."""
        return self.method.stepper.integrate_motion(self.setting, observe=observe)

    def measure_dissipation(self, frame_seconds: float) -> dict[int, StepDissipation]:
        """Measure the dissipation of each frame from the method's own steps, in another run."""
        found = FrameDissipation(frame_seconds)
        self.rerun_trial(found.add_step)
        return found.by_frame


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Result of a search.

    Attributes:
        best_trial: cheapest trial that meets the error.
        trials: first trials of all methods with the CPU seconds predicted for the target error, cheapest first.
        step_atol: tolerance of the first trials [m].
        reference_trial: trial from which errors are estimated.
        search_seconds: wall time of everything except the best trial.
        note: why the best trial is much more accurate than requested; empty otherwise.
    """

    best_trial: Trial
    trials: tuple[tuple[Trial, float], ...]
    step_atol: float
    reference_trial: Trial
    search_seconds: float
    note: str

    def compute_balances(self, scene: Scene) -> dict[int, EnergyGain]:
        """Return the energy balance after each frame, by frame.

        Args:
            scene: the scene with the integrator `substepping`, whose time step is a frame.
        """
        path = self.best_trial.trajectory
        motions = map(Motion, path.positions[1:], path.velocities[1:])
        return dict(enumerate(compute_frame_balances(scene, motions), start=1))

    def build_status_columns(self, balances: Mapping[int, EnergyGain]) -> dict[str, str | None]:
        """Return `status` and `reason` of the best trial.

        The status is `energy-growth` if the energy has grown without a source.
        """
        if growth := EnergyGrowth.from_balances(balances):
            reason = f"{growth}: {self.best_trial.method} does not follow the motion; use a smaller error"
            return {"status": "energy-growth", "reason": reason}
        return {"status": "ok", "reason": self.note or None}

    def compute_error(self, p: Positions, free_vertices: NDArray[np.int64]) -> float:
        """Return the error of end positions against the reference trial.

        The error is relative to the displacement and taken over the free vertices.

        Args:
            p: positions at the end (n, 3) [m].
            free_vertices: indices of the vertices that count.
        """
        q = self.reference_trial.trajectory.positions
        away, moved = (compute_position_error(x, q[-1], free_vertices) for x in (p, q[0]))
        return away / moved

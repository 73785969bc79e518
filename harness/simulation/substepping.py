"""Time stepping to an error tolerance by a solver with substeps within frames (`is_substepping`).

The substeps are adaptive, or have a fixed size: the largest stable one or a smaller one.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, inf
from time import perf_counter, thread_time
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.adaptive_stepping import (
    StepObserver,
    Stepper,
    StepSizeUnderflow,
    Trajectory,
    build_budget_error,
    share_frame_seconds,
)
from springbench.harness.simulation.time_loop import (
    MotionState,
    build_initial_state,
    build_integrated_step,
    build_problem,
)
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, Unsupported

_CALL_SECONDS = 1e-3
"""Wall time [s] of a call that integrates several frames; the call itself takes 30 us."""


class _SubsteppingSolver(Protocol):
    """A prepared solver with substeps."""

    @property
    def order(self) -> int:
        """The order of convergence of the error."""
        ...

    @property
    def num_evaluations(self) -> int:
        """The number of force evaluations in a step."""
        ...

    @property
    def num_factorisations(self) -> int:
        """The number of factorisations in a tried step, 0 for explicit methods."""
        ...

    def integrate_frames(
        self, problem: StepProblem, num_frames: int = 1, h: float | None = None
    ) -> tuple[tuple[Positions, Positions], NDArray[np.float64]]:
        """Integrate frames with the same external force and pin targets.

        Args:
            problem: step problem of the first frame.
            num_frames: largest number of frames.
            h: first step size [s].

        Returns:
            Positions [m] and velocities [m/s] at the ends of k frames, at least one, each (k, n, 3), and (k, 4): the
            number of accepted steps, that of rejected steps, the size of the last step [s] and the length of the
            frame [s].

        Raises:
            RuntimeError: the first frame cannot be finished.
        """
        ...


@runtime_checkable
class AdaptiveSubstepping(_SubsteppingSolver, Protocol):
    """A solver with adaptive steps within a frame."""

    def with_tolerance(self, tolerance: float) -> AdaptiveSubstepping:
        """Return the solver with an error tolerance [m] of each step.

        Raises:
            Unsupported: the method has no error estimate.
        """
        ...


@runtime_checkable
class FixedSubstepping(_SubsteppingSolver, Protocol):
    """A solver with fixed steps within a frame, of the largest stable size."""

    def with_refined_substeps(self, refinement_factor: float) -> FixedSubstepping:
        """Return the solver with the number of steps multiplied by a factor."""
        ...


@dataclass(frozen=True, eq=False)
class _Substepper(Stepper):
    """Stepping by a solver with substeps within frames.

    The step of the scene is a frame, and its integrator is `substepping`.
    """

    scene: Scene
    solver: Solver
    frames: int

    @property
    def order(self) -> int:
        """The order of convergence of the solver."""
        return self._convergence_order

    @cached_property
    def _convergence_order(self) -> int:
        return self._prepare_pieces(1.0)[1].order

    def integrate_motion(
        self, setting: float, *, cpu_limit: float = inf, observe: StepObserver | None = None
    ) -> Trajectory:
        """Integrate the motion up to the end time.

        Args:
            setting: error tolerance [m] of each step or, with a fixed step size, number of steps relative to the
                smallest.
            cpu_limit: limit on the processor time [s] of this thread.
            observe: called after each frame or, where a frame is divided into pieces, after each piece.

        Raises:
            Unsupported: the solver does not support the scene or the setting, or quantities change within a frame where
                the error estimate would not detect it.
            TimeBudgetExceeded: the limit is exceeded.
            StepSizeUnderflow: the tolerance would need steps below the minimum step size.
        """
        cpu = thread_time()
        scene, ready, pieces = self._prepare_pieces(setting)
        state, began = build_initial_state(scene), perf_counter()
        motions, step_stats = [(state.motion.positions[None], state.motion.velocity[None])], list[NDArray[np.float64]]()
        reached, h, count, is_steady = list[float](), None, self.frames * pieces, observe is None and _is_steady(scene)
        while (k := state.index) < count:
            stated = build_problem(scene, state, "previous")
            wanted = min(count - k, _choose_num_frames(reached)) if is_steady else 1
            try:
                (p, v), each = ready.integrate_frames(stated, wanted, h)
            except RuntimeError as error:
                raise StepSizeUnderflow(
                    f"frame {k // pieces + 1}, after {scene.compute_time(k):.6g} s: {error}"
                ) from error
            step_stats.append(each)
            h, state = float(each[-1, 2]), MotionState(Motion(p[-1], v[-1]), None, k + len(each))
            if observe:
                observe(scene, build_integrated_step(stated, state), scene.compute_time(state.index))
            if state.index % pieces == 0:
                motions.append((p, v))
                reached += [perf_counter() - began] * len(each)
            if thread_time() - cpu > cpu_limit:
                raise build_budget_error(cpu_limit, scene.compute_time(state.index))
        accepted, rejected = (int(number) for number in np.concatenate(step_stats)[:, :2].sum(axis=0))
        evaluations = (accepted + rejected) * ready.num_evaluations
        mean = scene.system.time_step * count / accepted
        counts = accepted, rejected, (accepted + rejected) * ready.num_factorisations, evaluations
        positions, velocities = (np.concatenate(parts) for parts in zip(*motions, strict=True))
        shared, processor = share_frame_seconds(reached), thread_time() - cpu
        return Trajectory(positions, velocities, *counts, (mean, mean), reached[-1], shared, processor)

    @abstractmethod
    def _prepare_pieces(self, setting: float) -> tuple[Scene, _SubsteppingSolver, int]:
        """Return the scene, the prepared solver and the number of pieces of each frame."""


@dataclass(frozen=True, eq=False)
class AdaptiveSubstepper(_Substepper):
    """Stepping by a solver with adaptive substeps within frames."""

    def _prepare_pieces(self, setting: float) -> tuple[Scene, _SubsteppingSolver, int]:
        if changes := _list_time_dependence(self.scene):
            raise Unsupported(
                f"error estimates assume constant forces and pins within a frame; the scene has {' and '.join(changes)}"
            )
        ready = self.solver.prepare(self.scene.system)
        if not isinstance(ready, AdaptiveSubstepping):
            raise Unsupported(
                "the solver has no error estimate to select step sizes; expected a solver such as dormand-prince-8"
            )
        return self.scene, ready.with_tolerance(setting), 1


@dataclass(frozen=True, eq=False)
class FixedSubstepper(_Substepper):
    """Stepping by a solver with a fixed substep size.

    Quantities that change within a frame are taken as constant within each of a number of pieces, which is of order 1.
    `build_scene` builds the scene with a given step size [s].
    """

    build_scene: Callable[[float], Scene]

    has_fixed_step: ClassVar[bool] = True

    @cached_property
    def _convergence_order(self) -> int:
        return 1 if _list_time_dependence(self.scene) else self._prepare_pieces(1.0)[1].order

    def _prepare_pieces(self, setting: float) -> tuple[Scene, _SubsteppingSolver, int]:
        pieces = ceil(setting) if _list_time_dependence(self.scene) else 1
        scene = self.build_scene(self.scene.system.time_step / pieces) if pieces > 1 else self.scene
        ready = self.solver.prepare(scene.system)
        if not isinstance(ready, FixedSubstepping):
            raise Unsupported("the solver has no setting for the number of substeps in a frame")
        return scene, ready.with_refined_substeps(setting if pieces == 1 else 1.0), pieces


def _list_time_dependence(scene: Scene) -> list[str]:
    """List the quantities that substepping solvers take as constant within a frame although they change."""
    there = (
        ("forces that depend on position, velocity or time", scene.varying_forces),
        ("moving pins", scene.pin_motions),
    )
    return [what for what, some in there if some]


def _is_steady(scene: Scene) -> bool:
    """Return whether frames differ by their start only, with no velocity filter between them."""
    return not (_list_time_dependence(scene) or scene.velocity_filters)


def _choose_num_frames(reached: Sequence[float]) -> int:
    """Return the number of frames of the next call, given when earlier ones ended [s]."""
    return max(1, int(_CALL_SECONDS * len(reached) / reached[-1])) if reached else 1

"""Self-converged reference for scenes with contact: steps are halved until the motion no longer changes.

    |q_h(T) - q_(h/2)(T)| and |2 p_(h/2)(T) - p_h(T) - q_(h/2)(T)| <= CONTACT_MARGIN error |q(T) - p(0)|

Here p is the motion by implicit Euler, of order 1, whose limit Richardson extrapolation estimates, and q the one by
BDF2, which is the reference. Norms are Frobenius norms over the free vertices. Steps are solved by Newton's method; a
motion with a step that does not converge is not used. Contact has no equation of motion that could be integrated
instead. Its limit may depend on the integrator, which determines the restitution of an impact and the velocity that
lagged friction opposes. Where the limits differ, there is no reference. Half-spaces stiffen with 1/h^2, so that their
limit is a rigid contact; barriers retain the stiffness of the scene's own step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import thread_time

import numpy as np
from numpy.typing import NDArray
from springbench.harness.reference.reference_trajectory import (
    ReferenceTrajectory,
    UnpredictableMotion,
)
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state, prepare, simulate_scene
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.step_problem import Positions, StopRule, System

LIMIT_INTEGRATORS = ("implicit-euler", "bdf2")
"""Integrators that support contact."""
MAX_SECONDS = 60.0
"""Limit on the processor time [s] for a reference."""
SHORTEST_REFINEMENT = 0.5
"""Processor time [s] below which no motion is refined."""
TRIAL_SHARE = 0.6
"""Share of the remaining processor time for a motion, before one of a quarter of its length is tried."""
MAX_RELATIVE_ERROR = 0.05
"""Relative error for which a reference is always accurate enough, if MAX_SECONDS suffice."""
CONTACT_MARGIN = 0.3
"""Largest bound on the error of a reference, relative to an error that is measured by it; the bound is stated."""
SOLVED_STOP_RULE = StopRule(100, 1e-6)
"""Stop rule of the steps."""
_DISAGREEMENT_FACTOR = 4.0
"""Ratio of the distance between two limits to the last change by step halving above which the limits differ."""

SceneBuilder = Callable[[float, str], Scene]
"""Builds the scene from a step size [s] and the name of an integrator."""


class NotConverged(UnpredictableMotion):
    """The motion has no limit that is known as accurately as requested."""

    exit_code = 2


def has_contact(system: System) -> bool:
    """Return whether a system has contact, by half-spaces or by barriers."""
    return without_barriers(without_vertex_contact(system)) is not system


@dataclass(frozen=True, slots=True, eq=False)
class SelfConvergedTrajectory(ReferenceTrajectory):
    """Self-converged reference trajectory.

    Attributes:
        disagreement: difference (k,) of the two limits, or the last change of BDF2 by step halving, if larger.
        step: last step size [s].
        last_change: last change of either integrator by step halving, at the end, relative to the displacement.
    """

    step: float
    last_change: float

    @property
    def reference_kind(self) -> str:
        """The kind of the reference."""
        return "self-converged"

    @property
    def has_disagreement(self) -> bool:
        """Whether the integrators differ by more than step halving explains."""
        return float(self.disagreement[-1]) > _DISAGREEMENT_FACTOR * self.last_change

    def count_known_times(self, max_disagreement: float) -> int:
        """Return the number of times before the limits first disagree by more than `max_disagreement`."""
        return int(np.argmin(np.append(self.disagreement <= max_disagreement, False)))

    def find_last_known_time(self, max_disagreement: float) -> int | None:
        """Return the index of the last time at which the limits agree within `max_disagreement`.

        The result is None if there is no such time.
        """
        known = np.flatnonzero(self.disagreement <= max_disagreement)
        return int(known[-1]) if len(known) else None

    def select_times(self, chosen: slice) -> SelfConvergedTrajectory:
        """Return the trajectory at some of its times only."""
        arrays = ("times", "positions", "velocities", "displacement", "disagreement", "growth")
        return replace(self, **{name: getattr(self, name)[chosen] for name in arrays})

    def describe_uncertainty(self, k: int) -> str:
        """Describe how well the motion is known at times[k], and why no better."""
        why = (
            "the limits of implicit Euler and BDF2 differ, because impacts and friction depend on the integrator"
            if self.has_disagreement
            else f"halving the steps further takes more than {MAX_SECONDS:g} s"
        )
        return (
            f"after {self.times[k]:.4g} s the self-converged motion is accurate to {self.disagreement[k]:.1e} of the "
            f"displacement, with steps of {self.step:.2g} s; {why}"
        )

    def require_accuracy(self, error: float) -> None:
        """Raise NotConverged where a relative error cannot be measured at one of the times."""
        known = self.count_known_times(CONTACT_MARGIN * error)
        if known < len(self.times):
            least = float(self.disagreement[known]) / CONTACT_MARGIN
            can = (
                f"use an error of {least:.1g} or more, or a shorter horizon"
                if least < 1.0
                else "no error can be measured"
            )
            raise NotConverged(
                f"contact has no certified reference, and an error of {error:.1e} cannot be measured: "
                f"{self.describe_uncertainty(known)}; {can}"
            )


def compute_self_converged(
    bound: SceneBuilder, frame: float, times: Sequence[float], error: float, seconds: float = MAX_SECONDS
) -> SelfConvergedTrajectory:
    """Compute a self-converged motion at given times.

    Args:
        bound: builds the scene from a step size and an integrator.
        frame: approximate first step size [s].
        times: ascending times [s], each a multiple of the step size.
        error: smallest relative error to be measured, if that takes no longer than `seconds`.
        seconds: limit on the processor time [s].

    Raises:
        NotConverged: not even two step sizes could be compared.
    """
    steps, began = max(1, round(times[-1] / frame)), thread_time()
    before: dict[str, _SampledMotion] | None = None
    found: SelfConvergedTrajectory | None = None
    while True:
        motions = {
            name: _sample_motion(bound(times[-1] / steps, name), times, began + seconds) for name in LIMIT_INTEGRATORS
        }
        ends = {name: motion for name, motion in motions.items() if motion}
        if len(ends) < len(motions):
            break
        is_solved = all(motion.is_solved for motion in ends.values())
        if before and is_solved:
            found = _compare_motions(ends, before, times, times[-1] / steps)
            limit = CONTACT_MARGIN * min(error, MAX_RELATIVE_ERROR)
            if found.disagreement.max() <= limit or (found.has_disagreement and found.last_change <= limit):
                break
        before, steps = ends if is_solved else None, 2 * steps
    if found is None:
        raise NotConverged(
            f"contact has no certified reference, and two motions of solved steps take longer than {seconds:g} s; "
            "use a shorter horizon or a smaller size"
        )
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _SampledMotion:
    """A sampled motion.

    Attributes:
        free_vertices: indices of the free vertices.
        start_positions: positions at the start (n, 3) [m].
        positions: positions (k, n, 3) [m].
        velocities: velocities (k, n, 3) [m/s].
        is_solved: whether each step was solved to SOLVED_STOP_RULE, or to round-off.
    """

    free_vertices: NDArray[np.int64]
    start_positions: Positions
    positions: Positions
    velocities: Positions
    is_solved: bool


def _sample_motion(scene: Scene, times: Sequence[float], until: float) -> _SampledMotion | None:
    """Sample the motion at the given times; None if the time limit is exceeded."""
    h = scene.system.time_step
    step_numbers = [round(t / h) for t in times]
    if any(abs(k * h - t) > 1e-9 * times[-1] for k, t in zip(step_numbers, times, strict=True)):
        raise NotConverged("the times are no whole numbers of steps")
    samples: dict[int, tuple[Positions, Positions]] = {}
    is_solved = True
    run = simulate_scene(
        scene, prepare(scene, NewtonSolver()), SOLVED_STOP_RULE, initial_guess="previous", frames=step_numbers[-1]
    )
    for step in run:
        if not np.isfinite(step.positions).all():
            raise NotConverged(f"the motion is not finite from {step.index * h:.3g} s on")
        is_solved &= step.solution.termination_reason != "max-iter"
        if step.index in step_numbers:
            samples[step.index] = step.positions.copy(), step.state.motion.velocity.copy()
        if thread_time() > until and step.index < step_numbers[-1]:
            return None
    p, v = (np.array([samples[k][i] for k in step_numbers]) for i in (0, 1))
    return _SampledMotion(scene.system.free_vertices, build_initial_state(scene).motion.positions, p, v, is_solved)


def _compare_motions(
    now: dict[str, _SampledMotion], before: dict[str, _SampledMotion], times: Sequence[float], step: float
) -> SelfConvergedTrajectory:
    first, second = (now[name] for name in LIMIT_INTEGRATORS)
    free = second.free_vertices

    def size(x: Positions) -> NDArray[np.float64]:
        return np.linalg.norm(x[:, free], axis=(1, 2))

    moved = size(second.positions - second.start_positions)
    if not moved.all():
        raise NotConverged("nothing moves, and errors are relative to the displacement")
    halved = [size(now[name].positions - before[name].positions) for name in LIMIT_INTEGRATORS]
    extrapolated = 2.0 * first.positions - before[LIMIT_INTEGRATORS[0]].positions
    most = np.maximum(halved[1], size(extrapolated - second.positions)) / moved
    return SelfConvergedTrajectory(
        times=np.array(times, float),
        free_vertices=free,
        positions=second.positions,
        velocities=second.velocities,
        displacement=moved,
        disagreement=most,
        growth=np.zeros(len(times)),
        step=step,
        last_change=float(np.max(halved, axis=0)[-1] / moved[-1]),
    )


def describe_self_convergence(name: str) -> str:
    """Return the note that is shown for a scene with contact before anything is measured."""
    return (
        f"{name}: contact has no certified reference; errors are by a self-converged motion (implicit Euler and BDF2, "
        "steps halved until they agree), and rejected where that does not converge"
    )

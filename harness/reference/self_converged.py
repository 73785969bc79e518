"""Self-converged reference for scenes with contact: steps are halved until the motion no longer changes.

    |p_h(T) - p_(h/2)(T)| and |p(T) - q(T)| <= MARGIN error |q(T) - p(0)|

Here p is the motion by implicit Euler and q the one by BDF2. Norms are Frobenius norms over the free vertices; steps
are solved by Newton's method. Contact has no equation of motion that could be integrated instead, and its limit may
depend on the integrator, which determines the restitution of an impact and the velocity that lagged friction opposes.
Where the limits differ, there is no reference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import thread_time

import numpy as np
from numpy.typing import NDArray

from harness.reference.trajectory import MARGIN, Trajectory, Unpredictable
from harness.scenes.bind import Scene
from harness.simulation.step import prepare, simulate, start
from solvers.contact.touching import without_contact
from solvers.methods.newton import Newton
from solvers.problem import Positions, StopRule, System

INTEGRATORS = ("implicit-euler", "bdf2")
"""Integrators that support contact."""
SPENT = 60.0
"""Limit on the processor time [s] for a reference."""
LARGEST = 0.05
"""Relative error for which a reference is always accurate enough."""
_SOLVED = StopRule(100, 1e-6)
_APART = 4.0
"""Ratio of the distance between two limits to the last change by step halving above which the limits differ."""

Bound = Callable[[float, str], Scene]
"""Builds the scene from a step size [s] and the name of an integrator."""


class NotConverged(Unpredictable):
    """The motion has no limit that is known accurately enough."""


def touches(system: System) -> bool:
    """Return whether a system has contact."""
    return without_contact(system) is not system


@dataclass(frozen=True, slots=True, eq=False)
class SelfConverged(Trajectory):
    """Self-converged reference trajectory.

    Attributes:
      disagreement: difference (k,) of the two integrators, or the last change of either by step halving, if larger.
      step: last step size [s].
      moved_last: last change by step halving alone, at the end, relative to the displacement.
    """

    step: float
    moved_last: float

    @property
    def truth(self) -> str:
        """The kind of the reference."""
        return "self-converged"

    @property
    def differ(self) -> bool:
        """Whether the integrators differ by more than step halving explains."""
        return float(self.disagreement[-1]) > _APART * self.moved_last

    def require(self, error: float) -> None:
        """Raise NotConverged where a relative error cannot be measured at one of the times."""
        for t, apart in zip(self.times, self.disagreement, strict=True):
            if apart <= MARGIN * error:
                continue
            why = (
                "the limits of implicit Euler and BDF2 differ: what an impact gives back, and what friction acts "
                "against, depend on the integrator"
                if self.differ
                else f"halving the steps further takes more than {SPENT:g} s"
            )
            least = apart / MARGIN
            can = f"ask for an error of {least:.1g} or more, or a shorter horizon" if least < 1.0 else "none can be had"
            raise NotConverged(
                f"contact has no certified reference, and after {t:g} s its self-converged one is known to {apart:.1e} "
                f"of the displacement, by steps of {self.step:.2g} s: an error of {error:.1e} cannot be measured; "
                f"{why}; {can}"
            )


def converge(bound: Bound, frame: float, times: Sequence[float], error: float) -> SelfConverged:
    """Compute a self-converged motion at given times.

    Args:
      bound: builds the scene from a step size and an integrator.
      frame: approximate first step size [s].
      times: ascending times [s], each a multiple of the step size.
      error: smallest relative error to be measured, if that takes no longer than SPENT.

    Raises:
      NotConverged: not even two step sizes could be compared.
    """
    steps, began = max(1, round(times[-1] / frame)), thread_time()
    before: dict[str, _Motion] | None = None
    found: SelfConverged | None = None
    while True:
        motions = {name: _motion(bound(times[-1] / steps, name), times, began + SPENT) for name in INTEGRATORS}
        if any(motion is None for motion in motions.values()):
            break
        ends = {name: motion for name, motion in motions.items() if motion}
        if before:
            found = _compared(ends, before, times, times[-1] / steps)
            wanted = MARGIN * min(error, LARGEST)
            if found.disagreement.max() <= wanted or (found.differ and found.moved_last <= wanted):
                break
        before, steps = ends, 2 * steps
    if found is None:
        raise NotConverged(f"contact has no certified reference, and two motions take longer than {SPENT:g} s")
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """A sampled motion.

    Attributes:
      free: indices of the free vertices.
      begin: positions at the start (n, 3) [m].
      positions: positions (k, n, 3) [m].
      velocities: velocities (k, n, 3) [m/s].
    """

    free: NDArray[np.int64]
    begin: Positions
    positions: Positions
    velocities: Positions


def _motion(scene: Scene, times: Sequence[float], until: float) -> _Motion | None:
    """Sample the motion at the given times; None if the time limit is exceeded."""
    h = scene.system.time_step
    wanted = [round(t / h) for t in times]
    if any(abs(k * h - t) > 1e-9 * times[-1] for k, t in zip(wanted, times, strict=True)):
        raise NotConverged("the times are no whole numbers of steps")
    kept: dict[int, tuple[Positions, Positions]] = {}
    run = simulate(scene, prepare(scene, Newton()), _SOLVED, first_guess="current", frames=wanted[-1])
    for step in run:
        if not np.isfinite(step.positions).all():
            raise NotConverged(f"the motion is not finite from {step.index * h:.3g} s on")
        if step.index in wanted:
            kept[step.index] = step.positions.copy(), step.state.now.velocity.copy()
        if thread_time() > until and step.index < wanted[-1]:
            return None
    p, v = (np.array([kept[k][i] for k in wanted]) for i in (0, 1))
    return _Motion(scene.system.free, start(scene).now.positions, p, v)


def _compared(
    now: dict[str, _Motion], before: dict[str, _Motion], times: Sequence[float], step: float
) -> SelfConverged:
    first, second = (now[name] for name in INTEGRATORS)
    free = second.free

    def size(x: Positions) -> NDArray[np.float64]:
        return np.linalg.norm(x[:, free], axis=(1, 2))

    moved = size(second.positions - second.begin)
    if not moved.all():
        raise NotConverged("nothing moves, and errors are relative to what does")
    halved = [size(now[name].positions - before[name].positions) for name in INTEGRATORS]
    apart = size(first.positions - second.positions)
    most = np.max([*halved, apart], axis=0) / moved
    return SelfConverged(
        times=np.array(times, float),
        free=free,
        positions=second.positions,
        velocities=second.velocities,
        moved=moved,
        disagreement=most,
        growth=np.zeros(len(times)),
        step=step,
        moved_last=float(np.max(halved, axis=0)[-1] / moved[-1]),
    )


def told_once(name: str) -> str:
    """Return the note that is shown for a scene with contact before anything is measured."""
    return (
        f"{name}: contact has no certified reference; errors are by a self-converged motion (implicit Euler and BDF2, "
        "steps halved until they agree), and rejected where that does not converge"
    )

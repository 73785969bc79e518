"""The iteration loop of all methods, with the stop rule, its limits and the solution.

    run = begin(problem, guess);  advance(run), advance(run), ...  while residual(run) > rtol * residual_0

A method supplies these three functions: an `Iterative` has `begin`, and a `Iterating` has `advance` and
`residual`. A method with a compiled loop overrides `iterate` and uses the kernel version in
`solvers.kernels.loop`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from operator import methodcaller
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.kernels import loop
from solvers.kernels.loop import Limits, at_most
from solvers.problem import Positions, ResidualOf, Solution, StepProblem, StopRule, Unsupported
from solvers.round_off import at_rest

_STOPPED = {
    loop.ITERATIONS: "iterations",
    loop.TOLERANCE: "tolerance",
    loop.FLOOR: "floor",
    loop.STALLED: "stalled",
}

_NEAR = 1e-12
"""Fraction of `Iterative.scale` that no rounding error reaches. It is thousands of units in the last
place of any sum involved."""

_DISTANT = 1e5
"""Ratio of coordinates to extent beyond which round-off at rest is detected by the decrease of the residual."""

_CLOSE = 1e-5
"""Largest rtol for which the last iterate is checked for a minimum; looser tolerances do not justify the check."""


EXACT = (
    "supports finite stiffness only, and the scene has length constraints (a stiffness of `exact`): use "
    "avbd, which supports them, or give springs and strain limits a finite stiffness"
)
"""Reason, after the method's name, why a method without length constraints does not support the scene."""


_loop = loop.over(methodcaller("advance"), methodcaller("residual"))


class Iterating(ABC):
    """The state of a solve.

    Attributes:
        positions: the iterate (n, 3) [m], which the next iteration may overwrite.
        velocity: velocity at the end of the step (n, 3) [m/s], for a method that computes its own.
    """

    positions: Positions
    velocity: Positions | None = None

    @property
    def kept(self) -> NDArray[np.float64] | None:
        """Data for the next solve, see `solvers.problem.Solution`."""
        return None

    @abstractmethod
    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents descent and the positions do not change."""

    def residual(self) -> float:
        """Return |Q^-1 grad g|_Q [J^(1/2)] over the unpinned vertices, at the iterate of `residual_of`.

        It is nan for a method that does not minimise, and before the first iteration if it belongs to the previous
        iterate.
        """
        return float("nan")

    def certifies(self) -> bool:
        """Return whether the iterate may be a minimum if it is stationary; a saddle point returns False."""
        return True

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason, see `solvers.kernels.loop`."""
        return _loop(self, limits)


class Iterative(ABC):
    """A method after the setup for a system; with `description` and `stats` it is a `Prepared`.

    Attributes:
        residual_of: the iterate of the residuals. It is "previous" for a method that computes them in its
            iteration as |p - LG(p)|, and "none" for a method that does not minimise, which does all iterations.
        keeps_lengths: whether length constraints are supported; if not, `iterates` and `solve` raise
            Unsupported for a system that has any.
    """

    residual_of: ClassVar[ResidualOf] = "returned"
    keeps_lengths: ClassVar[bool] = False

    @abstractmethod
    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m], which is not modified."""

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """Yield the iterates from the initial guess; the next one may overwrite a yielded array."""
        run = self._begun(problem)
        while True:
            run.advance()
            yield run.positions

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until `stop` terminates the solve or no step decreases the objective.

        Without a tolerance only the last residual is computed.
        """
        run = self._begun(problem)
        limits, yardstick, close = at_most(stop.iterations), float("nan"), False
        if (stop.tolerance is not None or stop.within > 0.0) and self.residual_of != "none":
            near, limit = _NEAR * self.scale(problem) if stop.floor > 0.0 else 0.0, stop.within
            if stop.tolerance is not None:
                yardstick = self.residual_at(problem, problem.current)
                limit, close = max(limit, stop.tolerance * yardstick), stop.tolerance <= _CLOSE
            limits = Limits(stop.iterations, limit, near, loop.EACH)
        count, residual, ended = self._iterated(run, problem, limits, stop.floor)
        while close and ended in (loop.TOLERANCE, loop.FLOOR) and not run.certifies():
            left = limits._replace(iterations=stop.iterations - count)
            more, residual, ended = self._iterated(run, problem, left, stop.floor)
            count += more
            if not more and ended != loop.ITERATIONS:
                ended = loop.STALLED
        ended = _STOPPED[ended]
        return Solution(run.positions, count, residual, yardstick, ended, run.velocity, self.residual_of, run.kept)

    def _begun(self, problem: StepProblem) -> Iterating:
        if problem.system.lengths and not self.keeps_lengths:
            raise Unsupported(EXACT)
        return self.begin(problem, problem.first_guess)

    @staticmethod
    def _iterated(run: Iterating, problem: StepProblem, limits: Limits, floor: float) -> tuple[int, float, int]:
        """Call `run.iterate`, and return FLOOR only if the gradient is round-off at each vertex.

        The gradient is checked once the residual is near round-off, then after one more iteration, and then whenever
        the iterations since the first check have grown by half. Far from the origin the bound consists mostly of the
        rounding of coordinates whose differences are exact; there the iterations continue while each halves the
        residual.
        """
        count, residual, ended = run.iterate(limits)
        since, gains = 0, True
        while ended == loop.FLOOR:
            rests = at_rest(problem, run.positions, floor)
            if rests and not (gains and is_distant(run.positions)):
                break
            some = min(1 if rests else 1 + since // 2, limits.iterations - count)
            if some == 0:
                return count, residual, loop.FLOOR if rests else loop.ITERATIONS
            more, now, ended = run.iterate(limits._replace(iterations=some, floor=0.0))
            gains = gains and (not rests or now < 0.5 * residual)
            count, since, residual = count + more, since + more, now
            if ended == loop.ITERATIONS or (rests and ended == loop.STALLED):
                ended = loop.FLOOR
        return count, residual, ended

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] at p (n, 3) [m].

        It costs one iteration if it belongs to the previous iterate.
        """
        if self.residual_of == "none":
            return float("nan")
        return self.begin(problem, p).iterate(at_most(int(self.residual_of == "previous")))[1]

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Build a function that returns `residual_at` for many positions of one step."""
        return lambda p: self.residual_at(problem, p)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] of a mean displacement as large as the initial guess's largest coordinate.

        The check for round-off begins at a small fraction of it; 0 disables the check.
        """
        return 0.0

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration; none by default."""
        return {}


class Substeps(Iterating):
    """The whole step in 1, 2, ... substeps, each time from its start.

    Iterates that are not needed are skipped.
    """

    def __init__(self, step: Callable[[StepProblem, int], tuple[Positions, Positions]], problem: StepProblem) -> None:
        """Create the state; `step(problem, n)` returns positions [m] and velocity [m/s]."""
        self._step, self._problem, self._substeps = step, problem, 0
        self.positions = problem.start.positions

    def advance(self) -> bool:
        """Integrate the step with one more substep."""
        self.iterate(loop.ONE)
        return True

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Integrate the step once, with as many more substeps as the limit has iterations."""
        self._substeps += limits.iterations
        self.positions, self.velocity = self._step(self._problem, self._substeps)
        return limits.iterations, float("nan"), loop.ITERATIONS


def is_distant(p: Positions) -> bool:
    """Return whether coordinates (n, 3) [m] are so large that their rounding dominates that of their differences."""
    return bool(np.abs(p).max(initial=0.0) > _DISTANT * np.ptp(p, axis=0).max(initial=0.0)) if len(p) else False


def largest(problem: StepProblem) -> float:
    """Return the largest coordinate [m] of the initial guess, with exactly pinned vertices on their targets."""
    s, p = problem.system, problem.first_guess
    if len(s.free) < s.vertices:
        p = p.copy()
        p[s.pins.vertices[s.pins.exact]] = problem.pin_targets[s.pins.exact]
    return float(np.abs(p).max(initial=0.0))

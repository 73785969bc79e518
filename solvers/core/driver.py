"""The driver: it owns the iteration loop, the stop rule, its limits and what a solve answers.

    run = begin(problem, guess);    advance(run), advance(run), ...    while residual(run) > tolerance * yardstick

A method is these three: `Iterative` makes a prepared solver of its `begin`, and `Iterating` a solve of its `advance`
and `residual`. A method whose loop is compiled overrides `iterate`, with what `solvers.kernels.loop` has for kernels.
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
"""Of `Iterative.scale`: what no round-off exceeds, by far. It is thousands of the last digits of all that is added up,
whatever has most of them."""

_DISTANT = 1e5
"""Of the extent: from coordinates so large on, round-off at rest is told by what iterations still gain."""

_CLOSE = 1e-5
"""A tolerance from which on the last point should be a minimum; a greater one asks for less than that."""


EXACT = (
    "minimises what is finite, and the scene has lengths that are kept exactly (a stiffness that is `exact`): take "
    "avbd, which keeps them, or give springs and strain limits a stiffness in figures"
)
"""Why a method that does not keep lengths refuses them, after its name."""


_loop = loop.over(methodcaller("advance"), methodcaller("residual"))


class Iterating(ABC):
    """A solve that has begun.

    positions: where it is (n, 3) [m]; the next iteration may overwrite them. velocity: at the step's end (n, 3) [m/s],
    of a method that keeps its own.
    """

    positions: Positions
    velocity: Positions | None = None

    @property
    def kept(self) -> NDArray[np.float64] | None:
        """See `solvers.problem.Solution`."""
        return None

    @abstractmethod
    def advance(self) -> bool:
        """Do one iteration; False where round-off lets nothing descend, and the positions stay."""

    def residual(self) -> float:
        """|Q^-1 grad g|_Q [J^(1/2)] over the unpinned vertices, at the iterate that the method's `residual_of` names;
        nan of a method that does not minimise, and before the first iteration where it belongs to the previous one."""
        return float("nan")

    def certifies(self) -> bool:
        """Whether a stationary point where it is may be the last: whether it is a minimum, for all the method knows."""
        return True

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """As many iterations as the limits allow; see `solvers.kernels.loop`."""
        return _loop(self, limits)


class Iterative(ABC):
    """A method that is ready for a system; with `choice` and `facts` a `solvers.problem.Prepared`.

    residual_of: the iterate that its residuals belong to. It is the previous one of a method that tells them by its
    iteration, |p - LG(p)|; "none" of a method that does not minimise, and does all iterations. keeps_lengths: whether
    it keeps those of a system that are exact; `iterates` and `solve` of others raise Unsupported where there are any.
    """

    residual_of: ClassVar[ResidualOf] = "returned"
    keeps_lengths: ClassVar[bool] = False

    @abstractmethod
    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """A solve from a first guess (n, 3) [m], which is not written to."""

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The iterates from `problem.first_guess`; a yielded array may be overwritten by the next one."""
        run = self._begun(problem)
        while True:
            run.advance()
            yield run.positions

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until `stop` says so, or until nothing descends; without a tolerance only the last residual is
        computed."""
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
        """As `run.iterate`, but FLOOR only where the gradient is round-off, vertex by vertex.

        That is looked at where the residual is near to it, and then again after one more iteration, and whenever half
        as many have been done since as at the last look. Far from the origin that bound is mostly the rounding of
        coordinates whose differences are exact: there iterations go on while each halves the residual.
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
        """The residual [J^(1/2)] at positions p (n, 3) [m]: an iteration's work for one of the previous iterate."""
        if self.residual_of == "none":
            return float("nan")
        return self.begin(problem, p).iterate(at_most(int(self.residual_of == "previous")))[1]

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """What tells `residual_at` of many positions of one step."""
        return lambda p: self.residual_at(problem, p)

    def scale(self, problem: StepProblem) -> float:
        """The residual [J^(1/2)] that a mean displacement of the first guess's largest coordinate would cause: a small
        part of it is where round-off begins to be looked for, and 0 where it never is."""
        return 0.0

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """The parts of an iteration; none, where a method does not say."""
        return {}


class Substeps(Iterating):
    """The whole step in one substep, in two, and so on, each from the start; what nobody looks at is left out."""

    def __init__(self, step: Callable[[StepProblem, int], tuple[Positions, Positions]], problem: StepProblem) -> None:
        """step: positions [m] and velocity [m/s] after the step of a problem in so many substeps."""
        self._step, self._problem, self._substeps = step, problem, 0
        self.positions = problem.start.positions

    def advance(self) -> bool:
        """See Iterating."""
        self.iterate(loop.ONE)
        return True

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating."""
        self._substeps += limits.iterations
        self.positions, self.velocity = self._step(self._problem, self._substeps)
        return limits.iterations, float("nan"), loop.ITERATIONS


def is_distant(p: Positions) -> bool:
    """Whether positions (n, 3) [m] are so far from the origin that their rounding exceeds that of their differences."""
    return bool(np.abs(p).max(initial=0.0) > _DISTANT * np.ptp(p, axis=0).max(initial=0.0)) if len(p) else False


def largest(problem: StepProblem) -> float:
    """The first guess's largest coordinate [m], exactly pinned vertices on their targets."""
    s, p = problem.system, problem.first_guess
    if len(s.free) < s.vertices:
        p = p.copy()
        p[s.pins.vertices[s.pins.exact]] = problem.pin_targets[s.pins.exact]
    return float(np.abs(p).max(initial=0.0))

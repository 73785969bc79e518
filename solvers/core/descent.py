"""What methods with exact gradients share: their points, and a line search that tells a descent from round-off.

The line search halves a step until the objective falls enough (`solvers.kernels.line_search`). The rise is computed
from differences (see `solvers.kernels.objective`), so that this works until the gradient itself is round-off. What
other energies' values lose to round-off is allowed for; there the slope has to shrink instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers import matrices
from solvers.core.driver import Iterating, Iterative, largest
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.kernels.line_search import DECREASE, falls, flattens
from solvers.linear.choice import factorise
from solvers.linear.factors import DenseCholesky
from solvers.problem import Positions, ProjectiveEnergy, StepProblem, System

HALVINGS = 60
"""A step so often halved has no digit left."""


class Point(NamedTuple):
    """Where a method is: positions and gradient, (n, 3); stalled: whether round-off lets nothing descend from here;
    left: whether the point before was a saddle.
    """

    positions: Positions
    gradient: Positions
    stalled: bool = False
    left: bool = False


class Method(Protocol):
    """One iteration after another from a point; the last point, at which the method stalls, is its last."""

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """The points after `start`."""
        ...

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """Whether a stationary point is a minimum, for all that the method can tell: it may be the last."""
        ...

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """What its iterations are made of, by name, at a point."""
        ...


def search(
    step: StepObjective,
    at: Point,
    direction: Positions,
    *,
    first: float = 1.0,
    curvature: float = 0.0,
    settled: Callable[[Positions], Positions] | None = None,
) -> Point | None:
    """The first point of those at `first`, first/2, first/4, ... of a direction that descends enough; None for none.

    No point is beyond what the step may pass through (`solvers.core.bounds`). curvature [J]: the second derivative
    along the direction, where it is what promises a descent; settled: what else lowers the objective from positions on,
    tried first at each point.
    """
    slope = dot(at.gradient, direction)
    t = step.reach(at.positions, direction, first)
    for _ in range(HALVINGS if slope + curvature < 0.0 < t else 0):
        p = step.placed(at.positions + t * direction)
        lower = settled(p) if settled else p
        if lower is not p and step.rise(at.positions, lower)[0] <= DECREASE * t * (slope + 0.5 * t * curvature):
            return Point(lower, step.gradient(lower))
        rise, noise = step.rise(at.positions, p)
        if falls(rise, t, slope, curvature):
            return Point(p, step.gradient(p))
        if rise <= noise and 0.0 < noise < np.inf:
            gradient = step.gradient(p)
            if flattens(abs(dot(gradient, direction)), slope, DECREASE):
                return Point(p, gradient)
        t *= 0.5
    return None


def lower(step: StepObjective, start: Point) -> Point:
    """The lower one of a point and of free fall, where nothing is in the way there."""
    fall = step.fall()
    if step.bounded and step.reach(start.positions, fall - start.positions) < 1.0:
        return start
    return Point(fall, step.gradient(fall)) if step.rise(start.positions, fall)[0] < 0.0 else start


def near(step: StepObjective, p: Positions) -> bool:
    """Whether something is in range at p that a step may not pass through."""
    return any(energy.value(p) > 0.0 for energy in step.bounded)


def dot(a: Positions, b: Positions) -> float:
    """The scalar product of two fields, (n, 3)."""
    return float(np.einsum("ij,ij->", a, b))


class Metric:
    """Q of a system's projective energies, factorised: what residuals are measured by.

    trace: of its unpinned part [N/m]; inner: its free part (f, f); diagonal: of that (f,) [N/m]; factor: of the free
    part; choice: the linear solver in words; facts: counts.
    """

    def __init__(self, system: System) -> None:
        """Raises NotPositiveDefinite where nothing determines some positions, and Unsupported where no linear solver
        fits in memory."""
        self.system = system
        self._Q = matrices.assemble(system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)])
        self.inner = csr_array(csr_array(self._Q[system.free])[:, system.free])
        self.diagonal: NDArray[np.float64] = np.asarray(self.inner.diagonal(), np.float64)
        self.trace = float(self._Q.diagonal()[system.unpinned].sum())
        self.facts = {"nnz_system": float(self._Q.nnz)}
        free, nothing = system.free, (DenseCholesky(np.eye(0)), "nothing to solve for")
        self.factor, self.choice = factorise(self.inner) if len(free) else nothing
        if self.factor.nonzeros is not None:
            self.facts["nnz_factor"] = float(self.factor.nonzeros)

    def round_off(self, p: Positions) -> float:
        """g H^-1 g [J] of a gradient that is round-off of the positions p (n, 3), at most."""
        return float(np.finfo(np.float64).eps * np.abs(p).max(initial=0.0)) ** 2 * self.trace

    def solve(self, b: Positions) -> Positions:
        """Q^-1 b, (n, 3), zero at exactly pinned vertices."""
        out, free = np.zeros_like(b), self.system.free
        x = np.empty((len(free), 3))
        self.factor.solve(np.ascontiguousarray(b[free]), x)
        out[free] = x
        return out

    def residual(self, gradient: Positions) -> float:
        """|Q^-1 g|_Q [J^(1/2)] over the unpinned vertices, of a gradient g (n, 3)."""
        return self.norm(self.solve(gradient), gradient)

    def norm(self, e: Positions, gradient: Positions) -> float:
        """The same of e = Q^-1 g, which is overwritten."""
        pins = self.system.pins
        if pins.exact.all():  # then |Q^-1 g|_Q is what g does along it
            return max(dot(e, gradient), 0.0) ** 0.5  # in this order, which keeps NaN
        e[pins.vertices] = 0.0
        return matrices.energy_norm(self._Q, e)


@dataclass(frozen=True, eq=False)
class PreparedDescent(Iterative):
    """A method, ready for a system.

    Where something is in range that may not be passed through, it begins with free fall if that is lower. A gap that
    all but closes makes a Hessian so stiff that the direction of a common motion keeps no digits for the gap, which
    bounds the step.
    """

    objective: Objective
    metric: Metric
    method: Method
    choice: str
    facts: dict[str, float]

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """See Iterative."""
        step, start = self._begin(problem, guess)
        return _Iterating(self, step, lower(step, start) if near(step, start.positions) else start)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """See Iterative."""
        return self.metric.residual(StepObjective(self.objective, problem).gradient(p))

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return largest(problem) * self.metric.trace**0.5

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """What iterations are made of, at the first guess."""
        return self.method.phases(*self._begin(problem, problem.first_guess))

    def _begin(self, problem: StepProblem, guess: Positions) -> tuple[StepObjective, Point]:
        step = StepObjective(self.objective, problem)
        p = step.placed(guess)
        return step, Point(p, step.gradient(p))


class _Iterating(Iterating):
    """From point to point; one at which the method stalls is the one before."""

    def __init__(self, prepared: PreparedDescent, step: StepObjective, start: Point) -> None:
        self._metric, self._method, self._step = prepared.metric, prepared.method, step
        self._points, self._point, self.positions = prepared.method.points(step, start), start, start.positions

    def advance(self) -> bool:
        """See Iterating."""
        before, self._point = self._point, next(self._points, self._point)
        self.positions = self._point.positions
        return not self._point.stalled or self.positions is not before.positions

    def residual(self) -> float:
        """See Iterating."""
        return self._metric.residual(self._point.gradient)

    def certifies(self) -> bool:
        """See Iterating."""
        return self._method.certifies(self._step, self._point)

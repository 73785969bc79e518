"""The base of methods with exact gradients: points, and a line search that distinguishes descent from round-off.

The line search halves a step until the objective decreases enough (`solvers.kernels.line_search`). The
change of the objective is computed from differences (see `solvers.kernels.objective`), so that the search works
until the gradient itself is round-off. The rounding error of other energies' values is taken into account; within it
the slope must decrease instead.
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
"""Maximum number of halvings; after it a step has no significant digit left."""


class Point(NamedTuple):
    """An iterate: positions and gradient, (n, 3).

    Attributes:
        stalled: whether round-off prevents descent from here.
        left: whether the previous point was a saddle point.
    """

    positions: Positions
    gradient: Positions
    stalled: bool = False
    left: bool = False


class Method(Protocol):
    """A method that yields one point after another; it ends with a stalled one."""

    def points(self, step: StepObjective, start: Point) -> Iterator[Point]:
        """Yield the points after `start`."""
        ...

    def certifies(self, step: StepObjective, at: Point) -> bool:
        """Return whether a stationary point may be a minimum, as far as the method can determine."""
        ...

    def phases(self, step: StepObjective, at: Point) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration at a point, by name."""
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
    """Return the first point at first, first/2, ... with sufficient decrease, or None.

    No point is beyond the step size limit of the barrier energies (`solvers.core.bounds`).

    Args:
        step: the objective.
        at: current point.
        direction: search direction (n, 3) [m].
        first: first step size.
        curvature: second derivative along the direction [J], if a decrease is expected from it.
        settled: relaxation that lowers the objective from given positions; its result is tried first at each
            point.
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
    """Return the lower one of a point and the inertial prediction, if the path to the latter is free of collisions."""
    fall = step.fall()
    if step.bounded and step.reach(start.positions, fall - start.positions) < 1.0:
        return start
    return Point(fall, step.gradient(fall)) if step.rise(start.positions, fall)[0] < 0.0 else start


def near(step: StepObjective, p: Positions) -> bool:
    """Return whether a barrier energy is active at p."""
    return any(energy.value(p) > 0.0 for energy in step.bounded)


def dot(a: Positions, b: Positions) -> float:
    """Return the inner product of two fields, (n, 3)."""
    return float(np.einsum("ij,ij->", a, b))


class Metric:
    """Q of a system's projective energies, factorised, which defines the norm of residuals.

    Attributes:
        trace: trace of its unpinned part [N/m].
        inner: its free part (f, f).
        diagonal: diagonal of the free part (f,) [N/m].
        factor: factor of the free part.
        choice: description of the linear solver.
        facts: exact counts.
    """

    def __init__(self, system: System) -> None:
        """Assemble and factorise Q.

        Raises:
            NotPositiveDefinite: the positions of some vertices are not determined.
            Unsupported: no linear solver fits in memory.
        """
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
        """Return a bound of g H^-1 g [J] for a gradient g due to rounding of the positions p (n, 3)."""
        return float(np.finfo(np.float64).eps * np.abs(p).max(initial=0.0)) ** 2 * self.trace

    def solve(self, b: Positions) -> Positions:
        """Return Q^-1 b, (n, 3), zero at exactly pinned vertices."""
        out, free = np.zeros_like(b), self.system.free
        x = np.empty((len(free), 3))
        self.factor.solve(np.ascontiguousarray(b[free]), x)
        out[free] = x
        return out

    def residual(self, gradient: Positions) -> float:
        """Return |Q^-1 g|_Q [J^(1/2)] over the unpinned vertices, of a gradient g (n, 3)."""
        return self.norm(self.solve(gradient), gradient)

    def norm(self, e: Positions, gradient: Positions) -> float:
        """Return that residual for e = Q^-1 g, which is overwritten."""
        pins = self.system.pins
        if pins.exact.all():  # then |Q^-1 g|_Q is what g does along it
            return max(dot(e, gradient), 0.0) ** 0.5  # in this order, which keeps NaN
        e[pins.vertices] = 0.0
        return matrices.energy_norm(self._Q, e)


@dataclass(frozen=True, eq=False)
class PreparedDescent(Iterative):
    """A descent method after the setup for a system.

    If a barrier is active at the initial guess, the solve starts at the inertial prediction, if that is lower. A nearly
    closed gap makes the Hessian so stiff that the direction of a common motion has no significant digits for the gap,
    which limits the step size.
    """

    objective: Objective
    metric: Metric
    method: Method
    choice: str
    facts: dict[str, float]

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        step, start = self._begin(problem, guess)
        return _Iterating(self, step, lower(step, start) if near(step, start.positions) else start)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] at p (n, 3) [m]."""
        return self.metric.residual(StepObjective(self.objective, problem).gradient(p))

    def scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return largest(problem) * self.metric.trace**0.5

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration at the initial guess."""
        return self.method.phases(*self._begin(problem, problem.first_guess))

    def _begin(self, problem: StepProblem, guess: Positions) -> tuple[StepObjective, Point]:
        step = StepObjective(self.objective, problem)
        p = step.placed(guess)
        return step, Point(p, step.gradient(p))


class _Iterating(Iterating):
    """The state of a solve; a stalled point has the previous positions."""

    def __init__(self, prepared: PreparedDescent, step: StepObjective, start: Point) -> None:
        self._metric, self._method, self._step = prepared.metric, prepared.method, step
        self._points, self._point, self.positions = prepared.method.points(step, start), start, start.positions

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        before, self._point = self._point, next(self._points, self._point)
        self.positions = self._point.positions
        return not self._point.stalled or self.positions is not before.positions

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self._metric.residual(self._point.gradient)

    def certifies(self) -> bool:
        """Return whether the iterate may be a minimum if it is stationary."""
        return self._method.certifies(self._step, self._point)

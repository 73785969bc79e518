"""The base of methods with exact gradients: points and a line search.

The line search halves a step until the objective decreases enough
(`springbench.solvers.kernels.line_search_conditions`). The change of the objective is computed from differences (see
`springbench.solvers.kernels.objective_kernels`), so that the search works until the gradient itself is round-off. The
rounding error of other energies' values is taken into account: if the change is within it, the slope must decrease
instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from springbench.solvers.iteration.iterative_solver import (
    CompiledState,
    IterativeSolver,
    SolverState,
    compute_max_coordinate,
)
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.kernels import objective_kernels
from springbench.solvers.kernels.descent_search import SearchArrays, bound_decrement_roundoff
from springbench.solvers.kernels.free_components import FreeComponents
from springbench.solvers.kernels.iteration_loop import LoopLimits
from springbench.solvers.kernels.line_search_conditions import (
    ARMIJO_FRACTION,
    MAX_HALVINGS,
    is_approximate_wolfe_step,
    is_armijo_step,
)
from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
from springbench.solvers.kernels.residual_norm import NormMatrix, ResidualNorm, compute_correction_norm
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky, embed_factor
from springbench.solvers.linalg.dense_inverse import DenseInverse
from springbench.solvers.linalg.direct_solvers import DenseCholesky
from springbench.solvers.linalg.solver_selection import build_linear_solver
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions, ProjectiveEnergy, StepProblem, System
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective


class DescentPoint(NamedTuple):
    """An iterate: positions and gradient, (n, 3).

    Attributes:
        is_stalled: whether round-off prevents descent from here.
        is_past_saddle: whether the previous point was a saddle point.
    """

    positions: Positions
    gradient: Positions
    is_stalled: bool = False
    is_past_saddle: bool = False


class DescentMethod(Protocol):
    """A method that yields one point after another; it ends with a stalled one.

    Attributes:
        can_identify_saddles: whether `can_terminate` distinguishes saddles from minima.
    """

    can_identify_saddles: ClassVar[bool]

    def iterate_points(self, step: StepObjective, start: DescentPoint) -> Iterator[DescentPoint]:
        """Yield the points that follow a given one.

        Args:
            step: the objective.
            start: first point, which is not yielded.
        """
        ...

    def can_terminate(self, step: StepObjective, at: DescentPoint) -> bool:
        """Return whether a stationary point may be a minimum; False for a recognised saddle point.

        Args:
            step: the objective.
            at: the point.
        """
        ...

    def iteration_phases(self, step: StepObjective, at: DescentPoint) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration, by name.

        Args:
            step: the objective.
            at: point at which the phases are evaluated.
        """
        ...


def backtracking_line_search(
    step: StepObjective,
    at: DescentPoint,
    direction: Positions,
    *,
    initial_step: float = 1.0,
    directional_curvature: float = 0.0,
    relax_locally: Callable[[Positions], Positions] | None = None,
    uses_rounded_slope: bool = False,
    slope: float | None = None,
) -> DescentPoint | None:
    """Return the first point at initial_step, initial_step/2, ... with sufficient decrease, or None.

    No point is beyond the step size limit of the barrier energies (`springbench.solvers.model.barrier_energy`).

    Args:
        step: the objective.
        at: current point.
        direction: search direction (n, 3) [m].
        initial_step: first step size.
        directional_curvature: second derivative along the direction [J], if a decrease is expected from it.
        relax_locally: relaxation that lowers the objective from given positions; its result is tried first at each
            point.
        uses_rounded_slope: whether a decrease is also sufficient if it satisfies Armijo's condition with the slope
            along the rounded displacement. The rounding of positions may absorb most of a displacement, for example at
            stiff pins.
        slope: derivative along the direction [J], if it is known.
    """
    slope = inner_product(at.gradient, direction) if slope is None else slope
    t = step.max_step_size(at.positions, direction, initial_step)
    for _ in range(MAX_HALVINGS if slope + directional_curvature < 0.0 < t else 0):
        p, rise, noise, gradient = step.try_step(at.positions, direction, t, slope, directional_curvature)
        lower = relax_locally(p) if relax_locally else p
        if lower is not p and step.objective_change(at.positions, lower)[0] <= ARMIJO_FRACTION * t * (
            slope + 0.5 * t * directional_curvature
        ):
            return DescentPoint(lower, step.gradient(lower))
        if gradient is not None or is_armijo_step(rise, t, slope, directional_curvature):
            return DescentPoint(p, step.gradient(p) if gradient is None else gradient)
        if rise <= noise and 0.0 < noise < np.inf:
            gradient = step.gradient(p)
            if is_approximate_wolfe_step(abs(inner_product(gradient, direction)), slope, ARMIJO_FRACTION):
                return DescentPoint(p, gradient)
        if uses_rounded_slope and rise < 0.0:
            rounded_slope = inner_product(at.gradient, p - at.positions)
            if rounded_slope < 0.0 and is_armijo_step(rise, 1.0, rounded_slope, 0.0):
                return DescentPoint(p, step.gradient(p))
        t *= 0.5
    return None


def guesses_current_positions(problem: StepProblem) -> bool:
    """Return whether the initial guess of a step is its current positions."""
    guess, current = problem.initial_guess, problem.current_positions
    return guess is current or np.array_equal(guess, current)


def pick_lowest_positions(step: StepObjective, p: Positions, *others: Positions) -> tuple[Positions, float]:
    """Return the positions with the lowest objective, and its decrease.

    The displacement from the first to the others must also be collision-free.

    Args:
        step: the objective.
        p: positions (n, 3) [m], returned as the same array if no others have a lower objective.
        others: positions (n, 3) [m].

    Returns:
        The positions (n, 3) [m], and the decrease of the objective from the first ones to them [J].
    """
    lowest, decrease = p, 0.0
    for q in others:
        change = step.objective_change(lowest, q)[0]
        if change < 0.0 and (not step.barrier_energies or step.max_step_size(p, q - p) == 1.0):
            lowest, decrease = q, decrease - change
    return lowest, decrease


def pick_lower_start(step: StepObjective, start: DescentPoint) -> DescentPoint:
    """Return the lower one of a point and the inertial prediction, as `pick_lowest_positions` does.

    Args:
        step: the objective.
        start: the point, returned itself if the prediction is not lower.
    """
    p, _ = pick_lowest_positions(step, start.positions, step.inertial_prediction())
    return start if p is start.positions else DescentPoint(p, step.gradient(p))


def has_active_barrier(step: StepObjective, p: Positions) -> bool:
    """Return whether a barrier energy is active.

    Args:
        step: the objective, with the barrier energies of its step.
        p: positions (n, 3) [m].
    """
    return any(energy.value(p) > 0.0 for energy in step.barrier_energies)


def inner_product(a: Positions, b: Positions) -> float:
    """Return the inner product of two fields over all vertices.

    Args:
        a, b: fields (n, 3), such as a gradient [N] and a direction [m].
    """
    return float(np.einsum("ij,ij->", a, b))


class ResidualMetric:
    """Q of a system's projective energies, factorised, which defines the norm of residuals.

    Attributes:
        unpinned_trace: trace of its unpinned part [N/m].
        free_block: its free part (f, f).
        free_diagonal: diagonal of the free part (f,) [N/m].
        factor: factor of the free part.
        description: description of the linear solver.
        stats: exact counts.
    """

    def __init__(self, system: System) -> None:
        """Assemble and factorise Q.

        Raises:
            NotPositiveDefinite: the positions of some vertices are not determined.
            Unsupported: no linear solver fits in memory.
        """
        self.system = system
        self._Q = system_matrix_assembly.assemble_system_matrix(
            system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)]
        )
        self.free_block = csr_array(csr_array(self._Q[system.free_vertices])[:, system.free_vertices])
        self.free_diagonal: NDArray[np.float64] = np.asarray(self.free_block.diagonal(), np.float64)
        has_penalty_pins = not system.pins.exact_mask.all()
        pinned = system.pins.vertices if has_penalty_pins else np.empty(0, np.int64)
        self._norm_matrix = NormMatrix(
            np.array(pinned, np.int64),
            self._Q.indptr,
            self._Q.indices,
            self._Q.data,
            np.empty((system.num_vertices if has_penalty_pins else 0, 3)),
        )
        self._compute_norm = TypedKernel(compute_correction_norm)
        self.unpinned_trace = float(self._Q.diagonal()[system.unpinned_mask].sum())
        self.stats = {"nnz_system": float(self._Q.nnz)}
        free, nothing = system.free_vertices, (DenseCholesky(np.eye(0)), "nothing to solve for")
        self.factor, self.description = build_linear_solver(self.free_block) if len(free) else nothing
        if self.factor.nonzeros is not None:
            self.stats["nnz_factor"] = float(self.factor.nonzeros)

    def energy_roundoff(self, p: Positions) -> float:
        """Return a bound of g' H^-1 g [J] for a gradient g that is round-off.

        The round-off is due to the rounding of the positions p (n, 3).
        """
        return self.bound_energy_roundoff(objective_kernels.compute_max_magnitude(p))

    def bound_energy_roundoff(self, max_magnitude: float) -> float:
        """Return the bound of `energy_roundoff` for positions with this largest absolute coordinate [m]."""
        return bound_decrement_roundoff(max_magnitude, self.unpinned_trace)

    def significant_vertices(self, p: Positions, decrease: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which vertices are of connected components whose decrease exceeds round-off.

        Args:
            p: positions (n, 3) [m].
            decrease: predicted decrease of the objective at each vertex (n,) [J].
        """
        labels, largest = self._component_labels, np.zeros(len(p))
        np.maximum.at(largest, labels, np.abs(p).max(axis=1, initial=0.0))
        stiffness = np.bincount(labels, self._Q.diagonal() * self.system.unpinned_mask, minlength=len(p))
        roundoff = stiffness * (EPS * largest) ** 2
        return (np.bincount(labels, decrease, minlength=len(p)) > roundoff)[labels]

    @cached_property
    def _component_labels(self) -> NDArray[np.int32]:
        return connected_components(self._Q, directed=False)[1]

    @cached_property
    def free_components(self) -> FreeComponents:
        """The connected components of Q whose translation only inertia resists."""
        return FreeComponents.from_matrix(self.system, self._Q, self._component_labels)

    def solve(self, b: Positions) -> Positions:
        """Return Q^-1 b, (n, 3), zero at exactly pinned vertices."""
        free = self.system.free_vertices
        if len(free) == len(b):
            out = np.empty_like(b, order="C")
            self.factor.solve(np.ascontiguousarray(b), out)
            return out
        out, x = np.zeros_like(b), np.empty((len(free), 3))
        self.factor.solve(b.take(free, axis=0), x)
        out[free] = x
        return out

    def residual(self, gradient: Positions) -> float:
        """Return |Q^-1 g|_Q [J^(1/2)] over the unpinned vertices, of a gradient g (n, 3)."""
        return self.correction_norm(self.solve(gradient), gradient)

    def correction_norm(self, e: Positions, gradient: Positions) -> float:
        """Return the residual |e|_Q [J^(1/2)] over the unpinned vertices, of e = Q^-1 g.

        Args:
            e: correction Q^-1 g (n, 3) [m], overwritten.
            gradient: gradient g (n, 3) [N].
        """
        return self._compute_norm.call(self._norm_matrix, e, as_kernel_array(gradient))

    @cached_property
    def supernodal_factor(self) -> SupernodalCholesky | None:
        """The factor if kernels support it; else None.

        A dense inverse is replaced by a supernodal factor, however small it is.
        """
        if isinstance(self.factor, DenseInverse):
            return SupernodalCholesky(self.free_block)
        return self.factor if isinstance(self.factor, SupernodalCholesky) else None

    @property
    def is_threaded(self) -> bool:
        """Whether solves with Q use several threads."""
        return self.supernodal_factor is not None and self.supernodal_factor.choose_num_threads() is not None

    def build_search_arrays(self, objective: FixedObjective) -> SearchArrays | None:
        """Build the arrays of a compiled method, or return None if it is not supported.

        It has one thread. Kernels support springs and quadratic forms, and supernodal factors.

        Args:
            objective: objective of the system, perhaps without barriers.
        """
        if self.supernodal_factor is None or not objective.is_springs_and_forms:
            return None
        form, free = objective.quadratic_form or QuadraticForm.empty_form(), self.system.free_vertices
        correction, *trial = np.zeros((3, self.system.num_vertices, 3))
        norm = ResidualNorm(self._norm_matrix, embed_factor(self.supernodal_factor, free), correction)
        return SearchArrays(objective.objective_terms, form, self.unpinned_trace, norm, *trial)


@dataclass(frozen=True, eq=False)
class PreparedDescent(IterativeSolver):
    """A descent method after the setup for a system.

    If a barrier is active at the initial guess, the solve starts at the inertial prediction, if that is lower. A nearly
    closed gap makes the Hessian so stiff that the direction of a common motion has no significant digits for the gap,
    which limits the step size.
    """

    fixed_objective: FixedObjective
    metric: ResidualMetric
    method: DescentMethod
    description: str
    stats: dict[str, float]

    @property
    def can_identify_saddles(self) -> bool:
        """Whether the method distinguishes saddles from minima."""
        return self.method.can_identify_saddles

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve.

        It starts at the inertial prediction if a barrier is active at the guess and the prediction is lower.

        Args:
            problem: the step.
            initial_guess: positions (n, 3) [m], which are not modified.
        """
        step, guess = self._build_step(problem, initial_guess)
        start = pick_lower_start(step, guess) if has_active_barrier(step, guess.positions) else guess
        return _DescentState(self, step, guess, start)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] at given positions.

        Args:
            problem: the step.
            p: positions (n, 3) [m].
        """
        return self.metric.residual(StepObjective(self.fixed_objective, problem).gradient(p))

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return compute_max_coordinate(problem) * self.metric.unpinned_trace**0.5

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration at the initial guess."""
        return self.method.iteration_phases(*self._build_step(problem, problem.initial_guess))

    def _build_step(self, problem: StepProblem, guess: Positions) -> tuple[StepObjective, DescentPoint]:
        step = StepObjective(self.fixed_objective, problem)
        p = step.apply_exact_pins(guess)
        return step, DescentPoint(p, step.gradient(p))


class _DescentState(SolverState):
    """The state of a solve; a stalled point has the previous positions."""

    def __init__(
        self, prepared: PreparedDescent, step: StepObjective, guess: DescentPoint, start: DescentPoint
    ) -> None:
        self._metric, self._method, self._step, self._guess = prepared.metric, prepared.method, step, guess
        self._points, self._point, self.positions = prepared.method.iterate_points(step, start), start, start.positions

    def step_state(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        before, self._point = self._point, next(self._points, self._point)
        self.positions = self._point.positions
        return not self._point.is_stalled or self.positions is not before.positions

    def compute_start_residual(self) -> float:
        """Return the residual at the initial guess [J^(1/2)]."""
        return self._metric.residual(self._guess.gradient)

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self._metric.residual(self._point.gradient)

    def can_terminate(self) -> bool:
        """Return whether the iterate may be a minimum if it is stationary."""
        return self._method.can_terminate(self._step, self._point)


class CompiledMethod(NamedTuple):
    """A compiled method for one system of springs and quadratic forms, in one thread.

    Attributes:
        kernel: kernel of the iteration loop.
        arrays: its arrays of the system.
        num_vectors: number of vectors (n, 3) that it carries from iteration to iteration.
        progress_dtype: type of the progress of a solve.
    """

    kernel: TypedKernel
    arrays: Any
    num_vectors: int
    progress_dtype: np.dtype


class CompiledDescentState(CompiledState):
    """The state of a solve by a compiled method.

    Attributes:
        gradient: gradient at the positions (n, 3) [N].
        progress: progress of the solve (1,).
    """

    def __init__(self, method: CompiledMethod, step: StepObjective, start: DescentPoint) -> None:
        """Prepare a solve, which the first call of the kernel starts.

        Args:
            method: the method.
            step: the objective.
            start: first point, whose arrays are overwritten.
        """
        self._step, self._kernel = step, method.kernel
        self.positions, self.gradient = start.positions, start.gradient
        self.progress = np.zeros(1, method.progress_dtype)
        self._fixed_arguments = method.arrays, step.step_data, step.exact_pins
        self._vectors = np.zeros((method.num_vectors, *self.positions.shape))

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        vectors = self.positions, self.gradient, *self._vectors
        return self._kernel.call(*self._fixed_arguments, limits, *vectors, self.progress)

    def compute_start_residual(self) -> float:
        """Return the residual at the initial guess [J^(1/2)]."""
        return self.residual()

"""Projective dynamics with an aggregated Jacobi global step (A-Jacobi: Lan et al. 2022).

    p <- p - S grad g(p),   S = sum over i < l of (I - D^-1 Q)^i D^-1,   D the diagonal of Q

S grad g is the result of l Jacobi sweeps on Q x = grad g from x = 0. The sum is a sparse matrix that is computed once,
so an iteration is one pass over the springs and one product, whatever l is. Its rows extend over l - 1 rings of
neighbours. I - S Q = (I - D^-1 Q)^l, and the eigenvalues of D^-1 Q lie between 0 and 2, because Q is diagonally
dominant. Hence S and 2 S^-1 - Q are positive definite. As Q majorises the Hessian, no iteration raises the energy.
With bending terms the eigenvalues can exceed 2; D is then the diagonal times half of the largest eigenvalue.

The iterations are accelerated by Chebyshev polynomials, as Wang (2015) accelerates Jacobi's method
(`springbench.solvers.methods.quasi_newton.chebyshev`). They require nonnegative eigenvalues of I - S Q. For odd l, S is
therefore divided by the largest possible eigenvalue of S Q, 1 + (m - 1)^l, where m is that of D^-1 Q. The factor of Q
serves only to compute the residual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np
from scipy.sparse import csr_array, dia_array
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.kernels import quadratic_form_kernels
from springbench.solvers.kernels.accelerated_descent import AccelerationWindow
from springbench.solvers.kernels.acceleration_coefficients import CHEBYSHEV_RULE
from springbench.solvers.linalg.multigrid.smoothed_aggregation import estimate_largest_eigenvalue
from springbench.solvers.methods.local_global import aggregated_jacobi_kernel
from springbench.solvers.methods.local_global.accelerated_local_global import (
    AccelerationScheme,
    InterpretedState,
    allocate_window,
)
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.prefactored import (
    PreparedLocalGlobal,
    prepare_local_global,
    require_projective,
)
from springbench.solvers.model.step_problem import Positions, StepProblem, System, Unsupported
from springbench.solvers.model.system_matrix_assembly import drop_zeros
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

if TYPE_CHECKING:
    from springbench.solvers.methods.local_global.half_space_contact import ContactFreeSolver

_A_JACOBI_SCHEME = AccelerationScheme("a-jacobi", CHEBYSHEV_RULE, 1, 0, True)
_MAX_SWEEPS = 8
"""Maximum number of sweeps: with more, a row of S on a cloth has hundreds of entries."""

_MAX_SPRING_EIGENVALUE = 2.0 + 1e-12
"""Largest eigenvalue of D^-1 Q for springs, with an allowance for round-off."""


@dataclass(frozen=True)
class AggregatedJacobi:
    """Projective dynamics whose global step is a fixed number of Jacobi sweeps.

    Args:
        jacobi_sweeps: l, the number of Jacobi sweeps per iteration, 1 to 8.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "accelerated local-global",
        Citation(
            "Lan, Lei and Ma, Guanqun and Yang, Yin and Zheng, Changxi and Li, Minchen and Jiang, Chenfanfu",
            2022,
            "Penetration-free projective dynamics on the GPU",
            "10.1145/3528223.3530069",
        ),
        formula="p⁺ = p − S ∇g, S from Jacobi sweeps on Q",
        cost="1 sparse product, 1 pass, no factor",
    )

    jacobi_sweeps: int = 2

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        require_valid_sweeps(self.jacobi_sweeps)

    def prepare(self, system: System) -> PreparedAggregatedJacobi:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy is not projective, such as contact.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        if without_vertex_contact(system) is not system:
            raise Unsupported(
                "a-jacobi: its matrix is computed once from Q, which does not include contact of vertices "
                "(HalfSpaceContact); use numba, chebyshev or vbd"
            )
        energies = require_projective(system, "a-jacobi")
        measure = cast("ContactFreeSolver", CompiledLocalGlobal().prepare(system))
        base = prepare_local_global(
            system,
            energies,
            lambda Q: (AggregatedSweeps(Q, self.jacobi_sweeps), f"{self.jacobi_sweeps} sweeps of Jacobi"),
        )
        return PreparedAggregatedJacobi(base, measure, FixedObjective(system))


def require_valid_sweeps(sweeps: int) -> None:
    """Raise ValueError unless the number of sweeps is in the supported range."""
    if not 1 <= sweeps <= _MAX_SWEEPS:
        raise ValueError(f"jacobi_sweeps: should be from 1 to {_MAX_SWEEPS}, not {sweeps}")


class AggregatedSweeps:
    """Several Jacobi sweeps for Q x = b as one sparse matrix.

    The sweeps start at x = 0.

    Attributes:
        matrix: the matrix S.
        nonzeros: number of its stored entries.
    """

    def __init__(self, Q: csr_array, sweeps: int) -> None:
        n, largest = len(Q.indptr) - 1, estimate_largest_eigenvalue(Q, Q.diagonal())
        damped = 0.5 * largest if largest > _MAX_SPRING_EIGENVALUE else 1.0
        inverse = csr_array(dia_array((1.0 / (damped * Q.diagonal())[None, :], np.array([0])), shape=(n, n)))
        S = term = inverse
        for _ in range(sweeps - 1):
            term = csr_array(term - inverse @ (Q @ term))
            S = csr_array(S + term)
        if sweeps % 2:
            S = csr_array(S / (1.0 + max(0.0, largest / damped - 1.0) ** sweeps))
        self.matrix = drop_zeros(S)
        self.nonzeros: int | None = int(self.matrix.nnz)
        self._multiply_matrix = TypedKernel(quadratic_form_kernels.multiply_matrix)

    def solve(self, b: Positions, out: Positions) -> None:
        """Compute S b.

        Args:
            b: right-hand side (n, 3), C-contiguous.
            out: result (n, 3), C-contiguous, overwritten.
        """
        self._multiply_matrix.call(self.matrix.indptr, self.matrix.indices, self.matrix.data, b, out)


class PreparedAggregatedJacobi(IterativeSolver):
    """A-Jacobi, prepared for a system.

    Attributes:
        local_global: the local-global solver of Q, with S in place of its factor.
        residual_solver: computes the residual at p by one local-global iteration; it has no other use.
    """

    def __init__(self, base: PreparedLocalGlobal, measure: ContactFreeSolver, objective: FixedObjective) -> None:
        self.local_global, self.residual_solver, self.fixed_objective = base, measure, objective
        self.description = f"{base.description}; for the residual alone {measure.description}"
        self.stats = base.stats
        self._engine = (
            _CompiledEngine(base.system, base.factor.matrix, objective)
            if isinstance(base.factor, AggregatedSweeps) and objective.is_springs_and_forms
            else None
        )

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        measure, step = self.residual_solver.build_residual(problem), StepObjective(self.fixed_objective, problem)
        if self._engine is None:
            return _InterpretedSweepState(measure, self.local_global, step, initial_guess)
        return _CompiledSweepState(measure, self._engine, step, initial_guess)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)], measured with the factor of Q.

        Args:
            problem: step whose objective is minimised.
            p: positions (n, 3) [m].
        """
        return self.residual_solver.build_residual(problem)(p)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return self.local_global.residual_scale(problem)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the gradient and the product with S as callables, at the initial guess."""
        step = StepObjective(self.fixed_objective, problem)
        p = step.apply_exact_pins(problem.initial_guess)
        gradient, out = step.gradient(p), np.zeros_like(p)
        return {"local": lambda: step.gradient(p), "global": lambda: self.local_global.solve_correction(gradient, out)}


class _InterpretedSweepState(InterpretedState):
    """State of an interpreted solve; residuals are measured with the factor of Q."""

    def __init__(
        self, measure: Callable[[Positions], float], base: PreparedLocalGlobal, step: StepObjective, guess: Positions
    ) -> None:
        super().__init__(base, _A_JACOBI_SCHEME, step, guess)
        self._compute_residual = measure

    def compute_start_residual(self) -> float:
        """Return the residual at the initial guess [J^(1/2)]."""
        return self.residual()

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self._compute_residual(self.positions)


class _CompiledEngine:
    """Compiled iterations for springs and quadratic forms, with the work arrays of solves."""

    def __init__(self, system: System, S: csr_array, objective: FixedObjective) -> None:
        free, self._num_vertices = system.free_vertices, system.num_vertices
        pointers = np.zeros(self._num_vertices + 1, S.indptr.dtype)
        pointers[free + 1] = np.diff(S.indptr)
        columns = free.astype(S.indices.dtype)[S.indices]
        self._sweep_matrix = aggregated_jacobi_kernel.SweepMatrix(
            np.cumsum(pointers, dtype=pointers.dtype), columns, S.data
        )
        self._objective_arguments = objective.objective_terms, objective.quadratic_form
        self.free_memory: list[_Memory] = []
        self.start_jacobi_solve, self.run_jacobi_solve = (
            TypedKernel(aggregated_jacobi_kernel.start_jacobi_solve),
            TypedKernel(aggregated_jacobi_kernel.run_jacobi_solve),
        )

    def _allocate_memory(self) -> _Memory:
        size = 3 * self._num_vertices
        window, correction = allocate_window(_A_JACOBI_SCHEME, size, size), np.zeros(size)
        views = (x.reshape(-1, 3) for x in (window.position, window.trial_position, window.trial_descent, correction))
        return aggregated_jacobi_kernel.SweepVectors(*views, correction_entries=correction), window

    def build_step(self, step: StepObjective) -> aggregated_jacobi_kernel.JacobiStep:
        """Build the arguments of the kernels for a step, with work arrays of their own."""
        memory = self.free_memory.pop() if self.free_memory else self._allocate_memory()
        return aggregated_jacobi_kernel.JacobiStep(
            *self._objective_arguments, step.step_data, step.exact_pins, self._sweep_matrix, *memory
        )


_Memory = tuple[aggregated_jacobi_kernel.SweepVectors, AccelerationWindow]
"""Work arrays of a solve."""


class _CompiledSweepState(SolverState):
    """State of a compiled solve, whose work arrays return to the engine."""

    def __init__(
        self, measure: Callable[[Positions], float], engine: _CompiledEngine, step: StepObjective, guess: Positions
    ) -> None:
        self._compute_residual, self._engine = measure, engine
        self._step = engine.build_step(step)
        engine.start_jacobi_solve.call(self._step, as_kernel_array(guess))
        self.positions = step.apply_exact_pins(guess)

    def step_state(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        return self.run_unchecked(1) == 1

    def run_unchecked(self, num_iterations: int) -> int:
        """Do iterations up to the first that fails; return how many succeeded."""
        return self._engine.run_jacobi_solve.call(self._step, num_iterations, self.positions)

    def compute_start_residual(self) -> float:
        """Return the residual at the initial guess [J^(1/2)]."""
        return self.residual()

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self._compute_residual(self.positions)

    def __del__(self) -> None:
        self._engine.free_memory.append((self._step.vectors, self._step.window))

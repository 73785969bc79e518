"""The local-global iteration over a prefactored Q, independent of the backend of its two steps.

The method is described in `springbench.solvers.methods.local_global.reference_local_global`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState, compute_max_coordinate
from springbench.solvers.kernels import objective_kernels, quadratic_form_kernels
from springbench.solvers.linalg.direct_solvers import DenseCholesky, LinearSolver
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.solve_accuracy import diagonal_dominance_ratio
from springbench.solvers.model.step_problem import (
    Energy,
    Positions,
    ProjectiveEnergy,
    ResidualIterate,
    StepProblem,
    System,
    Unsupported,
    is_lagged,
)

LocalStep = Callable[[Positions, Positions, Positions], None]
"""A function (p, y, out) that writes y + A'K d(p) to `out`."""


_FACTOR_STATS = {"nnz_factor": "nonzeros", "factor_bytes": "factor_bytes", "flops_per_solve": "flops"}
"""Statistics of a factor, by the attribute that provides them, if any."""


@dataclass(frozen=True, eq=False)
class PreparedLocalGlobal(IterativeSolver):
    """The iteration with any backend's local step, factor and norm.

    Attributes:
        system: the system.
        local_step: local step.
        factor: factor of Q's free rows and columns.
        pin_coupling: Q's free rows and exactly pinned columns (f, x).
        energy_norm: |e|_Q [J^(1/2)] of a displacement that vanishes at the pins.
        unpinned_trace: trace of the unpinned part of Q [N/m].
        stats: exact counts of the setup.
        description: description of the linear solver.
        build_lagged_step: builder of the local step of a problem, if it depends on the problem.
        correction_matrix: Q's free rows and columns if the factor has low precision. The iteration then solves for
            corrections, p + Q^-1 (b - Q p), and the fixed point stays accurate to float64.
        diagonal_dominance_ratio: max_i Q_ii / (Q 1)_i over the free rows and columns, half of a bound on the condition
            number.

    Example:
        >>> import numpy as np
        >>> system = springbench.System(mass=np.ones(1), time_step=0.5)
        >>> prepared = springbench.prepare_local_global(system, [], lambda Q: (springbench.SparseLU(Q), "SuperLU"))
        >>> prepared.description, prepared.unpinned_trace
        ('SuperLU', 4.0)
    """

    residual_iterate: ClassVar[ResidualIterate] = "previous"

    system: System
    local_step: LocalStep
    factor: LinearSolver
    pin_coupling: csr_array
    energy_norm: Callable[[Positions], float]
    unpinned_trace: float
    stats: dict[str, float]
    description: str
    build_lagged_step: Callable[[StepProblem], LocalStep] | None = None
    correction_matrix: csr_array | None = None
    diagonal_dominance_ratio: float = 1.0

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return LocalGlobalState(self, problem, initial_guess)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return compute_max_coordinate(problem) * self.unpinned_trace**0.5

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the local and the global step at the initial guess, as callables."""
        constant, b = self.constant_right_hand_side(problem), np.empty_like(problem.inertial_target)
        p = vertex_terms.apply_exact_pins(problem.initial_guess, problem)
        out, project = p.copy(), self.local_step_of(problem)

        def local() -> Positions:
            project(p, constant, b)
            return b

        def whole() -> Positions:
            self.solve_positions(b, p, out)
            return out

        local()
        return {"local": local, "global": whole}

    def local_step_of(self, problem: StepProblem) -> LocalStep:
        """Return the local step of a problem."""
        return self.build_lagged_step(problem) if self.build_lagged_step else self.local_step

    def constant_right_hand_side(self, problem: StepProblem) -> Positions:
        """Return y, with the exact pins' columns of Q moved to the right-hand side."""
        s, y = self.system, np.empty(problem.inertial_target.shape)
        step_arrays = problem.inertial_target, problem.external_force, problem.pin_targets
        objective_kernels.sum_constant_forces(s.inertia_diagonal, s.pins.vertices, s.pins.weight, *step_arrays, y)
        exact, _ = s.exact_pins
        if len(exact):
            y[s.free_vertices] -= self.pin_coupling @ problem.pin_targets[exact]
        return y

    def solve_correction(self, b: Positions, out: Positions) -> Positions:
        """Write Q^-1 b, without refinement of the factor's precision, to `out`; return `out`.

        Exactly pinned vertices of `out` are not changed.

        Args:
            b: right-hand side (n, 3), as a gradient [N].
            out: correction (n, 3) [m].
        """
        free = self.system.free_vertices
        if len(free) == len(b):
            self.factor.solve(b, out)
        elif len(free):
            solved = np.empty((len(free), 3))
            self.factor.solve(b[free], solved)
            out[free] = solved
        return out

    def solve_positions(self, b: Positions, p: Positions, out: Positions) -> None:
        """Write the solution of Q p = b to `out`.

        A low-precision factor solves for the correction of p.

        Args:
            b: right-hand side (n, 3) [N].
            p: approximate solution (n, 3) [m], read only for a low-precision factor.
            out: solution (n, 3) [m], not `p` itself; exactly pinned vertices are not changed.
        """
        if self.correction_matrix is None:
            self.solve_correction(b, out)
            return
        free, left = self.system.free_vertices, b.copy()
        left[free] -= self.correction_matrix @ p[free]
        self.solve_correction(left, out)
        out[free] += p[free]

    def correction_residual(self, e: Positions) -> float:
        """Return |e|_Q [J^(1/2)] of a displacement (n, 3) [m] over the unpinned vertices.

        The pinned rows are set to zero.
        """
        e[self.system.pins.vertices] = 0.0
        return self.energy_norm(e)


class LocalGlobalState(SolverState):
    """The state of a local-global solve with two alternating position arrays.

    Attributes:
        right_hand_side: y (n, 3) [N].
    """

    def __init__(self, base: PreparedLocalGlobal, problem: StepProblem, guess: Positions) -> None:
        self.base, self._local_step = base, base.local_step_of(problem)
        self.right_hand_side, self._b = base.constant_right_hand_side(problem), np.empty_like(problem.inertial_target)
        self.positions, self._previous_positions = (
            vertex_terms.apply_exact_pins(guess, problem),
            vertex_terms.apply_exact_pins(problem.current_positions, problem),
        )
        self._has_stepped = False

    def step_state(self) -> bool:
        """Do one iteration; return True."""
        p = self.positions
        self._local_step(p, self.right_hand_side, self._b)
        self.base.solve_positions(self._b, p, self._previous_positions)
        self.positions, self._previous_positions, self._has_stepped = self._previous_positions, p, True
        return True

    def residual(self) -> float:
        """Return |p - LG(p)|_Q of the previous positions p."""
        return (
            self.base.correction_residual(self._previous_positions - self.positions)
            if self._has_stepped
            else float("nan")
        )


def require_projective(system: System, solver: str) -> list[ProjectiveEnergy]:
    """Return the system's energies, all of them projective.

    Args:
        system: system whose energies are checked.
        solver: name of the method for the error message.

    Raises:
        Unsupported: other energies, with their names.

    Example:
        >>> import numpy as np
        >>> springbench.require_projective(springbench.System(mass=np.ones(1), time_step=0.5), "my-method")
        []
    """
    energies = [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
    if len(energies) < len(system.energies):
        others = {type(e).__name__ for e in system.energies if not isinstance(e, ProjectiveEnergy)}
        raise Unsupported(f"{solver}: local-global needs projective energies; not so: {', '.join(sorted(others))}")
    return energies


def require_only_springs(system: System, solver: str) -> Springs:
    """Return the system's springs as one energy.

    Args:
        system: system whose energies are checked.
        solver: name of the method for the error message.

    Raises:
        Unsupported: energies other than springs, with their names.
    """
    others = {type(energy).__name__ for energy in system.energies if not isinstance(energy, Springs)}
    if others:
        raise Unsupported(f"{solver}: supports springs only; the scene has {', '.join(sorted(others))} as well")
    return Springs.from_parts([energy for energy in system.energies if isinstance(energy, Springs)])


def prepare_local_global(
    system: System,
    energies: Sequence[ProjectiveEnergy],
    factorise: Callable[[csr_array], tuple[LinearSolver, str]],
    *,
    is_low_precision: bool = False,
) -> PreparedLocalGlobal:
    """Prepare the iteration from the energies' local steps and a factor of Q.

    Args:
        system: the system.
        energies: its projective energies.
        factorise: function of Q's free part that returns a factor and a description.
        is_low_precision: whether the factor is less precise than float64.

    Example:
        >>> import numpy as np
        >>> system = springbench.System(mass=np.ones(1), time_step=0.5)
        >>> prepared = springbench.prepare_local_global(system, [], lambda Q: (springbench.SparseLU(Q), "SuperLU"))
        >>> prepared.solve_correction(np.ones((1, 3)), np.zeros((1, 3))).tolist()
        [[0.25, 0.25, 0.25]]
    """
    Q = system_matrix_assembly.assemble_system_matrix(system, energies)
    free = system.free_vertices
    rows = Q if len(free) == system.num_vertices else csr_array(Q[free])
    exact = system.pins.vertices[system.pins.exact_mask]
    inner = rows if len(free) == system.num_vertices else csr_array(rows[:, free])
    factor, choice = factorise(inner) if len(free) else (DenseCholesky(np.eye(0)), "nothing to solve for")
    lagged = any(is_lagged(energy) for energy in energies)
    return PreparedLocalGlobal(
        system,
        _build_local_step(energies),
        factor,
        csr_array(rows[:, exact]),
        _build_energy_norm(Q),
        float(Q.diagonal()[system.unpinned_mask].sum()),
        collect_factor_stats(Q.nnz, factor),
        choice,
        (lambda problem: _build_local_step(problem.energies)) if lagged else None,
        inner if is_low_precision else None,
        diagonal_dominance_ratio(inner),
    )


def _build_energy_norm(Q: csr_array) -> Callable[[Positions], float]:
    """Build `system_matrix_assembly.energy_norm` of one matrix, without SciPy's checks of the arguments."""

    def compute_norm(e: Positions) -> float:
        product = np.empty_like(e)
        quadratic_form_kernels.multiply_matrix(Q.indptr, Q.indices, Q.data, e, product)
        return sqrt(max(float(np.einsum("ij,ij->", e, product)), 0.0))  # this order of arguments returns NaN for NaN

    return compute_norm


def _build_local_step(energies: Iterable[Energy]) -> LocalStep:
    projective = [energy for energy in energies if isinstance(energy, ProjectiveEnergy)]

    def project(p: Positions, y: Positions, out: Positions) -> None:
        out[:] = y
        for energy in projective:
            energy.add_projection(p, out)

    return project


def collect_factor_stats(entries: int, factor: LinearSolver) -> dict[str, float]:
    """Return the number of entries of Q, and the statistics that the factor provides.

    Args:
        entries: stored entries of Q.
        factor: linear solver; statistics without an attribute of it are omitted.
    """
    counts = {name: getattr(factor, attribute, None) for name, attribute in _FACTOR_STATS.items()}
    return {"nnz_system": float(entries)} | {name: float(n) for name, n in counts.items() if n is not None}

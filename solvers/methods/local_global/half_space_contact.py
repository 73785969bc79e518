"""Vertex contact for prefactored local-global methods.

Contact and friction are a low-rank change W of Q, which stays factorised:

    p <- p + x,   x = -(Q + W)^-1 (grad g(p) + U w gap),   W = U diag(w) U',  one column of U per contact row

The system is solved by Woodbury's formula while there are few rows, with the columns of Q^-1 of their vertices. Else it
is solved by conjugate gradients preconditioned by Q^-1; a few iterations suffice, since each iterate decreases the
model. A few active-set passes, each started at the last one's result, find which contacts become active. x then
minimises a majorant of the objective, except for friction, whose exact second derivatives are tried first. A step that
increases the objective nevertheless is repeated with the full majorant, and then shortened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array
from springbench.solvers.contact.half_space.vertex_contact import (
    PenaltyRows,
    VertexContactEnergy,
    begin_active_contacts,
    without_vertex_contact,
)
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState, compute_max_coordinate
from springbench.solvers.linalg.krylov import ConjugateGradientIteration
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal
from springbench.solvers.model.step_problem import (
    Positions,
    PreparedSolver,
    ResidualIterate,
    Solver,
    StepProblem,
    System,
)
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

_MAX_WOODBURY_ROWS = 900
"""Maximum number of rows for Woodbury's formula (300 sticking vertices); conjugate gradients are faster beyond it."""

_MAX_ACTIVE_SET_PASSES = 4
_MAX_HALVINGS = 12
_MAX_CG_ITERATIONS, _CG_RTOL = 60, 1e-3
"""Of conjugate gradients: maximum number of iterations, and relative tolerance in the norm of Q^-1."""


class ContactFreeSolver(PreparedSolver, Protocol):
    """A prepared local-global method of a system without contact."""

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Return the initial state of the iteration of a step.

        Args:
            problem: step in which no contact is active.
            initial_guess: positions (n, 3) [m], not modified.
        """
        ...

    def build_residual(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return the function that computes the residual of positions."""
        ...


def prepare_with_half_spaces(solver: Solver, system: System) -> PreparedHalfSpaceLocalGlobal:
    """Prepare a local-global method with vertex contact.

    Args:
        solver: the method without contact.
        system: the system, with contact.

    Raises:
        Unsupported: if the solver does not support the system without contact.
    """
    idle = cast("ContactFreeSolver", solver.prepare(without_vertex_contact(system)))
    base = find_prefactored(idle)
    return PreparedHalfSpaceLocalGlobal(
        replace(base, system=system), idle, FixedObjective(system), ContactCorrections(base)
    )


def find_prefactored(prepared: PreparedSolver) -> PreparedLocalGlobal:
    """Return the iteration through Python of a prepared local-global method.

    This is the method itself, or the iteration that it compiles.
    """
    compiled: Any = prepared
    return prepared if isinstance(prepared, PreparedLocalGlobal) else compiled.base


class ContactCorrections:
    """Minimisers of quadratic models with Q + W, using a factorisation of Q."""

    def __init__(self, base: PreparedLocalGlobal) -> None:
        self._base = base
        self._free = np.zeros(base.system.num_vertices, bool)
        self._free[base.system.free_vertices] = True
        self._column_cache: dict[int, NDArray[np.float64]] = {}

    def solve_without_contact(self, gradient: Positions) -> Positions:
        """Return Q^-1 gradient (n, 3), zero at exactly pinned vertices.

        A rounded factor is refined once, since the active set depends on the last digits.
        """
        out = np.zeros_like(gradient)
        self._base.solve_correction(gradient, out)
        if self._base.correction_matrix is not None:
            self._base.solve_positions(gradient, out.copy(), out)
        return out

    def residual_norm(self, contact_free_correction: Positions) -> float:
        """Return the residual |x|_Q [J^(1/2)] of a correction x (n, 3) over the unpinned vertices."""
        return self._base.correction_residual(contact_free_correction.copy())

    def solve_with_contact(
        self,
        contacts: list[VertexContactEnergy],
        p: Positions,
        gradient: Positions,
        contact_free_correction: Positions,
        *,
        majorise: bool,
    ) -> tuple[Positions, PenaltyRows]:
        """Return the displacement from p, and the contact rows found for it.

        Args:
            contacts: active vertex contacts.
            p: positions (n, 3) [m].
            gradient: gradient at p (n, 3) [N].
            contact_free_correction: Q^-1 gradient (n, 3).
            majorise: whether friction majorises the energy.
        """
        x, rows = -contact_free_correction, None
        for _ in range(_MAX_ACTIVE_SET_PASSES):
            found = self._concatenate_rows(
                [contact.build_penalty_rows(p, p + x, majorise=majorise) for contact in contacts]
            )
            if rows is not None and np.array_equal(found.vertices, rows.vertices):
                break
            rows = found
            x = self.solve_with_rows(rows, gradient, contact_free_correction)
        assert rows is not None
        return x, rows

    def solve_with_rows(self, rows: PenaltyRows, gradient: Positions, contact_free_correction: Positions) -> Positions:
        """Return the minimiser x of the model with the given rows.

        Args:
            rows: contact rows of free vertices with positive stiffness.
            gradient: gradient of the objective (n, 3) [N].
            contact_free_correction: Q^-1 gradient (n, 3) [m].

        Returns:
            Displacement (n, 3) [m], by Woodbury's formula for few rows, else by conjugate gradients.
        """
        if not len(rows.vertices):
            return -contact_free_correction
        return (self._solve_woodbury if len(rows.vertices) <= _MAX_WOODBURY_ROWS else self._solve_cg)(
            rows, gradient, contact_free_correction
        )

    def _concatenate_rows(self, parts: list[PenaltyRows]) -> PenaltyRows:
        """Return all rows of free vertices with positive stiffness."""
        vertices, direction, weight, gap = (np.concatenate(field) for field in zip(*parts, strict=True))
        active = self._free[vertices] & (weight > 0.0)
        return PenaltyRows(vertices[active], direction[active], weight[active], gap[active])

    def _solve_woodbury(self, rows: PenaltyRows, gradient: Positions, contact_free_correction: Positions) -> Positions:
        vertices, place = np.unique(rows.vertices, return_inverse=True)
        columns = self._inverse_columns(vertices)
        K = columns[vertices][np.ix_(place, place)] * (rows.direction @ rows.direction.T)
        K[np.diag_indices(len(K))] += 1.0 / rows.stiffness
        along = np.einsum("ij,ij->i", rows.direction, contact_free_correction[rows.vertices])
        force = cho_solve(cho_factor(K, lower=True), rows.gap - along)
        pushed = np.zeros((len(vertices), 3))
        np.add.at(pushed, place, force[:, None] * rows.direction)
        return -contact_free_correction - columns @ pushed

    def _inverse_columns(self, vertices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the columns (n, k) of Q^-1 of vertices.

        They are cached since contacts recur; each solve yields three columns.
        """
        missing = [v for v in vertices.tolist() if v not in self._column_cache]
        if len(self._column_cache) > 4 * _MAX_WOODBURY_ROWS:
            self._column_cache, missing = {}, vertices.tolist()
        for k in range(0, len(missing), 3):
            some = missing[k : k + 3]
            unit = np.zeros((len(self._free), 3))
            unit[some, np.arange(len(some))] = 1.0
            self._column_cache.update(zip(some, self.solve_without_contact(unit).T.copy(), strict=False))
        return np.array([self._column_cache[v] for v in vertices.tolist()]).T

    def _solve_cg(self, rows: PenaltyRows, gradient: Positions, contact_free_correction: Positions) -> Positions:
        """Solve by conjugate gradients.

        The product of Q with a direction follows from the residuals to which Q^-1 is applied.
        """
        U = _build_direction_matrix(rows, len(contact_free_correction))
        pulls = csr_array(U * rows.stiffness) @ U.T
        model = ContactQuadraticModel(
            self.solve_without_contact, pulls, -gradient - (U @ (rows.stiffness * rows.gap)).reshape(-1, 3)
        )
        model.run_iterations(model.residual_product, _MAX_CG_ITERATIONS)
        return model.x


class ContactQuadraticModel(ConjugateGradientIteration):
    """Conjugate gradients for (Q + W) x = b, preconditioned by Q^-1.

    Args:
        solve: product with Q^-1.
        contact_matrix: W (3n, 3n) [N/m].
        b: right-hand side (n, 3) [N], overwritten.
    """

    def __init__(self, solve: Callable[[Positions], Positions], contact_matrix: csr_array, b: Positions) -> None:
        self._solve, self._contact_matrix, self._residual = solve, contact_matrix, b
        self.x: Positions = np.zeros_like(b)
        self._direction, self._image = np.zeros_like(b), np.zeros_like(b)
        self.residual_product = self._apply_preconditioner()
        self._target_product = _CG_RTOL**2 * self.residual_product

    def _apply_preconditioner(self) -> float:
        self._z = self._solve(self._residual)
        return float(np.vdot(self._residual, self._z))

    def update_direction(self, product: float, previous_product: float) -> float:
        """Update the search direction p; return its curvature p'(Q + W)p [J].

        Args:
            product: r'z of the iterate [J].
            previous_product: r'z of the iterate before [J]; infinite at first.
        """
        scale = product / previous_product
        self._direction, self._image = self._z + scale * self._direction, self._residual + scale * self._image
        self._product = self._image + (self._contact_matrix @ self._direction.ravel()).reshape(-1, 3)
        return float(np.vdot(self._direction, self._product))

    def update_iterate(self, product: float, curvature: float) -> float:
        """Update the iterate; return the preconditioned residual product r'z [J].

        Args:
            product: r'z before the update [J].
            curvature: p'(Q + W)p of the current direction [J].
        """
        length = product / curvature
        self.x += length * self._direction
        self._residual -= length * self._product
        return self._apply_preconditioner()

    def is_converged(self, product: float) -> bool:
        """Return whether the residual product has reached the tolerance."""
        return product <= self._target_product


def _build_direction_matrix(rows: PenaltyRows, n: int) -> csr_array:
    """Return U (3n, r): the direction of each row, at its vertex."""
    places = (3 * rows.vertices[:, None] + np.arange(3)).ravel(), np.repeat(np.arange(len(rows.vertices)), 3)
    return csr_array(coo_array((rows.direction.ravel(), places), shape=(3 * n, len(rows.vertices))))


@dataclass(frozen=True, eq=False)
class PreparedHalfSpaceLocalGlobal(IterativeSolver):
    """Local-global iterations with vertex contact.

    Attributes:
        base: the prefactored Q.
        contact_free: the method used while no contact is active.
        fixed_objective: objective of the system.
        corrections: minimisers with contact.
    """

    residual_iterate: ClassVar[ResidualIterate] = "previous"

    base: PreparedLocalGlobal
    contact_free: ContactFreeSolver
    fixed_objective: FixedObjective
    corrections: ContactCorrections

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.contact_free.stats

    @property
    def description(self) -> str:
        """Description of the linear solver."""
        return (
            f"{self.contact_free.description}; contact by Woodbury's formula, beyond "
            f"{_MAX_WOODBURY_ROWS} rows by conjugate gradients"
        )

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Return the initial state of a step; that of the contact-free method without active contact.

        Args:
            problem: step with vertex contact.
            initial_guess: positions (n, 3) [m], not modified.
        """
        contacts = begin_active_contacts(problem)
        if not contacts:
            return self.contact_free.init_state(problem, initial_guess)
        step = StepObjective(self.fixed_objective, problem)
        return _HalfSpaceState(self.corrections, step, contacts, step.apply_exact_pins(initial_guess))

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the scale of the residual."""
        return compute_max_coordinate(problem) * self.base.unpinned_trace**0.5

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)]; no iteration is needed while contacts are active.

        Args:
            problem: step with vertex contact.
            p: positions (n, 3) [m].
        """
        return self.build_residual(problem)(p)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the contact-free method's phases; with contact an iteration has no separable phases."""
        return {} if begin_active_contacts(problem) else self.contact_free.iteration_phases(problem)

    def build_residual(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return the function that computes the residual of positions."""
        if not begin_active_contacts(problem):
            return self.contact_free.build_residual(problem)
        step = StepObjective(self.fixed_objective, problem)
        return lambda p: self.corrections.residual_norm(self.corrections.solve_without_contact(step.gradient(p)))


class _HalfSpaceState(SolverState):
    """Iteration state; no position has a higher objective than the previous one."""

    def __init__(
        self, corrections: ContactCorrections, step: StepObjective, contacts: list[VertexContactEnergy], p: Positions
    ) -> None:
        self._corrections, self._step, self._contacts = corrections, step, contacts
        self.positions = p
        self._contact_free_correction: Positions | None = None

    def step_state(self) -> bool:
        """Perform one iteration."""
        gradient = self._step.gradient(self.positions)
        self._contact_free_correction = self._corrections.solve_without_contact(gradient)
        self.positions = self._next_positions(self.positions, gradient, self._contact_free_correction)
        return True

    def residual(self) -> float:
        """Return the residual of the previous positions."""
        return (
            float("nan")
            if self._contact_free_correction is None
            else self._corrections.residual_norm(self._contact_free_correction)
        )

    def _next_positions(self, p: Positions, gradient: Positions, contact_free_correction: Positions) -> Positions:
        """Return a position with an objective not above that of p.

        It is p itself if round-off prevents any descent.
        """
        x, length = np.zeros_like(p), 1.0
        for attempt in range(2 + _MAX_HALVINGS):
            if attempt < 2:
                x, _ = self._corrections.solve_with_contact(
                    self._contacts, p, gradient, contact_free_correction, majorise=attempt > 0
                )
            else:
                length *= 0.5
            q = self._step.apply_exact_pins(p + length * x)
            rise, noise = self._step.objective_change(p, q)
            if rise <= noise:
                return q
        return p

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
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array

from solvers.contact.touching import ContactEnergy, ContactRows, touching, without_contact
from solvers.core.driver import Iterating, Iterative, largest
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.prefactored import PreparedLocalGlobal
from solvers.linear.krylov import Iteration
from solvers.problem import Positions, Prepared, ResidualOf, Solver, StepProblem, System

_FEW = 900
"""Maximum number of rows for Woodbury's formula, of 300 sticking vertices; beyond it conjugate gradients are faster."""

_PASSES = 4
_HALVINGS = 12
_ITERATIONS, _TOLERANCE = 60, 1e-3
"""Of conjugate gradients: maximum number of iterations, and relative tolerance in the norm of Q^-1."""


class Idle(Prepared, Protocol):
    """A prepared local-global method of a system without contact."""

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Return the initial state of the iteration of a step."""
        ...

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return the function that computes the residual of positions."""
        ...


def local_global(solver: Solver, system: System) -> PreparedContact:
    """Prepare a local-global method with vertex contact.

    Args:
        solver: the method without contact.
        system: the system, with contact.

    Raises:
        Unsupported: if the solver does not support the system without contact.
    """
    idle: Any = solver.prepare(without_contact(system))
    base = idle if isinstance(idle, PreparedLocalGlobal) else idle.base
    return PreparedContact(replace(base, system=system), idle, Objective(system), Corrections(base))


class Corrections:
    """Minimisers of quadratic models with Q + W, using a factorisation of Q."""

    def __init__(self, base: PreparedLocalGlobal) -> None:
        self._base = base
        self._free = np.zeros(base.system.vertices, bool)
        self._free[base.system.free] = True
        self._columns: dict[int, NDArray[np.float64]] = {}

    def plain(self, gradient: Positions) -> Positions:
        """Return Q^-1 gradient (n, 3), zero at exactly pinned vertices.

        A rounded factor is refined once, since the active set depends on the last digits.
        """
        out = np.zeros_like(gradient)
        self._base.correction(gradient, out)
        if self._base.rounded is not None:
            self._base.toward(gradient, out.copy(), out)
        return out

    def residual(self, plain: Positions) -> float:
        """Return the residual |plain|_Q [J^(1/2)] over the unpinned vertices."""
        return self._base.residual(plain.copy())

    def around(
        self, contacts: list[ContactEnergy], p: Positions, gradient: Positions, plain: Positions, *, cautious: bool
    ) -> tuple[Positions, ContactRows]:
        """Return the displacement from p, and the contact rows found for it.

        Args:
            contacts: active vertex contacts.
            p: positions (n, 3) [m].
            gradient: gradient at p (n, 3) [N].
            plain: Q^-1 gradient (n, 3).
            cautious: whether friction majorises the energy.
        """
        x, rows = -plain, None
        for _ in range(_PASSES):
            found = self._joined([contact.rows(p, p + x, cautious=cautious) for contact in contacts])
            if rows is not None and np.array_equal(found.vertices, rows.vertices):
                break
            rows = found
            x = self.displacement(rows, gradient, plain)
        assert rows is not None
        return x, rows

    def displacement(self, rows: ContactRows, gradient: Positions, plain: Positions) -> Positions:
        """Return the minimiser x of the model with the given rows."""
        if not len(rows.vertices):
            return -plain
        return (self._woodbury if len(rows.vertices) <= _FEW else self._iterated)(rows, gradient, plain)

    def _joined(self, parts: list[ContactRows]) -> ContactRows:
        """Return all rows of free vertices with positive stiffness."""
        vertices, direction, weight, gap = (np.concatenate(field) for field in zip(*parts, strict=True))
        kept = self._free[vertices] & (weight > 0.0)
        return ContactRows(vertices[kept], direction[kept], weight[kept], gap[kept])

    def _woodbury(self, rows: ContactRows, gradient: Positions, plain: Positions) -> Positions:
        vertices, place = np.unique(rows.vertices, return_inverse=True)
        columns = self._inverse(vertices)
        K = columns[vertices][np.ix_(place, place)] * (rows.direction @ rows.direction.T)
        K[np.diag_indices(len(K))] += 1.0 / rows.weight
        along = np.einsum("ij,ij->i", rows.direction, plain[rows.vertices])
        force = cho_solve(cho_factor(K, lower=True), rows.gap - along)
        pushed = np.zeros((len(vertices), 3))
        np.add.at(pushed, place, force[:, None] * rows.direction)
        return -plain - columns @ pushed

    def _inverse(self, vertices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the columns (n, k) of Q^-1 of vertices, cached since contacts recur; each solve gives three."""
        missing = [v for v in vertices.tolist() if v not in self._columns]
        if len(self._columns) > 4 * _FEW:
            self._columns, missing = {}, vertices.tolist()
        for k in range(0, len(missing), 3):
            some = missing[k : k + 3]
            unit = np.zeros((len(self._free), 3))
            unit[some, np.arange(len(some))] = 1.0
            self._columns.update(zip(some, self.plain(unit).T.copy(), strict=False))
        return np.array([self._columns[v] for v in vertices.tolist()]).T

    def _iterated(self, rows: ContactRows, gradient: Positions, plain: Positions) -> Positions:
        """Solve by conjugate gradients; Q times a direction follows from the residuals that Q^-1 is applied to."""
        U = _columns(rows, len(plain))
        pulls = csr_array(U * rows.weight) @ U.T
        model = Model(self.plain, pulls, -gradient - (U @ (rows.weight * rows.gap)).reshape(-1, 3))
        model.iterate(model.product, _ITERATIONS)
        return model.x


class Model(Iteration):
    """Conjugate gradients for (Q + W) x = b, preconditioned by Q^-1.

    solve: product with Q^-1; pulls: W (3n, 3n).
    """

    def __init__(self, solve: Callable[[Positions], Positions], pulls: csr_array, b: Positions) -> None:
        self._solve, self._pulls, self._residual = solve, pulls, b
        self.x: Positions = np.zeros_like(b)
        self._along, self._image = np.zeros_like(b), np.zeros_like(b)
        self.product = self._preconditioned()
        self._enough = _TOLERANCE**2 * self.product

    def _preconditioned(self) -> float:
        self._z = self._solve(self._residual)
        return float(np.vdot(self._residual, self._z))

    def turn(self, product: float, before: float) -> float:
        """Update the search direction; return its curvature."""
        scale = product / before
        self._along, self._image = self._z + scale * self._along, self._residual + scale * self._image
        self._product = self._image + (self._pulls @ self._along.ravel()).reshape(-1, 3)
        return float(np.vdot(self._along, self._product))

    def go(self, product: float, curvature: float) -> float:
        """Update the iterate; return the preconditioned residual product."""
        length = product / curvature
        self.x += length * self._along
        self._residual -= length * self._product
        return self._preconditioned()

    def near(self, product: float) -> bool:
        """Return whether the residual product has reached the tolerance."""
        return product <= self._enough


def _columns(rows: ContactRows, n: int) -> csr_array:
    """Return U (3n, r): the direction of each row, at its vertex."""
    places = (3 * rows.vertices[:, None] + np.arange(3)).ravel(), np.repeat(np.arange(len(rows.vertices)), 3)
    return csr_array(coo_array((rows.direction.ravel(), places), shape=(3 * n, len(rows.vertices))))


@dataclass(frozen=True, eq=False)
class PreparedContact(Iterative):
    """Local-global iterations with vertex contact.

    Attributes:
        base: the prefactored Q.
        idle: the method used while no contact is active.
        objective: objective of the system.
        corrections: minimisers with contact.
    """

    residual_of: ClassVar[ResidualOf] = "previous"

    base: PreparedLocalGlobal
    idle: Idle
    objective: Objective
    corrections: Corrections

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.idle.facts

    @property
    def choice(self) -> str:
        """Description of the linear solver."""
        return f"{self.idle.choice}; contact by Woodbury's formula, beyond {_FEW} rows by conjugate gradients"

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Return the initial state of a step; that of the contact-free method without active contact."""
        contacts = touching(problem)
        if not contacts:
            return self.idle.begin(problem, guess)
        step = StepObjective(self.objective, problem)
        return _Iterating(self.corrections, step, contacts, step.placed(guess))

    def scale(self, problem: StepProblem) -> float:
        """Return the scale of the residual."""
        return largest(problem) * self.base.trace**0.5

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual at p; no iteration is needed while contacts are active."""
        return self.gauge(problem)(p)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the contact-free method's phases; with contact an iteration has no separable phases."""
        return {} if touching(problem) else self.idle.phases(problem)

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return the function that computes the residual of positions."""
        if not touching(problem):
            return self.idle.gauge(problem)
        step = StepObjective(self.objective, problem)
        return lambda p: self.corrections.residual(self.corrections.plain(step.gradient(p)))


class _Iterating(Iterating):
    """Iteration state; no position has a higher objective than the previous one."""

    def __init__(
        self, corrections: Corrections, step: StepObjective, contacts: list[ContactEnergy], p: Positions
    ) -> None:
        self._corrections, self._step, self._contacts = corrections, step, contacts
        self.positions = p
        self._plain: Positions | None = None

    def advance(self) -> bool:
        """Perform one iteration."""
        gradient = self._step.gradient(self.positions)
        self._plain = self._corrections.plain(gradient)
        self.positions = self._following(self.positions, gradient, self._plain)
        return True

    def residual(self) -> float:
        """Return the residual of the previous positions."""
        return float("nan") if self._plain is None else self._corrections.residual(self._plain)

    def _following(self, p: Positions, gradient: Positions, plain: Positions) -> Positions:
        """Return a position with an objective not above that of p; p itself if round-off prevents any descent."""
        x, length = np.zeros_like(p), 1.0
        for attempt in range(2 + _HALVINGS):
            if attempt < 2:
                x, _ = self._corrections.around(self._contacts, p, gradient, plain, cautious=attempt > 0)
            else:
                length *= 0.5
            q = self._step.placed(p + length * x)
            rise, noise = self._step.rise(p, q)
            if rise <= noise:
                return q
        return p

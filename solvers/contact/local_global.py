"""Contact for the prefactored methods: what presses and grips is a small change W of Q, and Q stays factorised.

    p <- p + x,   x = -(Q + W)^-1 (grad g(p) + U w gap),   W = U diag(w) U',  one column of U a row of contact

by Woodbury's formula while there are few rows, with the columns of Q^-1 that belong to their vertices, else by
conjugate gradients that Q^-1 preconditions (a few of them: they descend in the model wherever they are stopped). Which
vertices begin to press is found by a few repetitions, each from the last one's end. Then x minimises a majorant of the
objective, friction aside, whose second derivatives are exact first; a step that raises the objective nevertheless is
repeated with all of the majorant, and shortened.
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
"""Rows up to which their matrix is factorised: 300 vertices that stick. It takes as long as conjugate gradients do."""

_PASSES = 4
_HALVINGS = 12
_ITERATIONS, _TOLERANCE = 60, 1e-3
"""Of conjugate gradients, in the norm of Q^-1."""


class Idle(Prepared, Protocol):
    """A local-global method, ready for a system without contact."""

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """See Iterative."""
        ...

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """See Iterative."""
        ...


def local_global(solver: Solver, system: System) -> PreparedContact:
    """A local-global method with contact; raises what the solver raises for the system without it."""
    idle: Any = solver.prepare(without_contact(system))
    base = idle if isinstance(idle, PreparedLocalGlobal) else idle.base
    return PreparedContact(replace(base, system=system), idle, Objective(system), Corrections(base))


class Corrections:
    """Minimisers of quadratic models with Q + W, over a factor of Q."""

    def __init__(self, base: PreparedLocalGlobal) -> None:
        self._base = base
        self._free = np.zeros(base.system.vertices, bool)
        self._free[base.system.free] = True
        self._columns: dict[int, NDArray[np.float64]] = {}

    def plain(self, gradient: Positions) -> Positions:
        """Q^-1 gradient, (n, 3), zero at exactly pinned vertices; of a rounded factor refined once, for which vertices
        touch is decided by the last digits."""
        out = np.zeros_like(gradient)
        self._base.correction(gradient, out)
        if self._base.rounded is not None:
            self._base.toward(gradient, out.copy(), out)
        return out

    def residual(self, plain: Positions) -> float:
        """|plain|_Q [J^(1/2)] over the unpinned vertices."""
        return self._base.residual(plain.copy())

    def around(
        self, contacts: list[ContactEnergy], p: Positions, gradient: Positions, plain: Positions, *, cautious: bool
    ) -> tuple[Positions, ContactRows]:
        """The displacement from p, and the rows that were found for it; plain: Q^-1 gradient."""
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
        """x of the model with these rows."""
        if not len(rows.vertices):
            return -plain
        return (self._woodbury if len(rows.vertices) <= _FEW else self._iterated)(rows, gradient, plain)

    def _joined(self, parts: list[ContactRows]) -> ContactRows:
        """All rows of free vertices that resist."""
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
        """The columns (n, k) of Q^-1 of some vertices, three a solve; they are kept, for they press again."""
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
        """Conjugate gradients; Q times a direction follows from the residuals that Q^-1 was asked for."""
        U = _columns(rows, len(plain))
        pulls = csr_array(U * rows.weight) @ U.T
        model = Model(self.plain, pulls, -gradient - (U @ (rows.weight * rows.gap)).reshape(-1, 3))
        model.iterate(model.product, _ITERATIONS)
        return model.x


class Model(Iteration):
    """(Q + W) x = b, preconditioned by Q^-1; solve: Q^-1 of it; pulls: W (3n, 3n)."""

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
        """See Iteration."""
        scale = product / before
        self._along, self._image = self._z + scale * self._along, self._residual + scale * self._image
        self._product = self._image + (self._pulls @ self._along.ravel()).reshape(-1, 3)
        return float(np.vdot(self._along, self._product))

    def go(self, product: float, curvature: float) -> float:
        """See Iteration."""
        length = product / curvature
        self.x += length * self._along
        self._residual -= length * self._product
        return self._preconditioned()

    def near(self, product: float) -> bool:
        """See Iteration."""
        return product <= self._enough


def _columns(rows: ContactRows, n: int) -> csr_array:
    """U (3n, r): the direction of each row, at its vertex."""
    places = (3 * rows.vertices[:, None] + np.arange(3)).ravel(), np.repeat(np.arange(len(rows.vertices)), 3)
    return csr_array(coo_array((rows.direction.ravel(), places), shape=(3 * n, len(rows.vertices))))


@dataclass(frozen=True, eq=False)
class PreparedContact(Iterative):
    """Local-global iterations with contact. base: the prefactored Q; idle: the method while nothing is touched."""

    residual_of: ClassVar[ResidualOf] = "previous"

    base: PreparedLocalGlobal
    idle: Idle
    objective: Objective
    corrections: Corrections

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built."""
        return self.idle.facts

    @property
    def choice(self) -> str:
        """The linear solver in words."""
        return f"{self.idle.choice}; contact by Woodbury's formula, beyond {_FEW} rows by conjugate gradients"

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """See Iterative."""
        contacts = touching(problem)
        if not contacts:
            return self.idle.begin(problem, guess)
        step = StepObjective(self.objective, problem)
        return _Iterating(self.corrections, step, contacts, step.placed(guess))

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return largest(problem) * self.base.trace**0.5

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """See Iterative; it takes no iteration where something is touched."""
        return self.gauge(problem)(p)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Those of the method while nothing is touched; with contact an iteration has no parts that stand alone."""
        return {} if touching(problem) else self.idle.phases(problem)

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """See Iterative."""
        if not touching(problem):
            return self.idle.gauge(problem)
        step = StepObjective(self.objective, problem)
        return lambda p: self.corrections.residual(self.corrections.plain(step.gradient(p)))


class _Iterating(Iterating):
    """Each position is no higher than the one before."""

    def __init__(
        self, corrections: Corrections, step: StepObjective, contacts: list[ContactEnergy], p: Positions
    ) -> None:
        self._corrections, self._step, self._contacts = corrections, step, contacts
        self.positions = p
        self._plain: Positions | None = None

    def advance(self) -> bool:
        """See Iterating."""
        gradient = self._step.gradient(self.positions)
        self._plain = self._corrections.plain(gradient)
        self.positions = self._following(self.positions, gradient, self._plain)
        return True

    def residual(self) -> float:
        """That of the previous positions."""
        return float("nan") if self._plain is None else self._corrections.residual(self._plain)

    def _following(self, p: Positions, gradient: Positions, plain: Positions) -> Positions:
        """A position that is no higher than p: p itself where round-off lets nothing descend."""
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

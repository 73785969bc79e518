"""Local-global iterations, compiled as a whole: no Python between a step's beginning and its end.

Factors of float64 solve for positions, Q p = A'K d + y. Less precise ones solve for corrections,
p <- p - Q^-1 grad g(p), with the gradient in float64: the iterations end where those of float64 do, to all of its
digits, and only the way there differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.about import LIU_2013, LOCAL_GLOBAL, About
from solvers.contact.touching import without_contact
from solvers.core.parts import Parts, split
from solvers.energies.springs import Springs
from solvers.kernels import springs as kernels
from solvers.kernels import step, step_ends
from solvers.kernels.edges import Edges
from solvers.kernels.plan import Order, of_inverse, of_supernodal, vectors
from solvers.linear.choice import Linear, Precision, factorise
from solvers.linear.inverse import Inverse
from solvers.linear.supernodal import Supernodal
from solvers.linear.team import Team
from solvers.memory import aligned
from solvers.methods.local_global import PreparedLocalGlobal, Project, prepared, projective
from solvers.problem import Positions, Prepared, Solution, StepProblem, StopRule, System

FAR = 1e100
"""Where the springs end that fill up bundles: at no vertex, whatever the unit of length."""


@dataclass(frozen=True)
class CompiledLocalGlobal:
    """Compiled steps over a linear solver that is chosen by size, or given.

    linear: the solver of Q p = b; precision: of its stored entries.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013, first=True)

    linear: Linear = "auto"
    precision: Precision = "float64"

    def prepare(self, system: System) -> Prepared:
        """Raises Unsupported for energies that are neither projective nor contact, NotPositiveDefinite."""
        if without_contact(system) is not system:
            from solvers.contact.local_global import local_global  # for those who need it

            return local_global(self, system)
        energies = projective(system, "numba")
        springs = [energy for energy in energies if isinstance(energy, Springs)]
        alone = [Springs.joined(springs)] if len(springs) == len(energies) else []
        base = prepared(
            system,
            alone or energies,
            lambda Q: factorise(Q, self.linear, self.precision),
            rounded=self.precision != "float64",
        )
        found = compiled(base)
        if isinstance(found, PreparedCompiled):
            return found
        local = {"project": _projection(alone[0], system.vertices)} if alone else {}
        return replace(base, choice=f"{base.choice}; {found}", **local)


ORDERS: dict[type, Callable[[Any], Order]] = {Supernodal: of_supernodal, Inverse: of_inverse}
"""The linear solvers whose panels the kernels go through; the others are called in between."""


def compiled(base: PreparedLocalGlobal, *, corrects: bool = False) -> PreparedCompiled | str:
    """The iterations over the factor's own rows; where there are none, in words that they go through Python, and why.

    corrects: whether corrections are wanted whatever the factor's precision.
    """
    order = next((order for kind, order in ORDERS.items() if isinstance(base.factor, kind)), None)
    if order is None:
        return "iterations through Python: this linear solver is called from there"
    parts = split(base.system)
    if parts.unknown:
        return f"iterations through Python: the kernels do not know {', '.join(parts.unknown)}"
    if parts.cancel:
        return "iterations through Python: the stiffnesses between some vertices cancel"
    return PreparedCompiled.of(
        replace(base, choice=f"{base.choice}; iterations compiled"), parts, order(base.factor), corrects
    )


class _Work(NamedTuple):
    """What the kernels write to: three vectors and scratch, the right-hand side, positions to be corrected or None."""

    vectors: tuple[NDArray[Any], ...]
    right: NDArray[np.float64]
    p: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class PreparedCompiled:
    """The iterations over a factor's own rows (see `solvers.kernels.step`).

    base: the same, step by step; parts: of the energies; plan: of an iteration; bundles: of the springs
    in its local step; edges: beside them; form: of
    |e|_Q^2; rows: of the vertices; far: the last row.
    """

    base: PreparedLocalGlobal
    parts: Parts
    plan: step.Plan
    bundles: kernels.Bundles
    edges: Edges | None
    form: kernels.Bundles
    rows: step_ends.Rows
    far: int

    @classmethod
    def of(cls, base: PreparedLocalGlobal, parts: Parts, order: Order, corrects: bool) -> PreparedCompiled:
        """The iterations over a factor that is cut into blocks; corrects: for corrections in any case."""
        s, pins = base.system, base.system.pins
        exact = pins.vertices[pins.exact]
        nobody = order.rows + len(exact)
        row = np.empty(s.vertices, np.int64)
        slot = order.slot[: len(s.free)]  # those behind are padding
        row[s.free] = slot
        row[exact] = order.rows + np.arange(len(exact))
        part = np.full(s.vertices, -1)
        part[s.free] = np.searchsorted(order.spans[:, 0], slot, side="right") - 1
        corrects |= order.squares.dtype != np.float64
        where = row, part, len(order.spans), nobody, nobody + 1
        form, first = kernels.Bundles.of(parts.pairs, *where)
        # Positions are solved for with the forms in Q; corrections need their gradient too.
        local = parts.whole if corrects else parts.springs
        bundles = form if local is parts.pairs else kernels.Bundles.of(local, *where)[0]
        inertia = s.inertia
        held, measure, loose = np.zeros((3, nobody + 2 + order.shift))
        held[row] = measure[row] = inertia + parts.held
        _, soft, weight = s.penalty
        held[row[soft]] += weight
        measure[row[s.free]] -= 0.5 * base.coupling.sum(axis=1)
        loose[row[s.unpinned]] = 1.0
        coupling = csr_array((0, 0)).tocoo() if corrects else base.coupling.tocoo()
        return cls(
            base,
            parts,
            step.Plan(
                order.squares,
                order.panels,
                order.places,
                order.chunks,
                order.top,
                np.ascontiguousarray(np.column_stack([order.spans[:, :2], first[:-1], first[1:], order.spans[:, 2:]])),
                order.of_group,
                order.visits,
                order.visits_of,
                held,
                form.in_lanes(measure),
                loose,
                order.shift,
            ),
            bundles,
            parts.edges(row, len(held), order.rows),
            form,
            step_ends.Rows(
                row,
                bundles.in_right(len(held))[row],
                inertia,
                np.array(pins.weight),
                np.array(pins.vertices),
                np.array(coupling.data, np.float64),
                s.free[coupling.coords[0]],
                np.flatnonzero(pins.exact)[coupling.coords[1]],
            ),
            nobody + 1,
        )

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built."""
        return self.base.facts

    @property
    def choice(self) -> str:
        """The linear solver in words, and how many of the allowed threads a step uses where that is not all."""
        allowed, used = numba.get_num_threads(), self._threads() or 1
        if used == allowed:
            return self.base.choice
        why = "the system is too small for a second thread to pay" if used == 1 else f"its factor comes in {used} parts"
        return f"{self.base.choice}; {used} of {allowed} threads: {why}"

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The iterates from `problem.first_guess`; the yielded array is overwritten by the next one."""
        (a, b, c, e), right, p = work = self._new()
        team = Team.of(int(self.plan.top[2]))
        target, force, pins, _, guess = self._arrays(problem)
        step_ends.state(self.rows, target, force, pins, right)
        step_ends.start(self.rows, work.vectors, p, guess, pins)
        out, edges = np.empty_like(target), self.parts.begun(self.edges, problem)
        while True:
            step.iterate(
                self.plan,
                self.bundles,
                edges,
                self.form,
                (a, b, c, e),
                right,
                p,
                1,
                np.nan,
                0.0,
                False,
                self._threads(),
                team,
            )
            a, b = b, a
            step_ends.fetch(self.rows, a if p is None else p, out)
            yield out

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until `stop` says so; without a tolerance only the last residual is computed."""
        target, force, pins, current, guess = self._arrays(problem)
        out = np.empty_like(target)
        edges = self.parts.begun(self.edges, problem)
        fixed = self.plan, self.bundles, edges, self.form, self.rows, *self._work, target, force, pins
        threads = self._threads()
        floor = stop.floor * self.base.trace**0.5
        limit, yardstick, every = 0.0, float("nan"), stop.tolerance is not None
        if stop.tolerance is not None:
            _, yardstick, _, _ = step_ends.solve(*fixed, current, 1, 0.0, 0.0, False, threads, self._team, out)
            limit = stop.tolerance * yardstick
        count, residual, enough, at_rest = step_ends.solve(
            *fixed, guess, stop.iterations, limit, floor, every, threads, self._team, out
        )
        stopped = "iterations" if not every or not (enough or at_rest) else "tolerance" if enough else "floor"
        return Solution(out, count, residual, yardstick, stopped)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """The local step over all springs at the first guess, and a solve with the factor as it is, once.

        Within a step neither is done alone: blocks take turns at both.
        """
        (a, b, _, _), right, p = work = self._new()
        target, force, pins, _, guess = self._arrays(problem)
        step_ends.state(self.rows, target, force, pins, right)
        step_ends.start(self.rows, work.vectors, p, guess, pins)

        edges = self.parts.begun(self.edges, problem)

        def local() -> NDArray[Any]:
            step.local(self.plan, self.bundles, edges, a, right, p, b)
            return b

        y, out = self.base.system.inertia[:, None] * target + force, np.zeros_like(target)
        return {"local": local, "global": lambda: self.base.correction(y, out)}

    def _arrays(self, problem: StepProblem) -> list[Positions]:
        """The problem's arrays. The kernels are compiled for arrays that may be written to: what may not is copied."""
        p = problem
        given = (p.target, self.parts.force(p), p.pin_targets, p.current, p.first_guess)
        return [x if x.flags.carray else np.array(x, np.float64, order="C") for x in given]

    @cached_property
    def _team(self) -> Team:
        return Team.of(int(self.plan.top[2]))

    @cached_property
    def _work(self) -> _Work:
        return self._new()

    def _new(self) -> _Work:
        rows, dtype = len(self.plan.held), self.plan.squares.dtype
        arrays = vectors(dtype, rows)
        p = None if dtype == np.float64 else aligned(4 * rows)
        for x in arrays[:3] if p is None else [p]:
            x[4 * self.far] = FAR
        return _Work(arrays, self.bundles.right(self.plan.held), p)

    def _threads(self) -> int | None:
        """As many as are allowed and as there are groups of subtrees; None for one."""
        threads = min(numba.get_num_threads(), int(self.plan.top[2]))
        return threads if threads > 1 else None


def _projection(springs: Springs, n: int) -> Project:
    """The compiled local step for a linear solver that is called from Python."""
    bundles, _ = kernels.Bundles.of(springs, np.arange(n), np.zeros(n, np.int64), 1, n, n + 1)
    x, b = (aligned(4 * (n + 2)) for _ in range(2))
    x[4 * (n + 1)] = FAR
    zero = bundles.right(np.zeros(n + 2))

    def project(p: Positions, y: Positions, out: Positions) -> None:
        kernels.project(bundles, p, y, x, b, zero, out)

    return project

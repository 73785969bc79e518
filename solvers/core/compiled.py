"""The local-global iteration as compiled steps, without Python within a step.

It uses `solvers.kernels.step` for factors whose panels the kernels can traverse.

The factors are stored as inverses of blocks, whose products have rounding errors of eps cond(Q) |p| (Higham 2002,
section 14.1), where cond(Q) <= 2 max_i Q_ii / (Q 1)_i, scaled by Q 1. If that exceeds a small fraction of a spring's
length, because of large stiffness ratios or distant vertices, corrections are solved for, in float64 too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.core.driver import Iterating, Iterative, largest
from solvers.core.parts import Parts, split
from solvers.core.prefactored import PreparedLocalGlobal
from solvers.energies.springs import Springs
from solvers.kernels import springs as kernels
from solvers.kernels import step, step_ends
from solvers.kernels.edges import Edges
from solvers.kernels.loop import ONE, Limits, at_most
from solvers.kernels.plan import Order, of_inverse, of_supernodal, vectors
from solvers.linear.inverse import Inverse
from solvers.linear.supernodal import Supernodal
from solvers.linear.team import Team
from solvers.memory import aligned
from solvers.problem import Positions, ResidualOf, StepProblem
from solvers.round_off import EPS

Ints = NDArray[np.int64]
Reals = NDArray[np.float64]

_LOST = 1e-3
"""Largest position error by the bound, relative to the median rest length; the bound is about 20 times the error.
Sheets of 256 vertices a side and 1e5 N/m stay below it by a factor of 100; scenes with stiffness ratios of 1e12 exceed
it."""

_NEAR = 100.0
"""Distance [m] from the origin within which most scenes stay."""

FAR = 1e100
"""Coordinate of the ends of padding springs, far from any vertex in any unit of length."""

ORDERS: dict[type, Callable[[Any], Order]] = {Supernodal: of_supernodal, Inverse: of_inverse}
"""Linear solvers whose panels the kernels traverse; others are called between compiled parts."""


def compiled(base: PreparedLocalGlobal, *, corrects: bool = False) -> PreparedCompiled | str:
    """Return the compiled iterations over the factor's rows, or the reason in words why they run through Python.

    `corrects` selects corrections for any precision of the factor.
    """
    order = _order(base)
    if order is None:
        return "iterations through Python: this linear solver is called from there"
    parts = split(base.system)
    if parts.unknown:
        return f"iterations through Python: the kernels do not know {', '.join(parts.unknown)}"
    if parts.cancel:
        return "iterations through Python: the stiffnesses between some vertices cancel"
    return PreparedCompiled.of(replace(base, choice=f"{base.choice}; iterations compiled"), parts, order, corrects)


def _order(base: PreparedLocalGlobal) -> Order | None:
    """Return a factor's elimination schedule; None for a factor that the kernels do not support."""
    return next((order(base.factor) for kind, order in ORDERS.items() if isinstance(base.factor, kind)), None)


def _reach(base: PreparedLocalGlobal, springs: Springs) -> float:
    """Return the largest coordinate [m] for which a direct solve has an acceptable position error."""
    lengths = springs.rest_length[springs.rest_length > 0.0]
    return _LOST * float(np.median(lengths)) / (2.0 * EPS * base.spread) if len(lengths) else np.inf


def _plan(order: Order, first: Ints, held: Reals, measure: Reals, loose: Reals) -> step.Plan:
    """Build the plan over a factor's spans, with the first packet of each (groups + 1,)."""
    spans = np.ascontiguousarray(np.column_stack([order.spans[:, :2], first[:-1], first[1:], order.spans[:, 2:]]))
    factor = order.squares, order.panels, order.places, order.chunks, order.top
    return step.Plan(*factor, spans, order.of_group, order.visits, order.visits_of, held, measure, loose, order.shift)


def _rows(base: PreparedLocalGlobal, row: Ints, right: Ints, corrects: bool) -> step_ends.VertexRows:
    """Build the constant data of the right-hand side; corrections omit Q's coupling to exact pins."""
    s, pins = base.system, base.system.pins
    coupling = csr_array((0, 0)).tocoo() if corrects else base.coupling.tocoo()
    ends = s.free[coupling.coords[0]], np.flatnonzero(pins.exact)[coupling.coords[1]]
    held = np.array(pins.weight), np.array(pins.vertices), np.array(coupling.data, np.float64)
    return step_ends.VertexRows(row, right, s.inertia, *held, *ends)


class StepScratch(NamedTuple):
    """The arrays that kernels overwrite: vectors, right-hand side, and positions for corrections or None."""

    vectors: tuple[NDArray[Any], ...]
    right: NDArray[np.float64]
    p: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class PreparedCompiled(Iterative):
    """The iterations over a factor's own rows (see `solvers.kernels.step`).

    Attributes:
        base: the uncompiled iteration.
        parts: decomposition of the energies.
        plan: plan of an iteration.
        bundles: packets of the springs in the local step.
        edges: strain limits and dashpots, or None.
        form: packets of |e|_Q^2.
        rows: rows of the vertices.
        far: last row.
        corrects: whether it solves for corrections.
        reach: largest coordinate [m] up to which it may solve for positions.
    """

    residual_of: ClassVar[ResidualOf] = "previous"

    base: PreparedLocalGlobal
    parts: Parts
    plan: step.Plan
    bundles: kernels.Bundles
    edges: Edges | None
    form: kernels.Bundles
    rows: step_ends.VertexRows
    far: int
    corrects: bool
    reach: float

    @classmethod
    def of(cls, base: PreparedLocalGlobal, parts: Parts, order: Order, corrects: bool) -> PreparedCompiled:
        """Build the iterations over a factor in blocks; corrects selects corrections in any case."""
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
        # A solve for positions has the forms in Q; one for corrections also needs their gradient.
        local = parts.whole if corrects else parts.springs
        bundles = form if local is parts.pairs else kernels.Bundles.of(local, *where)[0]
        inertia = s.inertia
        held, measure, loose = np.zeros((3, nobody + 2 + order.shift))
        held[row] = measure[row] = inertia + parts.held
        _, soft, weight = s.penalty
        held[row[soft]] += weight
        measure[row[s.free]] -= 0.5 * base.coupling.sum(axis=1)
        loose[row[s.unpinned]] = 1.0
        return cls(
            base,
            parts,
            _plan(order, first, held, form.in_lanes(measure), loose),
            bundles,
            parts.edges(row, len(held)),
            form,
            _rows(base, row, bundles.in_right(len(held))[row], corrects),
            nobody + 1,
            corrects,
            np.inf if corrects else _reach(base, parts.springs),
        )

    @cached_property
    def corrected(self) -> PreparedCompiled:
        """The iterations that solve for corrections."""
        order = _order(self.base)
        assert order is not None  # `of` was given one
        return self.of(self.base, self.parts, order, True)

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of the setup."""
        return self.base.facts

    @property
    def choice(self) -> str:
        """The linear solver, the distance for corrections if scenes may reach it, and the threads used if not all."""
        beyond = f"; corrections beyond {self.reach:.1g} m of the origin" if self.reach < _NEAR else ""
        allowed, used = numba.get_num_threads(), self.threads() or 1
        if used == allowed:
            return f"{self.base.choice}{beyond}"
        why = "the system is too small for a second thread to pay" if used == 1 else f"its factor comes in {used} parts"
        return f"{self.base.choice}{beyond}; {used} of {allowed} threads: {why}"

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return _Iterating(self if largest(problem) <= self.reach else self.corrected, problem, guess)

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Build a residual function that evaluates the energies of the step once."""
        made = self if largest(problem) <= self.reach else self.corrected
        return _Iterating(made, problem, problem.current).residual_from

    def scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return largest(problem) * self.base.trace**0.5

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the local step over all springs at the initial guess, and one solve with the unrefined factor.

        Within a step neither runs alone, because blocks alternate between both.
        """
        (a, b, _, _), right, p = work = self.memory()
        target, force, pins, guess = self.arrays(problem, problem.first_guess)
        step_ends.state(self.rows, target, force, pins, right)
        step_ends.start(self.rows, work.vectors, p, guess, pins)

        edges = self.parts.begun(self.edges, problem)

        def local() -> NDArray[Any]:
            step.local(self.plan, self.bundles, edges, a, right, p, b)
            return b

        y, out = self.base.system.inertia[:, None] * target + force, np.zeros_like(target)
        return {"local": local, "global": lambda: self.base.correction(y, out)}

    def arrays(self, problem: StepProblem, guess: Positions) -> list[Positions]:
        """Return target, force, pin targets and guess; read-only arrays are copied.

        The kernels are compiled for writable arrays.
        """
        given = (problem.target, self.parts.force(problem), problem.pin_targets, guess)
        return [x if x.flags.carray else np.array(x, np.float64, order="C") for x in given]

    @cached_property
    def team(self) -> Team:
        """The thread team of whole solves."""
        return Team.of(int(self.plan.top[2]))

    @cached_property
    def work(self) -> StepScratch:
        """The scratch memory that whole solves share."""
        return self.memory()

    def memory(self) -> StepScratch:
        """Allocate the scratch memory of one solve."""
        rows, dtype = len(self.plan.held), self.plan.squares.dtype
        arrays = vectors(dtype, rows)
        p = aligned(4 * rows) if self.corrects else None
        for x in arrays[:3] if p is None else [p]:
            x[4 * self.far] = FAR
        return StepScratch(arrays, self.bundles.right(self.plan.held), p)

    def threads(self) -> int | None:
        """Return the smaller of the allowed threads and the groups of subtrees; None for one thread."""
        groups = int(self.plan.top[2])
        threads = min(numba.get_num_threads(), groups) if groups > 1 else 1
        return threads if threads > 1 else None


class _Iterating(Iterating):
    """A solve whose iterations are one call, in memory that all solves share; single iterations use their own."""

    def __init__(self, prepared: PreparedCompiled, problem: StepProblem, guess: Positions) -> None:
        self._prepared, self._problem, self._guess = prepared, problem, guess
        self._arrays, self._edges = prepared.arrays(problem, guess), prepared.parts.begun(prepared.edges, problem)
        self.positions = np.empty_like(problem.target)

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        made = self._prepared
        fixed = made.plan, made.bundles, self._edges, made.form, made.rows, *made.work, tuple(self._arrays)
        answer = step_ends.solve(*fixed, limits, made.threads(), made.team, self.positions)
        self._arrays[-1] = self.positions  # where the next ones go on
        return answer

    def residual_from(self, p: Positions) -> float:
        """Return |p - LG(p)|_Q of positions p (n, 3), by one iteration from there."""
        self._arrays[-1] = p if p.flags.carray else np.array(p, np.float64, order="C")
        return self.iterate(at_most(1))[1]

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        made = self._prepared
        (a, b, c, e), right, p = self._own
        fixed = made.plan, made.bundles, self._edges, made.form, (a, b, c, e), right, p
        step.iterate(*fixed, ONE, made.threads(), self._team)
        self._own = StepScratch((b, a, c, e), right, p)
        step_ends.fetch(made.rows, b if p is None else p, self.positions)
        return True

    def residual(self) -> float:
        """Return |p - LG(p)|_Q of the previous positions p."""
        (a, b, _, e), _, p = self._own
        return step.length(self._prepared.plan, self._prepared.form, a, b, p, e)

    @cached_property
    def _own(self) -> StepScratch:
        work, (target, force, pins, guess) = self._prepared.memory(), self._arrays
        step_ends.state(self._prepared.rows, target, force, pins, work.right)
        step_ends.start(self._prepared.rows, work.vectors, work.p, guess, pins)
        return work

    @cached_property
    def _team(self) -> Team:
        return Team.of(int(self._prepared.plan.top[2]))

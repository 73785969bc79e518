"""The local-global iteration as compiled steps, without Python within a step.

It uses `springbench.solvers.kernels.local_global_iteration` for factors whose panels the kernels can traverse.

The factors are stored as inverses of blocks, whose products have rounding errors of eps cond(Q) |p|
(`springbench.solvers.model.solve_accuracy`). If that exceeds a small fraction of a spring's length, because of large
stiffness ratios or distant vertices, corrections are solved for, in float64 too.
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
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState, compute_max_coordinate
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.kernels import local_global_iteration, step_setup
from springbench.solvers.kernels import spring_local_step as kernels
from springbench.solvers.kernels.iteration_loop import ONE_ITERATION, LoopLimits, iteration_limit
from springbench.solvers.kernels.padding_coordinate import PADDING_COORDINATE
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.cholesky.thread_team import ThreadTeam
from springbench.solvers.linalg.dense_inverse import DenseInverse
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.methods.local_global.elimination_schedule import (
    EliminationSchedule,
    allocate_vectors,
    schedule_inverse,
    schedule_supernodal,
)
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.solve_accuracy import relative_solve_error
from springbench.solvers.model.step_problem import Positions, ResidualIterate, StepProblem
from springbench.solvers.objective.spring_form import SpringForm, decompose_energies

IndexArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

MAX_POSITION_LOSS = 1e-3
"""Largest position error by the bound, relative to the median rest length; the bound is about 20 times the error.
Sheets of 256 vertices a side and 1e5 N/m stay below it by a factor of 100; scenes with stiffness ratios of 1e12 exceed
it."""

_USUAL_EXTENT = 100.0
"""Distance [m] from the origin within which most scenes stay."""

SCHEDULE_BUILDERS: dict[type, Callable[[Any], EliminationSchedule]] = {
    SupernodalCholesky: schedule_supernodal,
    DenseInverse: schedule_inverse,
}
"""Linear solvers whose panels the kernels traverse; others are called between compiled parts."""


def compile_iterations(
    base: PreparedLocalGlobal, *, use_corrections: bool = False
) -> PreparedCompiledLocalGlobal | str:
    """Build the compiled iterations over the factor's rows.

    Args:
        base: prepared iteration through Python.
        use_corrections: whether to solve for corrections with a float64 factor as well.

    Returns:
        The compiled iterations, or the reason in words why the kernels do not support the system or its factor.
    """
    order = _build_schedule(base)
    if order is None:
        return "iterations through Python: this linear solver is called from there"
    parts = decompose_energies(base.system)
    if parts.unsupported_energies:
        return f"iterations through Python: the kernels do not support {', '.join(parts.unsupported_energies)}"
    if parts.has_cancellation:
        return "iterations through Python: the stiffnesses between some vertices cancel"
    return PreparedCompiledLocalGlobal.from_schedule(
        replace(base, description=f"{base.description}; iterations compiled"), parts, order, use_corrections
    )


def _build_schedule(base: PreparedLocalGlobal) -> EliminationSchedule | None:
    """Return a factor's elimination schedule; None for a factor that the kernels do not support."""
    return next(
        (order(base.factor) for kind, order in SCHEDULE_BUILDERS.items() if isinstance(base.factor, kind)), None
    )


def _max_direct_coordinate(base: PreparedLocalGlobal, springs: Springs) -> float:
    """Return the largest coordinate [m] for which a direct solve has an acceptable position error."""
    lengths = springs.rest_length[springs.rest_length > 0.0]
    return (
        MAX_POSITION_LOSS * float(np.median(lengths)) / relative_solve_error(base.diagonal_dominance_ratio)
        if len(lengths)
        else np.inf
    )


def _build_plan(
    order: EliminationSchedule, first: IndexArray, anchor_stiffness: FloatArray, measure: FloatArray, loose: FloatArray
) -> local_global_iteration.IterationPlan:
    """Build the plan over a factor's blocks.

    `first` has the first packet of each block, (blocks + 1,).
    """
    spans = np.ascontiguousarray(
        np.column_stack([order.block_spans[:, :2], first[:-1], first[1:], order.block_spans[:, 2:]])
    )
    factor = order.inverse_blocks, order.panels, order.row_slots, order.chunks, order.top_range
    return local_global_iteration.IterationPlan(
        *factor,
        spans,
        order.group_blocks,
        order.visit_schedule,
        order.visit_starts,
        anchor_stiffness,
        measure,
        loose,
        order.row_shift,
    )


def _build_vertex_rows(
    base: PreparedLocalGlobal, row: IndexArray, right: IndexArray, corrects: bool
) -> step_setup.VertexRows:
    """Build the constant data of the right-hand side; corrections omit Q's coupling to exact pins."""
    s, pins = base.system, base.system.pins
    coupling = csr_array((0, 0)).tocoo() if corrects else base.pin_coupling.tocoo()
    ends = s.free_vertices[coupling.coords[0]], np.flatnonzero(pins.exact_mask)[coupling.coords[1]]
    pin_arrays = np.array(pins.weight), np.array(pins.vertices), np.array(coupling.data, np.float64)
    return step_setup.VertexRows(row, right, s.inertia_diagonal, *pin_arrays, *ends)


class StepScratch(NamedTuple):
    """The arrays that kernels overwrite: vectors, right-hand side, and positions for corrections or None."""

    vectors: tuple[NDArray[Any], ...]
    right_hand_side: NDArray[np.float64]
    positions: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class PreparedCompiledLocalGlobal(IterativeSolver):
    """The iterations over the rows of a factor (`springbench.solvers.kernels.local_global_iteration`).

    Attributes:
        base: the uncompiled iteration.
        spring_form: decomposition of the energies.
        iteration_plan: plan of an iteration.
        spring_packets: packets of the springs, strain limits and dashpots in the local step.
        norm_packets: packets of |e|_Q^2.
        vertex_rows: rows of the vertices.
        padding_row: last row.
        use_corrections: whether corrections are solved for, instead of positions.
        max_coordinate: largest coordinate [m] at which positions are solved for; beyond it corrections are.
    """

    residual_iterate: ClassVar[ResidualIterate] = "previous"

    base: PreparedLocalGlobal
    spring_form: SpringForm
    iteration_plan: local_global_iteration.IterationPlan
    spring_packets: kernels.SpringPackets
    norm_packets: kernels.SpringPackets
    vertex_rows: step_setup.VertexRows
    padding_row: int
    use_corrections: bool
    max_coordinate: float

    @classmethod
    def from_schedule(
        cls, base: PreparedLocalGlobal, parts: SpringForm, order: EliminationSchedule, corrects: bool
    ) -> PreparedCompiledLocalGlobal:
        """Build the iterations over a factor in blocks.

        Args:
            base: prepared iteration through Python.
            parts: decomposition of the system's energies.
            order: factor in blocks, with the order of their visits.
            corrects: whether to solve for corrections with a float64 factor as well.
        """
        s, pins = base.system, base.system.pins
        exact = pins.vertices[pins.exact_mask]
        padding_row = order.num_rows + len(exact)
        row = np.empty(s.num_vertices, np.int64)
        slot = order.row_of_unknown[: len(s.free_vertices)]  # those behind are padding
        row[s.free_vertices] = slot
        row[exact] = order.num_rows + np.arange(len(exact))
        part = np.full(s.num_vertices, -1)
        part[s.free_vertices] = np.searchsorted(order.block_spans[:, 0], slot, side="right") - 1
        corrects |= order.inverse_blocks.dtype != np.float64
        where = row, part, len(order.block_spans), padding_row, padding_row + 1
        form, first = kernels.SpringPackets.from_springs(parts.system_pairs, *where)
        # A solve for positions has the forms in Q; one for corrections also needs their gradient.
        local = parts.joined_pairs if corrects else parts.springs
        packets = form
        if local is not parts.system_pairs:
            packets, _ = kernels.SpringPackets.from_springs(local, *where, parts.attach_edges(local))
        inertia = s.inertia_diagonal
        anchor_stiffness, measure, loose = np.zeros((3, padding_row + 2 + order.row_shift))
        anchor_stiffness[row] = measure[row] = inertia + parts.vertex_weight
        _, soft, weight = s.penalty_pins
        anchor_stiffness[row[soft]] += weight
        measure[row[s.free_vertices]] -= 0.5 * base.pin_coupling.sum(axis=1)
        loose[row[s.unpinned_mask]] = 1.0
        return cls(
            base,
            parts,
            _build_plan(order, first, anchor_stiffness, form.gather_lanes(measure), loose),
            packets,
            form,
            _build_vertex_rows(base, row, packets.right_hand_side_offset(len(anchor_stiffness))[row], corrects),
            padding_row + 1,
            corrects,
            np.inf if corrects else _max_direct_coordinate(base, parts.springs),
        )

    @cached_property
    def with_corrections(self) -> PreparedCompiledLocalGlobal:
        """The iterations that solve for corrections."""
        order = _build_schedule(self.base)
        assert order is not None  # `self` was built from one
        return self.from_schedule(self.base, self.spring_form, order, True)

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the setup."""
        return self.base.stats

    @property
    def description(self) -> str:
        """Description of the linear solver.

        It states the distance beyond which corrections are solved for, if scenes may reach it, and the number of
        threads, if not all are used.
        """
        beyond = (
            f"; corrections beyond {self.max_coordinate:.1g} m of the origin"
            if self.max_coordinate < _USUAL_EXTENT
            else ""
        )
        allowed, used = numba.get_num_threads(), self.num_threads() or 1
        if used == allowed:
            return f"{self.base.description}{beyond}"
        why = "the system is too small for a second thread to pay" if used == 1 else f"its factor is in {used} parts"
        return f"{self.base.description}{beyond}; {used} of {allowed} threads: {why}"

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        It solves for corrections if coordinates exceed `max_coordinate`.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return _CompiledState(
            self if compute_max_coordinate(problem) <= self.max_coordinate else self.with_corrections,
            problem,
            initial_guess,
        )

    def build_residual(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Build a residual function that evaluates the energies of the step once."""
        made = self if compute_max_coordinate(problem) <= self.max_coordinate else self.with_corrections
        return _CompiledState(made, problem, problem.current_positions).residual_from

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return compute_max_coordinate(problem) * self.base.unpinned_trace**0.5

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the local step over all springs and one solve, at the initial guess.

        The solve is without refinement of the factor's precision. Within a step neither runs alone, because blocks
        alternate between both.
        """
        (a, b, _, _), right, p = work = self.allocate_scratch()
        target, force, pins, guess = self.step_arrays(problem, problem.initial_guess)
        step_setup.write_right_hand_side(self.vertex_rows, target, force, pins, right)
        step_setup.init_vectors(self.vertex_rows, work.vectors, p, guess, pins)
        packets = self.spring_form.update_edges(self.spring_packets.with_own_dashpots(), problem)

        def local() -> NDArray[Any]:
            local_global_iteration.run_blocked_local_step(self.iteration_plan, packets, a, right, p, b)
            return b

        y, out = self.base.system.inertia_diagonal[:, None] * target + force, np.zeros_like(target)
        return {"local": local, "global": lambda: self.base.solve_correction(y, out)}

    def step_arrays(self, problem: StepProblem, guess: Positions) -> list[Positions]:
        """Return the arrays of a step as the kernels read them, contiguous and writable.

        Args:
            problem: the step.
            guess: initial guess (n, 3) [m].

        Returns:
            Inertial target (n, 3) [m], constant force (n, 3) [N], pin targets (q, 3) [m] and guess (n, 3) [m].
        """
        given = (problem.inertial_target, self.spring_form.compute_force(problem), problem.pin_targets, guess)
        return [*map(as_kernel_array, given)]

    @cached_property
    def thread_team(self) -> ThreadTeam:
        """The thread team of whole solves."""
        return ThreadTeam.from_task_count(int(self.iteration_plan.top_range[2]))

    @cached_property
    def solve_kernels(self) -> tuple[TypedKernel, TypedKernel]:
        """The kernel `step_setup.solve_step` for one thread, and for several."""
        return TypedKernel(step_setup.solve_step), TypedKernel(step_setup.solve_step)

    @cached_property
    def shared_scratch(self) -> StepScratch:
        """The scratch memory that whole solves share."""
        return self.allocate_scratch()

    def allocate_scratch(self) -> StepScratch:
        """Allocate the scratch memory of one solve."""
        rows, dtype = len(self.iteration_plan.anchor_stiffness), self.iteration_plan.inverse_blocks.dtype
        arrays = allocate_vectors(dtype, rows)
        p = allocate_aligned(4 * rows) if self.use_corrections else None
        for x in arrays[:3] if p is None else [p]:
            x[4 * self.padding_row] = PADDING_COORDINATE
        return StepScratch(arrays, self.spring_packets.build_right_hand_side(self.iteration_plan.anchor_stiffness), p)

    def num_threads(self) -> int | None:
        """Return the number of threads of a solve; None for one thread.

        It is the smaller of the allowed threads and the groups of subtrees.
        """
        groups = int(self.iteration_plan.top_range[2])
        threads = min(numba.get_num_threads(), groups) if groups > 1 else 1
        return threads if threads > 1 else None


class _CompiledState(SolverState):
    """A solve whose iterations are one call.

    All solves share the memory of that call; single iterations use separate memory.
    """

    def __init__(self, prepared: PreparedCompiledLocalGlobal, problem: StepProblem, guess: Positions) -> None:
        self._prepared, self._problem, self._guess = prepared, problem, guess
        self._arrays, self._spring_packets = (
            prepared.step_arrays(problem, guess),
            prepared.spring_form.update_edges(prepared.spring_packets.with_own_dashpots(), problem),
        )
        self.positions = np.empty_like(problem.inertial_target)

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        made, threads = self._prepared, self._prepared.num_threads()
        solve_step = made.solve_kernels[threads is not None].call
        packets = self._spring_packets, made.norm_packets
        memory = made.vertex_rows, *made.shared_scratch, tuple(self._arrays)
        answer = solve_step(made.iteration_plan, *packets, *memory, limits, threads, made.thread_team, self.positions)
        self._arrays[-1] = self.positions  # the next iterations continue from there
        return answer

    def residual_from(self, p: Positions) -> float:
        """Return |p - LG(p)|_Q of positions p (n, 3), by one iteration from there."""
        self._arrays[-1] = as_kernel_array(p)
        return self.run_iterations(iteration_limit(1))[1]

    def step_state(self) -> bool:
        """Do one iteration; return True."""
        made = self._prepared
        (a, b, c, e), right, p = self._own_scratch
        fixed = made.iteration_plan, self._spring_packets, made.norm_packets, (a, b, c, e), right, p
        local_global_iteration.run_iterations(*fixed, ONE_ITERATION, made.num_threads(), self._thread_team)
        self._own_scratch = StepScratch((b, a, c, e), right, p)
        step_setup.read_positions(made.vertex_rows, b if p is None else p, self.positions)
        return True

    def residual(self) -> float:
        """Return |p - LG(p)|_Q of the previous positions p."""
        (a, b, _, e), _, p = self._own_scratch
        return local_global_iteration.compute_residual(
            self._prepared.iteration_plan, self._prepared.norm_packets, a, b, p, e
        )

    @cached_property
    def _own_scratch(self) -> StepScratch:
        work, (target, force, pins, guess) = self._prepared.allocate_scratch(), self._arrays
        step_setup.write_right_hand_side(self._prepared.vertex_rows, target, force, pins, work.right_hand_side)
        step_setup.init_vectors(self._prepared.vertex_rows, work.vectors, work.positions, guess, pins)
        return work

    @cached_property
    def _thread_team(self) -> ThreadTeam:
        return ThreadTeam.from_task_count(int(self._prepared.iteration_plan.top_range[2]))

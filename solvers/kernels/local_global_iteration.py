"""Local-global iterations over a factor's own rows, without Python within a step.

An iteration maps positions p^k to p^(k+1):

    up      children first: the local step of each vertex, and forward substitution
    turn    the same for the top, and its back substitution
    down    parents first: back substitution

Vertices of a subtree have springs among themselves and to their ancestors only. So once back substitution has completed
a subtree, all input of its next local step is available. A group is therefore processed subtree by subtree: down to it
in one iteration and, after all subtrees below it, up from it in the next, while its panels are in a cache. The order of
all sums is independent of the number of threads. The threads are started once per step, not once per iteration, because
waking a thread takes longer than an iteration.

A vector has rows of four numbers: the slots of the factor, the groups' copies of the top, the vertices that do not
move, and two padding rows of the packets. With `p` None it contains positions, and a solve gives the next ones.
Otherwise it contains corrections of the positions p (n rows in float64), which may have a lower precision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_inner_parallel, jit_kernel
from springbench.solvers.kernels.iteration_loop import REASON_ITERATIONS, RESIDUAL_EACH, RESIDUAL_LAST, check_residual
from springbench.solvers.kernels.spring_local_step import add_descent, add_projection, squared_norm
from springbench.solvers.linalg.cholesky.thread_team import (
    call_in_thread,
    complete_task,
    finish_phases,
    raise_thread_error,
    release_phase,
    reset_team,
    try_claim,
    wait_for_phase,
)
from springbench.solvers.linalg.cholesky.triangular_solve import backward_substitution, forward_substitution


class IterationPlan(NamedTuple):
    """The order of the operations of an iteration and their data.

    Attributes:
        inverse_blocks, panels, row_slots, chunks: arrays of a factor (see
            `springbench.solvers.linalg.cholesky.supernodal_cholesky`).
        top_range: first and last of the top's rows, and the number of groups (3,).
        block_table: of each block its first and last slot, its first and last packet, its first chunk, and its last
            chunk for forward and for back substitution (b, 7).
        group_blocks: first block of each group and of the top (groups + 2,).
        visit_schedule: operations of the groups in order; 2 b is back substitution of block b, 2 b + 1 its local step
            and forward substitution.
        visit_starts: first visit of each group (groups + 1,).
        anchor_stiffness: m/dt^2 + w [N/m] of each row, plus the diagonal of quadratic forms.
        norm_diagonal: diagonal part of |e|_Q^2 in each lane of the packets: `anchor_stiffness` without the pins, and
            half of each spring to an exactly pinned vertex, because no packet of that vertex includes the other half.
        unpinned_mask: 1 for the rows of unpinned vertices, else 0.
        row_shift: number of rows from a vertex's position to its right-hand side.
    """

    inverse_blocks: NDArray[np.float64]
    panels: NDArray[np.float64]
    row_slots: NDArray[np.int32]
    chunks: NDArray[np.int64]
    top_range: NDArray[np.int64]
    block_table: NDArray[np.int64]
    group_blocks: NDArray[np.int64]
    visit_schedule: NDArray[np.int64]
    visit_starts: NDArray[np.int64]
    anchor_stiffness: NDArray[np.float64]
    norm_diagonal: NDArray[np.float64]
    unpinned_mask: NDArray[np.float64]
    row_shift: int


# These take slices: then a loop provably starts at no negative index, and is vectorised.
@jit_inner
def _fill_zero(a):
    for i in range(len(a)):
        a[i] = 0.0


@jit_inner
def _copy_slice(a, b):
    for i in range(len(a)):
        b[i] = a[i]


@jit_inner
def _add_slice(a, b):
    for i in range(len(a)):
        b[i] += a[i]


@jit_inner
def _forward_block(plan, packets, block, x, right, p, out):
    """Do the local step of a block and its forward substitution.

    The positions are x, or p if that is given.
    """
    _, _, packet, packet_end, chunk, chunk_end, _ = plan.block_table[block]
    if p is None:
        add_projection(packets, packet, packet_end, x, right, out, plan.row_shift)
    else:
        add_descent(packets, packet, packet_end, p, right, out, plan.row_shift)
    forward_substitution(plan.panels, plan.row_slots, plan.chunks, chunk, chunk_end, out)


@jit_inner
def _backward_block(plan, block, x, p):
    """Do the back substitution of a block and correct its positions."""
    slot, slot_end, _, _, chunk, _, chunk_end = plan.block_table[block]
    backward_substitution(plan.inverse_blocks, plan.panels, plan.row_slots, plan.chunks, chunk, chunk_end, x)
    if p is not None:
        _add_slice(x[4 * slot : 4 * slot_end], p[4 * slot : 4 * slot_end])


@jit_inner
def _clear_block(plan, block, out):
    begin, end = plan.block_table[block, 0] + plan.row_shift, plan.block_table[block, 1] + plan.row_shift
    _fill_zero(out[4 * begin : 4 * end])


@jit_inner
def _process_group(plan, packets, group, x, right, p, out, down, up):
    """Process a group in the order of its visits.

    Back substitution changes x; the local step and forward substitution change `out`.
    """
    top = 4 * plan.top_range[0]
    size = 4 * plan.top_range[1] - top
    copy = top + (group + 1) * size
    if down:
        _copy_slice(x[top : top + size], x[copy : copy + size])
    if up:
        _fill_zero(out[copy : copy + size])
    for visit in plan.visit_schedule[plan.visit_starts[group] : plan.visit_starts[group + 1]]:
        block = visit >> 1
        if visit & 1 == 0:
            if down:
                _backward_block(plan, block, x, p)
            if up:
                _clear_block(plan, block, out)
        elif up:
            _forward_block(plan, packets, block, x, right, p, out)


@jit_inner
def _process_top(plan, packets, x, right, p, out):
    """Process the top: up at the positions x, and down again."""
    top, top_end, groups = plan.top_range
    size = 4 * (top_end - top)
    for group in range(groups):
        begin = 4 * top_end + group * size
        if group == 0:
            _copy_slice(out[begin : begin + size], out[4 * top : 4 * top_end])
        else:
            _add_slice(out[begin : begin + size], out[4 * top : 4 * top_end])
    for block in range(plan.group_blocks[-2], plan.group_blocks[-1]):
        _forward_block(plan, packets, block, x, right, p, out)
        _backward_block(plan, block, out, p)


@jit_inner
def _compute_displacement(plan, part, x, before, p, e):
    """Write e = p^k - p^(k-1) of the unpinned vertices of a group or the top."""
    begin, end = plan.group_blocks[part], plan.group_blocks[part + 1]
    if begin < end:
        for i in range(plan.block_table[begin, 0], plan.block_table[end - 1, 1]):
            for k in range(4 * i, 4 * i + 3):
                e[k] = plan.unpinned_mask[i] * (x[k] - before[k] if p is None else x[k])


@jit_inner
def _squared_norm(plan, form, part, e):
    """Return |e|_Q^2 [J] of a group or the top, with half of each spring."""
    begin, end = plan.group_blocks[part], plan.group_blocks[part + 1]
    if begin == end:
        return 0.0
    return squared_norm(form, plan.block_table[begin, 2], plan.block_table[end - 1, 3], e, plan.norm_diagonal)


@jit_kernel
def compute_residual(plan, form, x, before, p, e):
    """Return the residual [J^(1/2)] of an iteration, as `run_iterations` defines it.

    Args:
        plan: the plan.
        form: packets of |e|_Q^2.
        x: vector after the iteration: positions p^k, or corrections if p is given.
        before: vector before the iteration; not used if p is given.
        p: positions that are corrected, or None.
        e: scratch, displacements in rows of four.
    """
    groups = plan.top_range[2]
    for part in range(groups + 1):
        _compute_displacement(plan, part, x, before, p, e)
    total = _squared_norm(plan, form, groups, e)
    for group in range(groups):
        total += _squared_norm(plan, form, group, e)
    return np.sqrt(total)


@jit_kernel
def run_blocked_local_step(plan, packets, x, right, p, out):
    """Do the local step of all blocks without a solve.

    Args:
        plan: the plan, for the shift of its rows.
        packets: packets of the springs and edges.
        x: positions in rows of four [m]; not used if p is given.
        right: constant right-hand side (`SpringPackets.build_right_hand_side`).
        p: positions to correct, for which minus the gradient is computed, or None.
        out: output in rows of four [N], overwritten.
    """
    for k in range(len(out)):
        out[k] = 0.0
    if p is None:
        add_projection(packets, 0, len(packets.packet_start) - 1, x, right, out, plan.row_shift)
    else:
        add_descent(packets, 0, len(packets.packet_start) - 1, p, right, out, plan.row_shift)


@jit_inner
def _run_thread(plan, packets, form, vectors, right, p, limits, team, first):
    """Do the iterations of the groups, from `first` on, that no other thread has claimed.

    Phase 2 k is iteration k, phase 2 k + 1 computes its residual if it is requested.
    """
    x0, x1, x2, e = vectors
    turns = x0, x1, x2
    groups = plan.top_range[2]
    phase = 0
    while phase >= 0:
        k, measures = phase // 2, phase % 2 == 1
        # Positions p^k are in a, or being computed there, and the previous ones in c.
        a, b, c = turns[k % 3], turns[(k + 1) % 3], turns[(k + 2) % 3]
        for i in range(groups):
            # Alternating order: the last data read are still in the cache.
            group = (first + (groups - 1 - i if k % 2 == 1 else i)) % groups
            if try_claim(team, group, phase):
                if measures:
                    _compute_displacement(plan, group, a, c, p, e)
                    team.task_sums[group] = _squared_norm(plan, form, group, e)
                else:
                    _process_group(plan, packets, group, a, right, p, b, k > 0, k < limits.max_iterations)
                if complete_task(team):
                    enough = k == limits.max_iterations
                    if measures:
                        total = _squared_norm(plan, form, groups, e)
                        for value in team.task_sums:
                            total += value
                        team.results[1] = np.sqrt(total)
                        enough = enough or check_residual(team.results[1], limits) != REASON_ITERATIONS
                    elif k > 0 and (
                        limits.residual_mode == RESIDUAL_EACH or (enough and limits.residual_mode == RESIDUAL_LAST)
                    ):
                        _compute_displacement(plan, groups, a, c, p, e)
                        release_phase(team, phase + 1)
                        continue
                    if enough:
                        team.results[0] = k
                        finish_phases(team)
                    else:
                        _process_top(plan, packets, a, right, p, b)
                        release_phase(team, 2 * k + 2)
        phase = wait_for_phase(team, phase)


@jit_inner_parallel
def _run_threads(plan, packets, form, vectors, right, p, limits, team, threads):
    for thread in prange(threads):
        first = thread * plan.top_range[2] // threads
        call_in_thread(team, _run_thread, (plan, packets, form, vectors, right, p, limits, team, first))


@jit_kernel
def run_iterations(plan, packets, form, vectors, right, p, limits, threads, team):
    """Iterate from the positions in the first vector, or from p if that is given.

    p is overwritten.

    Args:
        plan: the plan.
        packets: packets of the springs and edges.
        form: packets of |e|_Q^2, with pairs for all energies that are not springs.
        vectors: three vectors that rotate, and one for scratch, of float64.
        right: constant right-hand side (`SpringPackets.build_right_hand_side`).
        p: positions to correct, or None.
        limits: maximum number of iterations, and residuals that end them (`LoopLimits`).
        threads: number of threads; None for one.
        team: the thread team.

    Returns:
        The number of iterations, the last residual |p^k - p^(k-1)|_Q [J^(1/2)] over the unpinned vertices (nan if none
        was requested), and the last vector.
    """
    reset_team(team)
    team.results[1] = np.nan
    if threads is None:
        _run_thread(plan, packets, form, vectors, right, p, limits, team, 0)
    else:
        _run_threads(plan, packets, form, vectors, right, p, limits, team, threads)
        raise_thread_error(team)
    x0, x1, x2, _ = vectors
    done = int(team.results[0])
    return done, team.results[1], (x0, x1, x2)[done % 3]

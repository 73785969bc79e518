"""Multifrontal Cholesky factorisation of a matrix of d x d blocks (Duff and Reid 1983).

A front is the dense matrix of a supernode's columns and of the rows below, with a right-hand side as one more column.
Its columns become a panel of L; the remainder is an update of its parent
(`springbench.solvers.linalg.cholesky.block_front`). Threads process groups of whole subtrees, and then the supernodes
above them one after the other, each divided into parts. Every entry is the same sum in the same order, whatever the
groups and the parts are, so that results are bitwise independent of the number of threads.

Updates within a group are stored on two stacks that alternate between the levels of the tree. Each update is thus
computed in its place, while those of its children are read. All others have their own memory.

Two ranges of rows are aligned to whole vectors: those of a panel's columns, and those below. The columns of either are
padded to tiles of three and six, a panel's with those of the identity. There is no other padding. Entries above the
diagonal are never read; the diagonal contains the inverses of L's entries.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import ONE, ZERO, jit_inner, jit_inner_parallel, jit_kernel
from springbench.solvers.linalg.cholesky.block_front import (
    DenseFront,
    clear_lower_triangle,
    eliminate_front,
    eliminate_rows_below,
    factorise_diagonal_block,
    round_up_columns_inner,
    round_up_rows_inner,
    subtract_front_update,
    subtract_panel_product,
)
from springbench.solvers.linalg.cholesky.factorisation_schedule import (
    ASSEMBLY,
    BACKWARD,
    ELIMINATION,
    FORWARD,
    PRODUCT,
    SUBTREES,
)
from springbench.solvers.linalg.cholesky.thread_team import (
    call_in_thread,
    complete_task,
    finish_phases,
    raise_thread_error,
    read_shared,
    release_phase,
    reset_team,
    try_claim,
    wait_for_phase,
    write_shared,
)
from springbench.solvers.simd.front_tiles import (
    TILE_COLUMNS,
    TILE_ROWS,
    add_vector,
    backward_solve_tile,
    forward_solve_tile,
)

_NO_FAILURE = 1 << 62


class FactorisationScratch(NamedTuple):
    """Scratch memory of a factorisation by t threads.

    Attributes:
        fronts: one vector longer than the largest front, (t, .).
        updates: stacks of all threads, and shared updates.
        failures: first supernode of each group and of the top with a pivot that is not positive, (groups + 1,).
        failed_vertices: the vertex of this pivot, (groups + 1,).
        min_pivots: thresholds, (t, TILE_COLUMNS).
        triangles: factors of the tiles of a panel block, (t, ., TILE_COLUMNS, TILE_COLUMNS).
        runs: (t, 2, .), as long as the longest list of members, and one more.
    """

    fronts: NDArray[np.float64]
    updates: NDArray[np.float64]
    failures: NDArray[np.int64]
    failed_vertices: NDArray[np.int64]
    min_pivots: NDArray[np.float64]
    triangles: NDArray[np.float64]
    runs: NDArray[np.int64]


@jit_kernel
def run_stages(fronts, schedule, values, panels, x, scratch, team, threads):
    """Run the stages of a schedule: factorise, solve with the factor, or both.

    One kernel does all three, because each takes seconds to compile.

    Args:
        fronts: structure of the factor.
        schedule: stages and their division among threads.
        values: blocks (b, d, d); only a factorisation reads them.
        panels: factor L; a factorisation writes it.
        x: right-hand sides (n, d), or empty; overwritten with the solution.
        scratch: scratch memory.
        team: thread team.
        threads: number of threads, None for one.

    Returns:
        First supernode with a pivot that is not positive; -1 if there is none.
    """
    scratch.failures[:] = _NO_FAILURE
    reset_team(team)
    if threads is None:
        _run_in_thread(fronts, schedule, values, panels, x, scratch, team, ZERO, ONE)
    else:
        _run_in_threads(fronts, schedule, values, panels, x, scratch, team, threads)
        raise_thread_error(team)
    failure = _first_failure(scratch)
    return failure if failure < _NO_FAILURE else -1


@jit_inner_parallel
def _run_in_threads(fronts, schedule, values, panels, x, scratch, team, threads):
    for thread in prange(threads):
        call_in_thread(team, _run_in_thread, (fronts, schedule, values, panels, x, scratch, team, thread, threads))


@jit_inner
def _run_in_thread(fronts, schedule, values, panels, x, scratch, team, thread, threads):
    """Process tasks of all stages that no other thread has claimed."""
    tasks = len(team.task_sums)
    stage = ZERO
    while stage >= 0:
        for i in range(tasks):
            task = (thread * tasks // threads + i) % tasks
            if try_claim(team, task, stage):
                kind = schedule.stage_kind[stage]
                if kind == SUBTREES:
                    _factorise_group(fronts, schedule, task, values, panels, x, scratch, thread)
                elif kind == FORWARD:
                    _solve_forward(fronts, schedule, task, panels, x, scratch, thread)
                elif kind == BACKWARD:
                    _solve_backward(fronts, schedule, task, panels, x, scratch, thread)
                else:
                    _process_part(fronts, schedule, stage, values, panels, x, scratch, thread, task, tasks)
                if complete_task(team):
                    if _begin_stage(fronts, schedule, stage + 1, values, panels, x, scratch, thread):
                        release_phase(team, stage + 1)
                    else:
                        finish_phases(team)
        stage = wait_for_phase(team, stage)


@jit_inner
def _factorise_group(fronts, schedule, group, values, panels, x, scratch, thread):
    """Factorise the supernodes of a group."""
    for k in range(schedule.group_start[group], schedule.group_start[group + 1]):
        s = schedule.sequence[k]
        if s > _first_failure(scratch):
            return
        to = _front_of(fronts, schedule, s, panels, scratch, thread)
        members = fronts.member_start[s + 1] - fronts.member_start[s]
        _assemble_columns(fronts, schedule, s, values, to, scratch, thread, ZERO, members)
        failed = eliminate_front(fronts, s, values, to, scratch.min_pivots[thread], scratch.triangles[thread])
        if failed >= 0:
            scratch.failed_vertices[group] = failed
            write_shared(scratch.failures, group, s)
            return
        if len(x) > 0:
            _forward_substitution(fronts, schedule, s, panels, x, scratch, thread)
        subtract_front_update(to, _update_width(fronts, s), ZERO, ONE, _is_leaf(fronts, s))


@jit_inner
def _process_part(fronts, schedule, stage, values, panels, x, scratch, thread, part, parts):
    """Process one of several parts of a stage of the top."""
    kind, s, first = schedule.stage_kind[stage], schedule.stage_supernode[stage], schedule.stage_column[stage]
    to = _front_of(fronts, schedule, s, panels, scratch, thread)
    members = fronts.member_start[s + 1] - fronts.member_start[s]
    if kind == ASSEMBLY:
        begin, end = part * members // parts, (part + 1) * members // parts
        _assemble_columns(fronts, schedule, s, values, to, scratch, thread, begin, end)
    elif kind == ELIMINATION:
        eliminate_rows_below(to, first, scratch.triangles[0], part, parts)
    elif kind == PRODUCT:
        subtract_panel_product(to, first, part, parts)
    else:
        if part == 0 and len(x) > 0:
            _forward_substitution(fronts, schedule, s, panels, x, scratch, thread)
        subtract_front_update(to, _update_width(fronts, s), part, parts, _is_leaf(fronts, s))


@jit_inner
def _begin_stage(fronts, schedule, stage, values, panels, x, scratch, thread):
    """Prepare a stage in one thread; return whether the stage takes place.

    A supernode is processed unless one before it has failed, so that the first failure does not depend on threads.
    """
    if stage == len(schedule.stage_kind):
        return False
    kind, s = schedule.stage_kind[stage], schedule.stage_supernode[stage]
    failure = _first_failure(scratch)
    if kind == BACKWARD:
        if len(x) == 0 or failure < _NO_FAILURE:
            return False
        top = len(schedule.group_start) - 2
        if schedule.stage_kind[stage - 1] == FORWARD:
            _solve_forward(fronts, schedule, top, panels, x, scratch, thread)
        _solve_backward(fronts, schedule, top, panels, x, scratch, thread)
        return True
    if failure < s:
        return False
    if kind == ELIMINATION:
        to = _front_of(fronts, schedule, s, panels, scratch, thread)
        first, least = schedule.stage_column[stage], scratch.min_pivots[0]
        failed = factorise_diagonal_block(fronts, s, values, to, first, least, scratch.triangles[0])
        if failed >= 0:
            scratch.failed_vertices[len(scratch.failures) - 1] = failed
            write_shared(scratch.failures, len(scratch.failures) - 1, s)
            return False
    return True


@jit_inner
def _first_failure(scratch):
    """Return the first supernode that is known to have failed."""
    failure = _NO_FAILURE
    for k in range(len(scratch.failures)):
        failure = min(failure, read_shared(scratch.failures, k))
    return failure


@jit_inner
def _front_of(fronts, schedule, supernode, panels, scratch, thread):
    """Return the front of a supernode that a thread processes."""
    _, own, _, head, stride = _front_sizes(fronts, supernode)
    update = _locate_update(schedule, supernode, thread)
    width = round_up_columns_inner(fronts.block_size * own)
    return DenseFront(
        own, width, head, stride, panels, fronts.panel_start[supernode], scratch.updates, update, stride - head
    )


@jit_inner
def _is_leaf(fronts, supernode):
    """Return 1 if a supernode has no children, else 0."""
    return ONE if fronts.first_child[supernode] < 0 else ZERO


@jit_inner
def _locate_update(schedule, supernode, thread):
    """Return the first entry of an update."""
    base = 0 if schedule.is_shared[supernode] else thread * schedule.thread_stack_size[0]
    return base + schedule.update_start[supernode]


@jit_inner
def _assemble_columns(fronts, schedule, supernode, values, to, scratch, thread, begin, end):
    """Assemble the columns of a front between two members: matrix blocks, and the children's updates."""
    size = fronts.block_size
    left = size * begin if begin < to.num_columns else to.width
    right = size * end if end < to.num_columns else to.width
    clear_lower_triangle(to.panels, to.panel_offset, to.stride, left, right)
    first, last = to.panel_offset + left * to.stride, to.panel_offset + right * to.stride
    if not _is_leaf(fronts, supernode):
        above, below = size * max(0, begin - to.num_columns), size * max(0, end - to.num_columns)
        clear_lower_triangle(to.update_buffer, to.update_offset, to.update_stride, above, below)
    for k in range(fronts.block_start[supernode], fronts.block_start[supernode + 1]):
        e, at = fronts.block_index[k], fronts.entry_offset[k]
        if first <= at < last:
            for j in range(size):
                for i in range(size):
                    to.panels[at + j * to.stride + i] += values[e, j, i]
    if begin < to.num_columns <= end:
        for j in range(size * to.num_columns, to.width):
            to.panels[to.panel_offset + j * to.stride + j] = 1.0
    child = fronts.first_child[supernode]
    while child >= 0:
        at = _locate_update(schedule, child, thread)
        _extend_add(fronts, child, scratch.updates, at, to, scratch.runs[thread], begin, end)
        child = fronts.next_sibling[child]


@jit_inner
def _find_runs(fronts, child, num_columns, below_offset, begin, runs):
    """List the runs of consecutive members in a child's update; return their number.

    The first run begins with member `begin`. Each run begins at a row of the update, runs[0], and at a row of the
    parent's front, runs[1].
    """
    first, size = fronts.member_start[child] + fronts.num_columns[child], fronts.block_size
    rows = fronts.member_start[child + 1] - first
    count = 0
    for k in range(begin, rows):
        q = fronts.parent_position[first + k]
        if k == begin or q != fronts.parent_position[first + k - 1] + 1 or q == num_columns:
            runs[0, count] = k
            runs[1, count] = size * q if q < num_columns else below_offset + size * (q - num_columns)
            count += 1
    runs[0, count] = rows
    return count


@jit_inner
def _extend_add(fronts, child, source, at, to, runs, begin, end):
    """Add columns of a child's update to the parent's front.

    begin, end: range of the parent's members.
    """
    own, first = to.num_columns, fronts.member_start[child] + fronts.num_columns[child]
    size = fronts.block_size
    rows = fronts.member_start[child + 1] - first
    height = round_up_rows_inner(size * rows)
    b = 0
    while b < rows and fronts.parent_position[first + b] < begin:
        b += 1
    count = _find_runs(fronts, child, own, to.below_offset, b, runs)
    run = 0
    while b < rows and fronts.parent_position[first + b] < end:
        if runs[0, run + 1] == b:
            run += 1
        q = fronts.parent_position[first + b]
        for j in range(size):
            start = at + (size * b + j) * height
            if q < own:
                column = to.panel_offset + (size * q + j) * to.stride
                _add_runs(runs, run, count, b, size, source, start, to.panels, column)
            else:
                column = to.update_offset + (size * (q - own) + j) * to.update_stride - to.below_offset
                _add_runs(runs, run, count, b, size, source, start, to.update_buffer, column)
        b += 1


@jit_inner
def _add_runs(runs, run, count, b, size, source, start, target, column):
    """Add the rows of a column, from member b on."""
    for k in range(run, count):
        a = max(b, runs[0, k])
        to = column + runs[1, k] + size * (a - runs[0, k])
        add_vector(source, start + size * a, target, to, size * (runs[0, k + 1] - a))


@jit_inner
def _forward_substitution(fronts, schedule, supernode, panels, x, scratch, thread):
    """Perform the forward substitution with the panel of a supernode; children precede parents."""
    first, own, _, head, stride = _front_sizes(fronts, supernode)
    front, updates, size = scratch.fronts[thread], scratch.updates, fronts.block_size
    front[: stride + TILE_ROWS] = 0.0
    _gather_vertices(x, fronts.member_vertices, first, own, front, ZERO, size)
    child = fronts.first_child[supernode]
    while child >= 0:
        rows = fronts.member_start[child + 1] - fronts.member_start[child] - fronts.num_columns[child]
        at = _locate_update(schedule, child, thread) + _update_width(fronts, child) * round_up_rows_inner(size * rows)
        _add_update(fronts, child, rows, own, head, updates, at, front)
        child = fronts.next_sibling[child]
    width = round_up_columns_inner(size * own)
    for tile in range(0, width, TILE_COLUMNS):
        columns, corner = min(TILE_COLUMNS, width - tile), fronts.panel_start[supernode] + tile * stride + tile
        strips = (stride - tile - columns + TILE_ROWS - 1) // TILE_ROWS
        if columns == 6:
            forward_solve_tile(panels, corner, stride, front, tile, strips, 6)
        else:
            forward_solve_tile(panels, corner, stride, front, tile, strips, 3)
    _scatter_vertices(front, 0, x, fronts.member_vertices, first, own, size)
    at = _locate_update(schedule, supernode, thread) + _update_width(fronts, supernode) * (stride - head)
    for k in range(stride - head):
        updates[at + k] = front[head + k]


@jit_inner
def _solve_forward(fronts, schedule, group, panels, x, scratch, thread):
    """Perform the forward substitution of a group or of the top."""
    for k in range(schedule.group_start[group], schedule.group_start[group + 1]):
        _forward_substitution(fronts, schedule, schedule.sequence[k], panels, x, scratch, thread)


@jit_inner
def _solve_backward(fronts, schedule, group, panels, x, scratch, thread):
    """Perform the backward substitution of a group or of the top."""
    front, size = scratch.fronts[thread], fronts.block_size
    for k in range(schedule.group_start[group + 1] - 1, schedule.group_start[group] - 1, -1):
        s = schedule.sequence[k]
        first, own, below, head, stride = _front_sizes(fronts, s)
        front[: stride + TILE_ROWS] = 0.0
        _gather_vertices(x, fronts.member_vertices, first, own, front, ZERO, size)
        _gather_vertices(x, fronts.member_vertices, first + own, below, front, head, size)
        width = round_up_columns_inner(size * own)
        for tile in range((width - 1) // TILE_COLUMNS * TILE_COLUMNS, -1, -TILE_COLUMNS):
            columns, corner = min(TILE_COLUMNS, width - tile), fronts.panel_start[s] + tile * stride + tile
            strips = (stride - tile - columns + TILE_ROWS - 1) // TILE_ROWS
            if columns == 6:
                backward_solve_tile(panels, corner, stride, front, tile, strips, 6)
            else:
                backward_solve_tile(panels, corner, stride, front, tile, strips, 3)
        _scatter_vertices(front, 0, x, fronts.member_vertices, first, own, size)


@jit_inner
def _front_sizes(fronts, supernode):
    """Return the sizes of a front.

    These are the first member, the columns and rows below in vertices, and begin and end of those rows in the panel.
    """
    first, own, size = fronts.member_start[supernode], fronts.num_columns[supernode], fronts.block_size
    below, head = (
        fronts.member_start[supernode + 1] - first - own,
        round_up_rows_inner(round_up_columns_inner(size * own)),
    )
    return first, own, below, head, head + round_up_rows_inner(size * below)


@jit_inner
def _update_width(fronts, supernode):
    """Return the number of columns of an update without its right-hand side."""
    members = fronts.member_start[supernode + 1] - fronts.member_start[supernode]
    return round_up_columns_inner(fronts.block_size * (members - fronts.num_columns[supernode]))


@jit_inner
def _add_update(fronts, child, rows, num_columns, below_offset, updates, at, front):
    """Add a child's update of the right-hand side to the front."""
    first, size = fronts.member_start[child] + fronts.num_columns[child], fronts.block_size
    for k in range(rows):
        q = fronts.parent_position[first + k]
        to = size * q if q < num_columns else below_offset + size * (q - num_columns)
        if size == 3:
            for c in range(3):
                front[to + c] += updates[at + 3 * k + c]
        else:
            for c in range(size):
                front[to + c] += updates[at + size * k + c]


@jit_inner
def _gather_vertices(x, members, first, count, front, at, size):
    if size == 3:  # loops of constant length are unrolled
        for k in range(count):
            for c in range(3):
                front[at + 3 * k + c] = x[members[first + k], c]
    else:
        for k in range(count):
            for c in range(size):
                front[at + size * k + c] = x[members[first + k], c]


@jit_inner
def _scatter_vertices(front, at, x, members, first, count, size):
    if size == 3:
        for k in range(count):
            for c in range(3):
                x[members[first + k], c] = front[at + 3 * k + c]
    else:
        for k in range(count):
            for c in range(size):
                x[members[first + k], c] = front[at + size * k + c]

"""Division of a multifrontal factorisation among threads.

Threads process groups of subtrees, and then parts of each supernode above them. Where a thread stores updates is fixed
in advance, too. Neither changes any result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import cached_njit
from springbench.solvers.linalg.cholesky.supernode_amalgamation import group_subtrees

SUBTREES, ASSEMBLY, ELIMINATION, PRODUCT, UPDATE, FORWARD, BACKWARD = range(7)
"""Kinds of stages. SUBTREES: all groups. ASSEMBLY and UPDATE: assembly and update of a front. ELIMINATION and PRODUCT:
rows below a panel block, and columns to its right. FORWARD: forward substitution of all groups, in a solve without
factorisation. BACKWARD: backward substitution of all groups, at the end."""

_TASKS_PER_THREAD = 4
"""Groups, and parts of a front, for each thread: others process the tasks of a thread that is interrupted."""

_UPDATE_COST = 16.0
"""Cost of an entry of an update, which is stored, read and added, in flops."""


class FactorisationSchedule(NamedTuple):
    """Division of a factorisation, or of a solve, among threads.

    Attributes:
        sequence: supernodes group by group, followed by those above all groups, the top; (s,).
        group_start: first of each group and of the top in the sequence, and its end, (groups + 2,).
        update_start: first entry of each update, (s,).
        is_shared: whether an update has its own memory; the others are stored in that of their thread, (s,).
        stage_kind: kind of each stage, (p,).
        stage_supernode: supernode of each stage of the top, (p,).
        stage_column: first column of its panel block, (p,).
        thread_stack_size: entries of both stacks of a thread, (1,).
    """

    sequence: NDArray[np.int64]
    group_start: NDArray[np.int64]
    update_start: NDArray[np.int64]
    is_shared: NDArray[np.bool_]
    stage_kind: NDArray[np.int64]
    stage_supernode: NDArray[np.int64]
    stage_column: NDArray[np.int64]
    thread_stack_size: NDArray[np.int64]


def plan_schedule(
    parent: NDArray[np.int64],
    flops: NDArray[np.float64],
    widths: NDArray[np.int64],
    update_sizes: NDArray[np.int64],
    panel_depth: int,
    threads: int,
) -> tuple[FactorisationSchedule, int]:
    """Plan a factorisation by threads.

    Args:
        parent: parent of each supernode, which are in postorder (s,).
        flops: operations of each elimination (s,).
        widths: columns of each panel (s,).
        update_sizes: entries of each update (s,).
        panel_depth: columns of a panel block.
        threads: number of threads.

    Returns:
        The schedule, and the number of entries of all updates that exist at once.
    """
    groups = 1 if threads == 1 else _TASKS_PER_THREAD * threads
    group = group_subtrees(parent, flops + _UPDATE_COST * update_sizes, groups)
    sequence = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[sequence], np.arange(groups + 2))
    update_start, is_shared, stack, shared = _place_updates(parent, group, groups, update_sizes)
    update_start[is_shared] += 2 * stack * threads
    stages = [(SUBTREES, 0, 0)]
    for s in sequence[starts[groups] :].tolist():
        stages.append((ASSEMBLY, s, 0))
        for first in range(0, int(widths[s]), panel_depth):
            stages.append((ELIMINATION, s, first))
            if first + panel_depth < widths[s]:
                stages.append((PRODUCT, s, first))
        stages.append((UPDATE, s, 0))
    stages.append((BACKWARD, 0, 0))
    columns = np.array(stages, np.int64).T.copy()
    schedule = FactorisationSchedule(
        sequence, starts, update_start, is_shared, *columns, thread_stack_size=np.array([2 * stack])
    )
    return schedule, 2 * stack * threads + shared


def select_solve(schedule: FactorisationSchedule) -> FactorisationSchedule:
    """Return the schedule of a solve with the factor of a schedule."""
    none = np.zeros(2, np.int64)
    return schedule._replace(
        stage_kind=np.array([FORWARD, BACKWARD], np.int64), stage_supernode=none, stage_column=none
    )


@cached_njit()
def _place_updates(parent, group, groups, sizes):
    """Return where each update is stored.

    The results are its first entry, whether it is shared, and the sizes of a stack and of all shared updates. An update
    whose parent is in the same group is on that of two stacks on which its children are not.
    """
    nodes = len(parent)
    start, shared = np.zeros(nodes, np.int64), np.zeros(nodes, np.bool_)
    side = np.zeros(nodes, np.int64)
    for k in range(nodes - 1, -1, -1):
        shared[k] = group[k] == groups or (parent[k] >= 0 and group[parent[k]] == groups)
        if parent[k] >= 0:
            side[k] = 1 - side[parent[k]]
    top, pending = np.zeros((groups, 2), np.int64), np.zeros(nodes, np.int64)
    stack, total = 0, 0
    for k in range(nodes):
        if shared[k]:
            start[k] = total
            total += sizes[k]
        else:
            start[k] = top[group[k], side[k]]
            stack = max(stack, start[k] + sizes[k])
        if group[k] < groups:
            top[group[k], 1 - side[k]] -= pending[k]
            if not shared[k] and parent[k] >= 0:
                top[group[k], side[k]] += sizes[k]
                pending[parent[k]] += sizes[k]
    for k in range(nodes):
        if not shared[k] and side[k] == 1:
            start[k] += stack
    return start, shared, stack, total

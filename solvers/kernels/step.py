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

A vector has rows of four numbers: the slots of `Supernodal`, the groups' copies of the top, the vertices that do not
move, and two padding rows of the packets. With `p` None it holds positions, and a solve gives the next ones. Otherwise
it holds corrections of the positions p (n rows in float64), which may have a lower precision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from solvers.compiling import inner, inner_in_parallel, kernel
from solvers.kernels.edges import add_edges
from solvers.kernels.loop import EACH, ITERATIONS, LAST, verdict
from solvers.kernels.springs import add_descent, add_projection, squared_norm
from solvers.linear.supernodal_solve import backwards, forwards
from solvers.linear.team import claim, finish, following, go_on, last, start


class Plan(NamedTuple):
    """The order of the operations of an iteration and their data.

    Attributes:
        squares, panels, places, chunks: arrays of a factor (see
            `solvers.linear.supernodal`).
        top: first and last of the top's rows, and the number of groups (3,).
        blocks: of each block its first and last slot, its first and last packet, its first chunk, and its last
            chunk for forward and for back substitution (b, 7).
        of_group: first block of each group and of the top (groups + 2,).
        visits: operations of the groups in order; 2 b is back substitution of block b, 2 b + 1 its local step
            and forward substitution.
        visits_of: first visit of each group (groups + 1,).
        held: m/dt^2 + w [N/m] of each row, plus the diagonal of quadratic forms.
        measure: diagonal part of |e|_Q^2 in each lane of the packets: `held` without the pins, and
            half of each spring to an exactly pinned vertex, because no packet of that vertex includes the other half.
        loose: 1 for the rows of unpinned vertices, else 0.
        shift: number of rows from a vertex's position to its right-hand side.
    """

    squares: NDArray[np.float64]
    panels: NDArray[np.float64]
    places: NDArray[np.int32]
    chunks: NDArray[np.int64]
    top: NDArray[np.int64]
    blocks: NDArray[np.int64]
    of_group: NDArray[np.int64]
    visits: NDArray[np.int64]
    visits_of: NDArray[np.int64]
    held: NDArray[np.float64]
    measure: NDArray[np.float64]
    loose: NDArray[np.float64]
    shift: int


# These take slices: then the compiler knows that a loop starts at no negative index, and vectorises it.
@inner
def _zero(a):
    for i in range(len(a)):
        a[i] = 0.0


@inner
def _copy(a, b):
    for i in range(len(a)):
        b[i] = a[i]


@inner
def _add(a, b):
    for i in range(len(a)):
        b[i] += a[i]


@inner
def _up(plan, bundles, edges, block, x, right, p, out):
    """Do the local step of a block at x (at p, if that is given) and its forward substitution."""
    slot, slot_end, bundle, bundle_end, chunk, chunk_end, _ = plan.blocks[block]
    if p is None:
        add_projection(bundles, bundle, bundle_end, x, right, out, plan.shift)
        add_edges(edges, slot, slot_end, x, out, plan.shift, False)
    else:
        add_descent(bundles, bundle, bundle_end, p, right, out, plan.shift)
        add_edges(edges, slot, slot_end, p, out, plan.shift, True)
    forwards(plan.panels, plan.places, plan.chunks, chunk, chunk_end, out)


@inner
def _down(plan, block, x, p):
    """Do the back substitution of a block and correct its positions."""
    slot, slot_end, _, _, chunk, _, chunk_end = plan.blocks[block]
    backwards(plan.squares, plan.panels, plan.places, plan.chunks, chunk, chunk_end, x)
    if p is not None:
        _add(x[4 * slot : 4 * slot_end], p[4 * slot : 4 * slot_end])


@inner
def _clear(plan, block, out):
    begin, end = plan.blocks[block, 0] + plan.shift, plan.blocks[block, 1] + plan.shift
    _zero(out[4 * begin : 4 * end])


@inner
def _group(plan, bundles, edges, group, x, right, p, out, down, up):
    """Process a group in the order of its visits: down with the vector x, and up with `out`."""
    top = 4 * plan.top[0]
    size = 4 * plan.top[1] - top
    copy = top + (group + 1) * size
    if down:
        _copy(x[top : top + size], x[copy : copy + size])
    if up:
        _zero(out[copy : copy + size])
    for visit in plan.visits[plan.visits_of[group] : plan.visits_of[group + 1]]:
        block = visit >> 1
        if visit & 1 == 0:
            if down:
                _down(plan, block, x, p)
            if up:
                _clear(plan, block, out)
        elif up:
            _up(plan, bundles, edges, block, x, right, p, out)


@inner
def _turn(plan, bundles, edges, x, right, p, out):
    """Process the top: up at the positions x, and down again."""
    top, top_end, groups = plan.top
    size = 4 * (top_end - top)
    for group in range(groups):
        begin = 4 * top_end + group * size
        if group == 0:
            _copy(out[begin : begin + size], out[4 * top : 4 * top_end])
        else:
            _add(out[begin : begin + size], out[4 * top : 4 * top_end])
    for block in range(plan.of_group[-2], plan.of_group[-1]):
        _up(plan, bundles, edges, block, x, right, p, out)
        _down(plan, block, out, p)


@inner
def _displace(plan, part, x, before, p, e):
    """Write e = p^k - p^(k-1) of the unpinned vertices of a group or the top."""
    begin, end = plan.of_group[part], plan.of_group[part + 1]
    if begin < end:
        for i in range(plan.blocks[begin, 0], plan.blocks[end - 1, 1]):
            for k in range(4 * i, 4 * i + 3):
                e[k] = plan.loose[i] * (x[k] - before[k] if p is None else x[k])


@inner
def _squared(plan, form, part, e):
    """Return |e|_Q^2 [J] of a group or the top, with half of each spring at either end."""
    begin, end = plan.of_group[part], plan.of_group[part + 1]
    if begin == end:
        return 0.0
    return squared_norm(form, plan.blocks[begin, 2], plan.blocks[end - 1, 3], e, plan.measure)


@kernel
def length(plan, form, x, before, p, e):
    """Return the residual [J^(1/2)] of an iteration from its vectors, as `iterate` defines it; e: scratch."""
    groups = plan.top[2]
    for part in range(groups + 1):
        _displace(plan, part, x, before, p, e)
    total = _squared(plan, form, groups, e)
    for group in range(groups):
        total += _squared(plan, form, group, e)
    return np.sqrt(total)


@kernel
def local(plan, bundles, edges, x, right, p, out):
    """Do the local step of all blocks without a solve."""
    for k in range(len(out)):
        out[k] = 0.0
    if p is None:
        add_projection(bundles, 0, len(bundles.start) - 1, x, right, out, plan.shift)
    else:
        add_descent(bundles, 0, len(bundles.start) - 1, p, right, out, plan.shift)
    for block in range(len(plan.blocks)):
        begin, end = plan.blocks[block, 0], plan.blocks[block, 1]
        if p is None:
            add_edges(edges, begin, end, x, out, plan.shift, False)
        else:  # of another precision than x
            add_edges(edges, begin, end, p, out, plan.shift, True)


@inner
def _share(plan, bundles, edges, form, vectors, right, p, limits, team, first):
    """Do a thread's part of the iterations: the groups from `first` on that no other thread has claimed.

    Phase 2 k is iteration k, phase 2 k + 1 computes its residual if it is requested.
    """
    x0, x1, x2, e = vectors
    turns = x0, x1, x2
    groups = plan.top[2]
    phase = 0
    while phase >= 0:
        k, measures = phase // 2, phase % 2 == 1
        # Positions p^k are in a, or being computed there, and the previous ones in c.
        a, b, c = turns[k % 3], turns[(k + 1) % 3], turns[(k + 2) % 3]
        for i in range(groups):
            # Alternating order: the last data read are still in the cache.
            group = (first + (groups - 1 - i if k % 2 == 1 else i)) % groups
            if claim(team, group, phase):
                if measures:
                    _displace(plan, group, a, c, p, e)
                    team.sums[group] = _squared(plan, form, group, e)
                else:
                    _group(plan, bundles, edges, group, a, right, p, b, k > 0, k < limits.iterations)
                if last(team):
                    enough = k == limits.iterations
                    if measures:
                        total = _squared(plan, form, groups, e)
                        for value in team.sums:
                            total += value
                        team.found[1] = np.sqrt(total)
                        enough = enough or verdict(team.found[1], limits) != ITERATIONS
                    elif k > 0 and (limits.wanted == EACH or (enough and limits.wanted == LAST)):
                        _displace(plan, groups, a, c, p, e)
                        go_on(team, phase + 1)
                        continue
                    if enough:
                        team.found[0] = k
                        finish(team)
                    else:
                        _turn(plan, bundles, edges, a, right, p, b)
                        go_on(team, 2 * k + 2)
        phase = following(team, phase)


@inner_in_parallel
def _side_by_side(plan, bundles, edges, form, vectors, right, p, limits, team, threads):
    for thread in prange(threads):
        _share(plan, bundles, edges, form, vectors, right, p, limits, team, thread * plan.top[2] // threads)


@kernel
def iterate(plan, bundles, edges, form, vectors, right, p, limits, threads, team):
    """Iterate from the positions in the first vector, or from p if that is given, which is then overwritten.

    Args:
        plan: the plan.
        bundles: packets of the springs.
        edges: strain limits and dashpots, or None.
        form: packets of |e|_Q^2, with pairs for all energies that are not springs.
        vectors: three vectors that rotate, and one for scratch, of float64.
        right: constant right-hand side (see `Bundles.right`).
        p: positions to correct, or None.
        limits: see `solvers.kernels.loop`.
        threads: number of threads; None for one.
        team: the thread team.

    Returns:
        The number of iterations, the last residual |p^k - p^(k-1)|_Q [J^(1/2)] over the unpinned vertices (nan if none
        was requested), and the last vector.
    """
    start(team)
    team.found[1] = np.nan
    if threads is None:
        _share(plan, bundles, edges, form, vectors, right, p, limits, team, 0)
    else:
        _side_by_side(plan, bundles, edges, form, vectors, right, p, limits, team, threads)
    x0, x1, x2, _ = vectors
    done = int(team.found[0])
    return done, team.found[1], (x0, x1, x2)[done % 3]

"""The two passes of a solve over the panels of a factor.

forwards, children first:   y_below += W y_own
backwards, parents first:   y_own = S y_own + W' y_below
"""

from __future__ import annotations

from numba import njit

from solvers.linear.supernodal_vectors import add_forward, set_backward


@njit(cache=True)
def load(b, vertex, work):
    """The right-hand sides b (n, 3) to the rows of `work`; padding gets zeros."""
    for i in range(len(vertex)):
        v = vertex[i]
        if v >= 0:
            for c in range(3):
                work[4 * i + c] = b[v, c]
        else:
            for c in range(3):
                work[4 * i + c] = 0.0
        work[4 * i + 3] = 0.0


@njit(cache=True)
def store(work, slot, out):
    """The solution in `work` to out (n, 3)."""
    for v in range(len(slot)):
        i = slot[v]
        for c in range(3):
            out[v, c] = work[4 * i + c]


@njit(cache=True)
def forwards(panels, index, chunks, begin, end, work):
    """The pass forwards over the chunks from `begin` to `end`."""
    for k in range(begin, end):
        offset, at, count, own, quads, first = chunks[k]
        offset += 4 * quads * own
        at += own
        count -= own
        if quads == 4:
            add_forward(panels, offset, index, at, count, work, first, work, 0, 4)
        elif quads == 1:
            add_forward(panels, offset, index, at, count, work, first, work, 0, 1)
        elif quads == 2:
            add_forward(panels, offset, index, at, count, work, first, work, 0, 2)
        else:
            add_forward(panels, offset, index, at, count, work, first, work, 0, 3)


@njit(cache=True)
def backwards(panels, index, chunks, begin, end, work):
    """The pass backwards over the chunks from `end` down to `begin`."""
    for k in range(end - 1, begin - 1, -1):
        offset, at, count, _own, quads, first = chunks[k]
        if quads == 4:
            set_backward(panels, offset, index, at, count, work, first, 4)
        elif quads == 1:
            set_backward(panels, offset, index, at, count, work, first, 1)
        elif quads == 2:
            set_backward(panels, offset, index, at, count, work, first, 2)
        else:
            set_backward(panels, offset, index, at, count, work, first, 3)


@njit(cache=True)
def solve(panels, index, chunks, vertex, slot, work, b, out):
    """Q out = b on one thread."""
    load(b, vertex, work)
    forwards(panels, index, chunks, 0, len(chunks), work)
    backwards(panels, index, chunks, 0, len(chunks), work)
    store(work, slot, out)

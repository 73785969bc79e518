"""Fill-reducing ordering of a sparse symmetric matrix by nested dissection (George 1973) of its graph.

A separator is found from graph distances alone. Breadth-first distances from distant vertices a, b, c, ... serve as
coordinates (farthest-point choice, as in Harel and Koren's high-dimensional embedding 2002). The fields a - b,
(a + c) - (b + d), ... are cut where their vertex boundary is smallest relative to the balance of the cut. The separator
is then refined by moves of single vertices (Fiduccia and Mattheyses 1982; for separators: Ashcraft and Liu 1996). Small
pieces are ordered by minimum degree, counting the surrounding separators (halo minimum degree: Pellegrini, Roman and
Amestoy 2000).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import cached_njit, jit_inner_allocating
from springbench.solvers.linalg.cholesky.minimum_degree import minimum_degree_order, order_subgraph
from springbench.solvers.linalg.cholesky.separator_refinement import refine_separator
from springbench.solvers.linalg.cholesky.vertex_separator import FIELDS_PER_BLOCK, NUM_LANDMARKS, find_separator

_MAX_LEAF_SIZE = 96
"""Pieces up to this size are not dissected: below it a separator saves less than minimum degree does."""


def nested_dissection_order(pointers: NDArray[np.int64], neighbours: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the elimination order of a graph's vertices.

    Args:
        pointers: row pointers (n + 1,) of the graph in CSR form; symmetric, loops allowed.
        neighbours: column indices.

    Returns:
        Order (n,): entry i is the i-th vertex to eliminate.
    """
    n = len(pointers) - 1
    order = np.arange(n, dtype=np.int32)
    if n <= _MAX_LEAF_SIZE:  # for small meshes, a kernel that compiles five times as fast
        minimum_degree_order(pointers, neighbours, order)
    else:
        _dissect_graph(pointers, neighbours, order, _MAX_LEAF_SIZE)
    return order


@cached_njit()
def _dissect_graph(pointers, neighbours, order, leaf):
    """Sort `order` into elimination order: of every piece, its parts first and its separator last."""
    n = len(order)
    owner = np.zeros(n, np.int32)  # the piece that a vertex is in; -1 once it is in a separator
    dist = np.zeros((n, NUM_LANDMARKS), np.int32)
    field = np.empty((n, FIELDS_PER_BLOCK), np.int32)
    local = np.full(n, -1, np.int32)
    scratch = np.empty(n, np.int32)
    stack = [(0, n, False)]  # first, end, known to be connected
    pieces = 0
    while len(stack) > 0:
        first, end, connected = stack.pop()
        piece = order[first:end]
        pieces += 1
        for v in piece:
            owner[v] = pieces
        if end - first <= leaf:
            order_subgraph(pointers, neighbours, piece, local)
            continue
        if not connected:
            _split_components(pointers, neighbours, owner, pieces, order, first, end, leaf, scratch, stack)
            continue
        side = find_separator(pointers, neighbours, owner, pieces, piece, dist, field, scratch)
        if len(side) == 0:  # nearly complete: nothing separates it
            order_subgraph(pointers, neighbours, piece, local)
            continue
        refine_separator(pointers, neighbours, piece, side, local)
        at = begun = first
        for kind in range(3):
            begun = at
            for i in range(end - first):
                if side[i] == kind:
                    scratch[at] = piece[i]
                    at += 1
            if kind < 2:
                stack.append((begun, at, False))
        for i in range(begun, end):
            owner[scratch[i]] = -1
        for i in range(first, end):
            order[i] = scratch[i]


@jit_inner_allocating
def _split_components(pointers, neighbours, owner, piece, order, first, end, leaf, queue, stack):
    """Push a piece's components to the stack; combine small ones up to the leaf size."""
    at, begun = first, first
    for i in range(first, end):
        root = order[i]
        if owner[root] != piece:
            continue
        start = at
        queue[at] = root
        owner[root] = 0
        at += 1
        head = start
        while head < at:
            v = queue[head]
            head += 1
            for e in range(pointers[v], pointers[v + 1]):
                u = neighbours[e]
                if owner[u] == piece:
                    owner[u] = 0
                    queue[at] = u
                    at += 1
        if at - begun > leaf and start > begun:
            stack.append((begun, start, False))
            begun = start
        if at - start > leaf:
            stack.append((begun, at, True))
            begun = at
    if at > begun:
        stack.append((begun, at, False))
    for i in range(first, end):
        order[i] = queue[i]

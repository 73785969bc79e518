"""Colourings for Gauss-Seidel methods: items of one colour are independent, so their order is irrelevant.

Springs are adjacent if they share a vertex, vertices if they share a spring. Each item gets the first free colour
(greedy, in order of its index). Springs need at most twice the largest degree of colours, vertices at most the largest
number of neighbours plus one. Items of one colour can be processed in parallel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.model.system_matrix_assembly import compute_row_starts, signed_incidence_matrix_sparse


@dataclass(frozen=True, eq=False)
class Colouring:
    """A colouring of items.

    Attributes:
        item_order: the items by colour, then by index.
        colour_starts: start of each colour in that order (colours + 1,).
    """

    item_order: NDArray[np.int64]
    colour_starts: NDArray[np.int64]

    @property
    def num_colours(self) -> int:
        """Number of colours."""
        return len(self.colour_starts) - 1


def colour_springs(edges: NDArray[np.int64], n: int) -> Colouring:
    """Colour springs so that no two of a colour share a vertex.

    Args:
        edges: vertices of the springs (m, 2).
        n: number of vertices.
    """
    A = signed_incidence_matrix_sparse(edges, n)
    return _colour_rows(A, csr_array(A.T))


def colour_vertices(edges: NDArray[np.int64], n: int) -> Colouring:
    """Colour vertices so that no two of a colour share a spring.

    Args:
        edges: adjacent vertices (m, 2), by springs or by other couplings.
        n: number of vertices.
    """
    A = signed_incidence_matrix_sparse(edges, n)
    return _colour_rows(csr_array(A.T), A)


def _colour_rows(groups: csr_array, items: csr_array) -> Colouring:
    """Colour the rows of `groups`, where rows that share a column are adjacent.

    `items` is the transpose.
    """
    for matrix in (groups, items):
        matrix.sort_indices()
    count = len(groups.indptr) - 1
    colour, taken = np.zeros(count, np.int64), np.full(count, -1)
    pointers, columns, back, rows = (
        np.asarray(x, np.int64) for x in (groups.indptr, groups.indices, items.indptr, items.indices)
    )
    _assign_first_free_colours(pointers, columns, back, rows, colour, taken)
    start = compute_row_starts(colour, int(colour.max(initial=-1)) + 1)
    return Colouring(np.argsort(colour, kind="stable"), start)


@jit_kernel
def _assign_first_free_colours(pointers, groups, back, items, colour, taken):
    """Write to `colour` the first free colour of each item, in order.

    A colour is free if no earlier item in the groups of the item has it.

    Args:
        pointers, groups: groups[pointers[a]:pointers[a + 1]] are the groups of item a.
        back, items: items[back[g]:back[g + 1]] are the items of group g, ascending.
        colour: output, one number per item.
        taken: scratch, one number per item, all -1.
    """
    for a in range(len(colour)):
        for k in range(pointers[a], pointers[a + 1]):
            for other in items[back[groups[k]] : back[groups[k] + 1]]:
                if other >= a:
                    break
                taken[colour[other]] = a
        c = 0
        while taken[c] == a:
            c += 1
        colour[a] = c

"""Multilevel additive Schwarz preconditioner: dense inverses of small subdomains (Wu, Wang and Wang 2022).

    S = sum over levels l of P_l diag(B_l^-1) P_l'        B_l: diagonal blocks of SUBDOMAIN_SIZE nodes of P_l'A P_l

A consists of 3 x 3 blocks. The nodes of level 0 are its block rows, ordered so that neighbours form subdomains. A
subdomain of one level moves rigidly and is a node of the next. Node i of a level therefore belongs to node
i // SUBDOMAIN_SIZE of the next one, and no lists are needed. S is symmetric, and positive definite if A is; its
application consists of products with dense matrices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.model.step_problem import Positions

SUBDOMAIN_SIZE = 32
"""Nodes of a subdomain: the number of threads of a device that run in lockstep."""


class SubdomainHierarchy:
    """Positions of a matrix's blocks in subdomains; subdomain_order (f,): its rows, grouped by subdomain."""

    def __init__(self, graph: csr_array, order: NDArray[np.int64]) -> None:
        """Build the hierarchy.

        Args:
            graph: pattern of blocks (f, f).
            order: rows grouped by subdomain, (f,).
        """
        self.subdomain_order, n, entries = order, len(order), graph.nnz
        place = np.empty(n, np.int64)
        place[order] = np.arange(n)
        i, j = place[np.repeat(np.arange(n), np.diff(graph.indptr))], place[graph.indices]
        self._levels = list[tuple[int, csr_array]]()
        while True:
            inside = np.flatnonzero(i // SUBDOMAIN_SIZE == j // SUBDOMAIN_SIZE)
            at, patches = i[inside] * SUBDOMAIN_SIZE + j[inside] % SUBDOMAIN_SIZE, -(-n // SUBDOMAIN_SIZE)
            ones = np.ones(len(inside))
            self._levels.append((n, csr_array((ones, (at, inside)), shape=(patches * SUBDOMAIN_SIZE**2, entries))))
            if n <= SUBDOMAIN_SIZE:
                break
            i, j, n = i // SUBDOMAIN_SIZE, j // SUBDOMAIN_SIZE, patches

    def build_preconditioner(self, blocks: NDArray[np.float64]) -> AdditiveSchwarz:
        """Return S of the positive definite matrix with blocks (b, 3, 3)."""
        inverses = list[NDArray[np.float64]]()
        for n, places in self._levels:
            dense = (places @ blocks.reshape(-1, 9)).reshape(-1, SUBDOMAIN_SIZE, SUBDOMAIN_SIZE, 3, 3)
            dense = dense.transpose(0, 1, 3, 2, 4).reshape(-1, 3 * SUBDOMAIN_SIZE, 3 * SUBDOMAIN_SIZE)
            spare = np.arange(3 * n, len(dense) * 3 * SUBDOMAIN_SIZE)
            at = spare // (3 * SUBDOMAIN_SIZE), spare % (3 * SUBDOMAIN_SIZE), spare % (3 * SUBDOMAIN_SIZE)
            dense[at] = 1.0
            found = np.linalg.inv(dense)
            found[at] = 0.0
            inverses.append(0.5 * (found + found.transpose(0, 2, 1)))
        return AdditiveSchwarz(self.subdomain_order, inverses)


class AdditiveSchwarz:
    """Preconditioner S; subdomain_inverses: (subdomains, 3 SUBDOMAIN_SIZE, 3 SUBDOMAIN_SIZE) of each level.

    Rows and columns beyond a level's last node are zero.
    """

    def __init__(self, order: NDArray[np.int64], inverses: list[NDArray[np.float64]]) -> None:
        self._order, self.subdomain_inverses = order, inverses

    def apply_preconditioner(self, b: Positions) -> Positions:
        """Return S b, (f, 3)."""
        n, r = len(b), b[self._order]
        x, out = np.zeros_like(r), np.empty_like(r)
        for level, inverses in enumerate(self.subdomain_inverses):
            padded = np.zeros((len(inverses) * SUBDOMAIN_SIZE, 3))
            padded[: len(r)] = r
            moved = inverses @ padded.reshape(-1, 3 * SUBDOMAIN_SIZE, 1)
            x += np.repeat(moved.reshape(-1, 3), SUBDOMAIN_SIZE**level, axis=0)[:n]
            r = padded.reshape(-1, SUBDOMAIN_SIZE, 3).sum(axis=1)
        out[self._order] = x
        return out


def order_into_subdomains(Q: csr_array) -> NDArray[np.int64]:
    """Return the vertices (f,) in an order that forms subdomains on all levels.

    Each SUBDOMAIN_SIZE consecutive vertices are neighbours, and so are as many consecutive subdomains, and so on.
    """
    orders, graph = list[NDArray[np.int64]](), csr_array(Q)
    while (n := len(graph.indptr) - 1) > SUBDOMAIN_SIZE:
        order = np.empty(n, np.int64)
        pointers, neighbours = np.asarray(graph.indptr, np.int64), np.asarray(graph.indices, np.int64)
        # The size is an argument: compiled code is cached with the constants of its module, and tests change this one.
        grow_subdomains(SUBDOMAIN_SIZE, pointers, neighbours, order, *np.zeros((3, n), int))
        orders.append(order)
        of = np.empty(n, np.int64)
        of[order] = np.arange(n) // SUBDOMAIN_SIZE
        P = _build_aggregation_matrix(of)
        graph = csr_array(P.T @ abs(graph) @ P)
    whole = np.arange(len(graph.indptr) - 1)
    for order in reversed(orders):
        at = SUBDOMAIN_SIZE * whole[:, None] + np.arange(SUBDOMAIN_SIZE)
        whole = order[at[at < len(order)]]
    return whole


def _build_aggregation_matrix(of: NDArray[np.int64]) -> csr_array:
    """Return the matrix P (n, N) that prolongs values of aggregates `of` (n,) to nodes."""
    return csr_array((np.ones(len(of)), (np.arange(len(of)), of)))


@jit_kernel
def grow_subdomains(size, pointers, neighbours, order, state, queue, border):
    """Order a graph's nodes so that subdomains grow from the border of earlier ones.

    Args:
        size: number of nodes of a subdomain.
        pointers, neighbours: graph in CSR form.
        order: output (n,).
        state, queue, border: scratch (n,), zero initially. state is 0 for an unvisited node, 1 in the queue of the
            current subdomain, 2 at the border of an earlier one, 3 in the order.
    """
    n, done, first, left, right = len(order), 0, 0, 0, 0
    while done < n:
        head, tail, most = 0, 0, min(n, done + size)
        while done < most:
            if head == tail:
                seed = -1
                while left < right and seed < 0:
                    if state[border[left]] == 2:
                        seed = border[left]
                    left += 1
                while seed < 0:
                    if state[first] != 3:
                        seed = first
                    first += 1
                head, tail = 0, 1
                queue[0], state[seed] = seed, 1
            v = queue[head]
            head += 1
            state[v] = 3
            order[done] = v
            done += 1
            for e in range(pointers[v], pointers[v + 1]):
                w = neighbours[e]
                if state[w] == 0 or state[w] == 2:
                    state[w] = 1
                    queue[tail] = w
                    tail += 1
        for k in range(head, tail):
            v = queue[k]
            state[v] = 2
            if right < n:
                border[right] = v
                right += 1

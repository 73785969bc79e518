"""Projection of element Hessians to positive semidefinite matrices by their eigenvalues.

    clamped:  lambda -> max(lambda, 0)      Teran, Sifakis, Irving and Fedkiw 2005
    absolute: lambda -> |lambda|            Chen, Liu, Levin, Zheng and Jacobson 2024

A sum of positive semidefinite blocks is positive semidefinite. An element without a negative eigenvalue is returned
unchanged, bitwise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.core.bounds import PairBlocks

Array = NDArray[np.float64]

_ROUND_OFF = 16.0 * np.finfo(np.float64).eps
"""Ratio to a block's largest eigenvalue up to which a negative one counts as round-off."""

_PLACE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Position of xx, xy, xz, yy, yz, zz within a block."""


class Filtered(NamedTuple):
    """The parts of a Hessian with projected elements.

    Attributes:
        keep: fraction of the springs' negative transverse parts.
        tension: tensions of the springs (m,) [N].
        curvature: Hessians of the elements of each energy (m, 6) [N/m].
        pairs: blocks of each barrier energy.
        looked: number of elements examined.
        changed: number of elements with a negative eigenvalue.
    """

    keep: float
    tension: Array
    curvature: list[Array]
    pairs: list[PairBlocks]
    looked: int
    changed: int


class Filtering:
    """A projection and the counts of its elements.

    Attributes:
        absolute: whether eigenvalues are replaced by absolute values instead of clamped.
        among: mask of the vertices (n,) whose elements are projected; None for all.
    """

    def __init__(self, *, absolute: bool = False, among: NDArray[np.bool_] | None = None) -> None:
        self.absolute, self._among = absolute, among
        self.looked = self.changed = 0

    def meets(self, vertices: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return the mask of the elements (m, k) with a selected vertex; -1 is no vertex."""
        if self._among is None:
            met = np.ones(len(vertices), np.bool_)
        else:
            met = np.logical_or.reduce(self._among[vertices] & (vertices >= 0), axis=1)
        self.looked += int(met.sum())
        return met

    def springs(self, edges: NDArray[np.int64], tension: Array) -> tuple[float, Array]:
        """Return the negative fraction and the tensions (m,) [N] of projected springs (m, 2).

        The transverse eigenvalue of a spring is t/l.
        """
        bent = self.meets(edges) & (tension < 0.0)
        self.changed += int(bent.sum())
        return (-1.0, tension) if self.absolute else (1.0, np.where(bent, 0.0, tension))

    def packed(self, vertices: NDArray[np.int64], curvature: Array) -> Array:
        """Project packed Hessians (m, 6) [N/m] of elements with vertices (m, k)."""
        blocks = self.blocks(vertices, curvature[:, _PLACE])
        return curvature if blocks is None else np.ascontiguousarray(blocks.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])

    def pairs(self, pairs: PairBlocks) -> PairBlocks:
        """Project the blocks of pairs."""
        blocks = self.blocks(pairs.vertices, pairs.values) if len(pairs.vertices) else None
        return pairs if blocks is None else pairs.of(blocks)

    def blocks(self, vertices: NDArray[np.int64], blocks: Array) -> Array | None:
        """Project symmetric blocks (m, k, k) of elements; return None if no eigenvalue is negative."""
        met = np.flatnonzero(self.meets(vertices))
        size, axes = np.linalg.eigh(blocks[met])
        bent = size[:, 0] < -_ROUND_OFF * np.abs(size).max(axis=1, initial=0.0)
        self.changed += int(bent.sum())
        if not bent.any():
            return None
        size = np.abs(size[bent]) if self.absolute else np.maximum(size[bent], 0.0)
        out = blocks.copy()
        out[met[bent]] = np.einsum("mij,mj,mkj->mik", axes[bent], size, axes[bent])
        return out

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
from springbench.solvers.model.barrier_energy import PairBlocks

FloatArray = NDArray[np.float64]

_EIGENVALUE_ROUNDOFF = 16.0 * np.finfo(np.float64).eps
"""Ratio to a block's largest eigenvalue up to which a negative one counts as round-off."""

_PACKED_INDEX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Position of xx, xy, xz, yy, yz, zz within a block."""


class ProjectedHessian(NamedTuple):
    """The parts of a Hessian with projected elements.

    Attributes:
        negative_fraction: fraction of the springs' negative transverse parts.
        spring_tensions: tensions of the springs (m,) [N].
        element_hessians: Hessians of the elements of each energy (m, 6) [N/m].
        pair_blocks: blocks of each barrier energy.
        num_examined: number of elements examined.
        num_projected: number of elements with a negative eigenvalue.
    """

    negative_fraction: float
    spring_tensions: FloatArray
    element_hessians: list[FloatArray]
    pair_blocks: list[PairBlocks]
    num_examined: int
    num_projected: int


class PsdProjection:
    """A projection and the counts of its elements.

    Attributes:
        use_absolute: whether eigenvalues are replaced by absolute values instead of clamped.
        num_examined, num_projected: numbers of elements examined and of elements projected so far.
    """

    def __init__(self, *, use_absolute: bool = False, vertex_mask: NDArray[np.bool_] | None = None) -> None:
        """Create a projection.

        Args:
            use_absolute: whether eigenvalues are replaced by absolute values instead of clamped.
            vertex_mask: mask of the vertices (n,) whose elements are projected; None for all.

        Raises:
            ValueError: absolute values of a part of the elements.
        """
        if use_absolute and vertex_mask is not None:
            raise ValueError(
                "use_absolute=True with a vertex_mask: springs have one factor of all negative transverse parts; "
                "omit the mask, or clamp"
            )
        self.use_absolute, self._vertex_mask = use_absolute, vertex_mask
        self.num_examined = self.num_projected = 0

    def mark_examined(self, vertices: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return the mask of the elements (m, k) with a selected vertex, and add them to `num_examined`.

        The vertex -1 is none.
        """
        if self._vertex_mask is None:
            met = np.ones(len(vertices), np.bool_)
        else:
            met = np.logical_or.reduce(self._vertex_mask[vertices] & (vertices >= 0), axis=1)
        self.num_examined += int(met.sum())
        return met

    def project_springs(self, edges: NDArray[np.int64], tension: FloatArray) -> tuple[float, FloatArray]:
        """Return how springs are assembled so that their blocks are positive semidefinite.

        The transverse eigenvalue of a spring is t/l.

        Args:
            edges: vertices of the springs (m, 2).
            tension: tensions t (m,) [N], negative if compressed.

        Returns:
            Fraction of the negative transverse parts, -1 for absolute values and 1 otherwise, and tensions (m,) [N],
            which are zero for clamped springs.
        """
        bent = self.mark_examined(edges) & (tension < 0.0)
        self.num_projected += int(bent.sum())
        return (-1.0, tension) if self.use_absolute else (1.0, np.where(bent, 0.0, tension))

    def project_packed(self, vertices: NDArray[np.int64], packed_hessians: FloatArray) -> FloatArray:
        """Project packed Hessians of elements.

        Args:
            vertices: vertices of the elements (m, k), -1 for none.
            packed_hessians: second derivatives xx, xy, xz, yy, yz, zz of each element (m, 6) [N/m].

        Returns:
            Second derivatives (m, 6) [N/m]; the given array if no eigenvalue is negative.
        """
        blocks = self.project_blocks(vertices, packed_hessians[:, _PACKED_INDEX])
        return packed_hessians if blocks is None else np.ascontiguousarray(blocks.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])

    def project_pairs(self, pairs: PairBlocks) -> PairBlocks:
        """Project the blocks of pairs."""
        blocks = self.project_blocks(pairs.vertices, pairs.values) if len(pairs.vertices) else None
        return pairs if blocks is None else pairs.with_values(blocks)

    def project_blocks(self, vertices: NDArray[np.int64], blocks: FloatArray) -> FloatArray | None:
        """Project symmetric blocks of elements; return None if no eigenvalue is negative.

        Args:
            vertices: vertices of the elements (m, v), -1 for none.
            blocks: blocks (m, k, k) [N/m], not modified.

        Returns:
            Blocks (m, k, k) [N/m], of which only those with a negative eigenvalue differ.
        """
        met = np.flatnonzero(self.mark_examined(vertices))
        size, axes = np.linalg.eigh(blocks[met])
        bent = size[:, 0] < -_EIGENVALUE_ROUNDOFF * np.abs(size).max(axis=1, initial=0.0)
        self.num_projected += int(bent.sum())
        if not bent.any():
            return None
        size = np.abs(size[bent]) if self.use_absolute else np.maximum(size[bent], 0.0)
        out = blocks.copy()
        out[met[bent]] = np.einsum("mij,mj,mkj->mik", axes[bent], size, axes[bent])
        return out

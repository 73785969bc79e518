"""Packed Hessian blocks of collisions of two to four vertices.

The blocks are symmetric. Each row is stored up to the end of its own vertex's diagonal block: row a of vertex i has
3 (i + 1) numbers, and follows the rows above it.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.model.step_problem import Positions

FloatArray = NDArray[np.float64]

BLOCK_ENTRIES = 90
"""Number of stored entries of a collision of four vertices."""


class ReusableBuffer:
    """Array memory that is reused once the last array is no longer referenced.

    The operating system clears each page of new memory, which takes as long as computing the entries.
    """

    def __init__(self) -> None:
        self._memory = np.empty(0)
        self._last_array: Callable[[], FloatArray | None] = lambda: None

    def acquire_array(self, num_entries: int) -> FloatArray:
        """Return an array (num_entries,). References to views of it do not prevent its reuse."""
        if len(self._memory) < num_entries or self._last_array() is not None:
            self._memory = np.empty(num_entries)
        out = self._memory[:num_entries]
        self._last_array = weakref.ref(out)
        return out


class PackedBlocks(NamedTuple):
    """Packed symmetric blocks.

    Attributes:
        vertices: (a, 4); -1 for none and for those of obstacles.
        block_starts: first entry of each block, and the end of the last one, (a + 1,).
        packed: rows [N/m] of consecutive blocks, up to the last vertex of each collision.
    """

    vertices: NDArray[np.int64]
    block_starts: NDArray[np.int64]
    packed: FloatArray

    @classmethod
    def from_dense(cls, vertices: NDArray[np.int64], values: FloatArray) -> PackedBlocks:
        """Build packed blocks from symmetric dense ones.

        Args:
            vertices: vertices of each block (a, 4); -1 for none.
            values: blocks (a, 12, 12) [N/m]; each row is read up to the end of its diagonal block.
        """
        row, column = np.nonzero(np.arange(12) // 3 <= np.arange(12)[:, None] // 3)
        return cls(vertices, BLOCK_ENTRIES * np.arange(len(vertices) + 1), np.ravel(values[:, row, column]))

    @property
    def values(self) -> FloatArray:
        """Dense blocks (a, 12, 12), with zeros for missing vertices."""
        out = np.zeros((len(self.vertices), 12, 12))
        expand_blocks(self.block_starts, self.packed, out)
        return out

    def with_values(self, values: FloatArray) -> PackedBlocks:
        """Return blocks of the same vertices with other values (a, 12, 12)."""
        return PackedBlocks.from_dense(self.vertices, values)

    def append_blocks(self, other: PackedBlocks) -> PackedBlocks:
        """Return these blocks followed by others."""
        end = self.block_starts[-1]
        starts, packed = (
            np.append(self.block_starts, end + other.block_starts[1:]),
            np.append(self.packed[:end], other.packed),
        )
        return PackedBlocks(np.concatenate([self.vertices, other.vertices]), starts, packed)

    def assemble_matrix(self, n: int) -> csr_array:
        """Return the sum of all blocks as a sparse matrix (3n, 3n) [N/m]."""
        values = self.values.ravel()
        at = (3 * self.vertices[:, :, None] + np.arange(3)).reshape(-1, 12)
        rows, columns = np.repeat(at, 12, axis=1).ravel(), np.tile(at, 12).ravel()
        own = (rows >= 0) & (columns >= 0)
        return csr_array(coo_array((values[own], (rows[own], columns[own])), shape=(3 * n, 3 * n)))

    def add_product(self, x: Positions, out: Positions) -> None:
        """Add the product with vectors.

        Args:
            x: vectors (n, 3).
            out: product (n, 3), updated.
        """
        multiply_blocks(*self, x, out)

    def add_blocks(self, block_indices: NDArray[np.int64], values: FloatArray) -> None:
        """Add the blocks to existing 3x3 blocks.

        Args:
            block_indices: target block of each vertex pair, (a, 16); -1 for none.
            values: blocks (b, 3, 3) [N/m], updated.
        """
        scatter_blocks(self.block_starts, self.packed, block_indices, values)


@jit_inner
def row_offset(i, a):
    """Return the offset of a row in a packed block.

    Args:
        i: vertex of the row in the block, 0 to 3.
        a: coordinate of the row, 0 to 2.
    """
    return 9 * i * (i + 1) // 2 + 3 * a * (i + 1)


@jit_inner
def count_block_vertices(numbers):
    """Return the number of vertices of a block with this number of entries."""
    return 4 if numbers == BLOCK_ENTRIES else 3 if numbers == 54 else 2


@jit_kernel
def scatter_blocks(starts, packed, block_indices, values):
    """Add packed blocks to existing 3x3 blocks.

    Args:
        starts: first entry of each block, and the end of the last one, (a + 1,).
        packed: entries of the blocks [N/m].
        block_indices: target block of each vertex pair, (a, 16); -1 for none.
        values: blocks (b, 3, 3) [N/m], updated.
    """
    for k in range(len(block_indices)):
        add_block_at(packed[starts[k] : starts[k + 1]], block_indices[k], values)


@jit_inner
def add_block_at(H, block_indices, values):
    """Add one packed block to existing 3x3 blocks.

    Args:
        H: packed block [N/m] of two, three or four vertices: 27, 54 or 90 entries.
        block_indices: target block of each vertex pair (i, j) at 4 i + j, (16,); -1 for none.
        values: blocks (b, 3, 3) [N/m], updated.
    """
    for i in range(count_block_vertices(len(H))):
        for j in range(i + 1):
            at, across = block_indices[4 * i + j], block_indices[4 * j + i]
            if at < 0:
                continue
            for a in range(3):
                begin = row_offset(i, a) + 3 * j
                for b in range(3):
                    values[at, a, b] += H[begin + b]
            if i == j:
                continue
            for a in range(3):
                begin = row_offset(i, a) + 3 * j
                for b in range(3):
                    values[across, b, a] += H[begin + b]


@jit_kernel
def expand_blocks(starts, packed, out):
    """Expand packed blocks to the leading parts of dense ones.

    Args:
        starts: first entry of each block, and the end of the last one, (a + 1,).
        packed: entries of the blocks [N/m].
        out: dense blocks (a, 12, 12) [N/m]; entries of missing vertices are not written.
    """
    for k in range(len(out)):
        H = packed[starts[k] : starts[k + 1]]
        for i in range(count_block_vertices(len(H))):
            for a in range(3):
                for j in range(3 * i + 3):
                    out[k, 3 * i + a, j] = H[row_offset(i, a) + j]
                    out[k, j, 3 * i + a] = H[row_offset(i, a) + j]


@jit_kernel
def multiply_blocks(vertices, starts, packed, x, out):
    """Add the product of packed blocks with x to `out`.

    Args:
        vertices: vertices of each block (a, 4); -1 where they do not move.
        starts: first entry of each block (a + 1,).
        packed: entries of the blocks.
        x: vectors (n, 3).
        out: product (n, 3), updated.
    """
    for k in range(len(vertices)):
        H = packed[starts[k] : starts[k + 1]]
        for i in range(count_block_vertices(len(H))):
            for j in range(i + 1):
                v, w = vertices[k, i], vertices[k, j]
                if v < 0 or w < 0:
                    continue
                for a in range(3):
                    for b in range(3):
                        h = H[row_offset(i, a) + 3 * j + b]
                        out[v, a] += h * x[w, b]
                        if i != j:
                            out[w, b] += h * x[v, a]

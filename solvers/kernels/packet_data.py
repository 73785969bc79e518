"""Numbers of the entries of packets of eight, in memory for vector loads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.simd.spring_packets import LANES


def copy_aligned(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a flat aligned copy of numbers."""
    out = allocate_aligned(values.size)
    out[:] = values.ravel()
    return out


def deduplicate_packets(*numbers: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the offsets of each entry's numbers, eight per array, and the numbers without duplicates."""
    rows = np.concatenate([array.reshape(-1, LANES) for array in numbers], axis=1)
    mixing = np.random.default_rng(0).integers(2**63, size=rows.shape[1], dtype=np.uint64)
    _, first, kind = np.unique(rows.view(np.uint64) @ mixing, return_index=True, return_inverse=True)
    if not np.array_equal(rows[first[kind]], rows):  # different entries have equal hashes: all are stored
        first = kind = np.arange(len(rows))
    return (rows.shape[1] * kind).astype(np.int32), copy_aligned(rows[first])

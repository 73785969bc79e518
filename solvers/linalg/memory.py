"""Cache-aligned arrays, and the memory limit by which too large problems are rejected in advance."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.platform_calls import measure_memory


def allocate_aligned(size: int, dtype: Any = np.float64) -> NDArray[Any]:
    """Return zeros that start at a cache line.

    No vector of the size of a line or less crosses two lines.

    Args:
        size: number of entries of the one-dimensional array.
        dtype: type of an entry.
    """
    bytes_ = np.dtype(dtype).itemsize * size
    raw = np.zeros(bytes_ + 64, np.uint8)
    begin = -raw.__array_interface__["data"][0] % 64  # `raw.ctypes` takes twice the time
    return raw[begin : begin + bytes_].view(dtype)


def compute_memory_limit() -> float:
    """Return three quarters of the machine's memory [bytes].

    The remainder is for other data of a run.
    """
    return 0.75 * measure_memory()


def format_bytes(count: float) -> str:
    """Return a number of bytes as text with a binary unit."""
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if count < 1024 or unit == "GiB":
            break
        count /= 1024
    return f"{count:,.0f} {unit}" if count >= 1000 else f"{count:.3g} {unit}"

"""Memory: arrays that begin at a cache line, and what fits, so that what does not is refused before it is begun."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray


def aligned(size: int, dtype: Any = np.float64) -> NDArray[Any]:
    """Zeros that begin at a cache line, so that no vector of its size or less lies in two."""
    bytes_ = np.dtype(dtype).itemsize * size
    raw = np.zeros(bytes_ + 64, np.uint8)
    begin = -raw.ctypes.data % 64
    return raw[begin : begin + bytes_].view(dtype)


def of_machine() -> float:
    """Three quarters of the machine's memory [bytes]: the rest is for what else a run has."""
    return 0.75 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def in_words(count: float) -> str:
    """Bytes in words."""
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if count < 1024 or unit == "GiB":
            break
        count /= 1024
    return f"{count:,.0f} {unit}" if count >= 1000 else f"{count:.3g} {unit}"

"""Numba's CUDA target, or its simulator, and streams there; Numba states no types for what kernels ask of it."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solvers.cuda.device import simulated

cuda: Any = import_module("numba.cuda")

THREADS = 8 if simulated() else 128
"""In a block; the simulator's take a thread of the processor each."""


def blocks(threads: int) -> int:
    """How many blocks so many threads take; one at least."""
    return max(1, -(-threads // THREADS))


class Stream:
    """A stream with the arrays that are brought to it, and a clock on it. Device arrays live as long as this does."""

    def __init__(self) -> None:
        self.queue: Any = cuda.stream()

    def upload(self, array: NDArray[Any], dtype: Any = None) -> Any:
        """A copy of a host's array on the device."""
        return cuda.to_device(np.ascontiguousarray(array, dtype), stream=self.queue)

    def put(self, array: NDArray[Any], there: Any) -> None:
        """Copy a host's array to one of the device of the same shape and type."""
        there.copy_to_device(np.ascontiguousarray(array, there.dtype), stream=self.queue)

    def copy(self, array: Any, there: Any) -> None:
        """Copy an array of the device to another of the same shape and type."""
        there.copy_to_device(array, stream=self.queue)

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Memory of the device, with whatever is there."""
        return cuda.device_array(shape, dtype, stream=self.queue)

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Zeros on the device."""
        return self.upload(np.zeros(shape, dtype))

    def download(self, there: Any) -> NDArray[Any]:
        """A copy of a device's array; waits for all that was launched."""
        out = there.copy_to_host(stream=self.queue)
        self.wait()
        return out

    def wait(self) -> None:
        """Until all that was launched is done."""
        self.queue.synchronize()

    def mark(self) -> Any:
        """An event here and now on the stream."""
        event = cuda.event()
        event.record(self.queue)
        return event

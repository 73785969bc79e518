"""Numba's CUDA target or its simulator, and streams; Numba has no types for device arrays and kernels."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solvers.cuda.device import simulated

cuda: Any = import_module("numba.cuda")

THREADS = 8 if simulated() else 128
"""Threads per block; the simulator starts a CPU thread for each."""


def blocks(threads: int) -> int:
    """Return the number of blocks for a number of threads, at least one."""
    return max(1, -(-threads // THREADS))


class Stream:
    """A stream with its uploaded arrays and its events; device arrays live as long as the stream."""

    def __init__(self) -> None:
        self.queue: Any = cuda.stream()

    def upload(self, array: NDArray[Any], dtype: Any = None) -> Any:
        """Copy a host array to the device."""
        return cuda.to_device(np.ascontiguousarray(array, dtype), stream=self.queue)

    def put(self, array: NDArray[Any], there: Any) -> None:
        """Copy a host array to an existing device array of the same shape and type."""
        there.copy_to_device(np.ascontiguousarray(array, there.dtype), stream=self.queue)

    def copy(self, array: Any, there: Any) -> None:
        """Copy a device array to another one of the same shape and type."""
        there.copy_to_device(array, stream=self.queue)

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Allocate an uninitialised device array."""
        return cuda.device_array(shape, dtype, stream=self.queue)

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Allocate a device array of zeros."""
        return self.upload(np.zeros(shape, dtype))

    def download(self, there: Any) -> NDArray[Any]:
        """Copy a device array to the host; waits for all launched kernels."""
        out = there.copy_to_host(stream=self.queue)
        self.wait()
        return out

    def wait(self) -> None:
        """Wait for all launched work."""
        self.queue.synchronize()

    def mark(self) -> Any:
        """Record an event on the stream."""
        event = cuda.event()
        event.record(self.queue)
        return event

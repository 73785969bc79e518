"""Numba's CUDA target or its simulator, and streams; Numba has no types for device arrays and kernels."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.cuda.cuda_device import is_simulated

cuda: Any = import_module("numba.cuda")

THREADS = 8 if is_simulated() else 128
"""Threads per block; the simulator starts a CPU thread for each."""


def blocks(threads: int) -> int:
    """Return the number of blocks for a number of threads, at least one."""
    return max(1, -(-threads // THREADS))


class DeviceStream:
    """A stream with its uploaded arrays and its events; device arrays live as long as the stream."""

    def __init__(self) -> None:
        self.cuda_stream: Any = cuda.stream()

    def upload_array(self, array: NDArray[Any], dtype: Any = None) -> Any:
        """Copy a host array to the device."""
        return cuda.to_device(np.ascontiguousarray(array, dtype), stream=self.cuda_stream)

    def overwrite_array(self, array: NDArray[Any], device_array: Any) -> None:
        """Copy a host array to an existing device array of the same shape and type."""
        device_array.copy_to_device(np.ascontiguousarray(array, device_array.dtype), stream=self.cuda_stream)

    def copy_array(self, array: Any, device_array: Any) -> None:
        """Copy a device array to another one of the same shape and type."""
        device_array.copy_to_device(array, stream=self.cuda_stream)

    def allocate_array(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Allocate an uninitialised device array."""
        return cuda.device_array(shape, dtype, stream=self.cuda_stream)

    def allocate_zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Allocate a device array of zeros."""
        return self.upload_array(np.zeros(shape, dtype))

    def download_array(self, device_array: Any) -> NDArray[Any]:
        """Copy a device array to the host; waits for all launched kernels."""
        out = device_array.copy_to_host(stream=self.cuda_stream)
        self.synchronise_stream()
        return out

    def synchronise_stream(self) -> None:
        """Wait for all launched work."""
        self.cuda_stream.synchronize()

    def record_event(self) -> Any:
        """Record an event on the stream."""
        event = cuda.event()
        event.record(self.cuda_stream)
        return event

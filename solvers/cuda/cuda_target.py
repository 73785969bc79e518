"""Numba's CUDA target or its simulator, streams, and graphs of kernels.

Device arrays and kernels have the type `Any`, because Numba has no stubs for them. Grid sizes are Python integers:
Numba accepts no NumPy integers.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.cuda.cuda_device import DeviceFailure, is_simulated

cuda: Any = import_module("numba.cuda")

for _settings in ("numba.core.config", "numba.cuda.core.config"):  # of Numba, and of the package numba-cuda
    with suppress(ImportError):  # small meshes have few blocks, and a warning for each launch helps no user
        import_module(_settings).__dict__["CUDA_LOW_OCCUPANCY_WARNINGS"] = 0


class DeviceStream:
    """A stream with copies to and from the device, and its events."""

    def __init__(self) -> None:
        self.cuda_stream: Any = cuda.stream()

    def upload_array(self, array: NDArray[Any], dtype: Any = None) -> Any:
        """Copy a host array to a new device array.

        Args:
            array: array on the host, of any shape.
            dtype: type of the device array; that of the host array if omitted.
        """
        return cuda.to_device(np.ascontiguousarray(array, dtype), stream=self.cuda_stream)

    def overwrite_array(self, array: NDArray[Any], device_array: Any) -> None:
        """Copy a host array to an existing device array.

        Args:
            array: array on the host, whose values are converted to the type of the device array.
            device_array: destination of the same shape.
        """
        device_array.copy_to_device(np.ascontiguousarray(array, device_array.dtype), stream=self.cuda_stream)

    def copy_array(self, array: Any, device_array: Any) -> None:
        """Copy a device array to another one of the same shape and type.

        Args:
            array: source on the device.
            device_array: destination.
        """
        device_array.copy_to_device(array, stream=self.cuda_stream)

    def allocate_array(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Allocate an uninitialised device array.

        Args:
            shape: number of entries along each axis.
            dtype: NumPy type of the entries.
        """
        return cuda.device_array(shape, dtype, stream=self.cuda_stream)

    def allocate_zeros(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Allocate a device array of zeros.

        Args:
            shape: number of entries along each axis.
            dtype: NumPy type of the entries.
        """
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


class ReusedUploads:
    """Device arrays that are allocated once, and overwritten by the uploads of each following step.

    Uploads come in the same order in each step; one of another shape or type is allocated again.
    """

    def __init__(self, stream: DeviceStream) -> None:
        self._stream, self._arrays, self._next = stream, list[Any](), 0

    def start_step(self) -> None:
        """Start the uploads of the next step."""
        self._next = 0

    def upload_array(self, array: NDArray[Any], dtype: Any = None) -> Any:
        """Copy a host array to the device, over the one of the last step.

        Args:
            array: array on the host, of any shape.
            dtype: type of the device array; that of the host array if omitted.

        Returns:
            The device array, which the next step overwrites.
        """
        array, position = np.ascontiguousarray(array, dtype), self._next
        self._next += 1
        known = self._arrays[position] if position < len(self._arrays) else None
        if known is None or known.shape != array.shape or known.dtype != array.dtype:
            known = self._stream.upload_array(array)
            self._arrays[position : position + 1] = [known]
        else:
            self._stream.overwrite_array(array, known)
        return known


class LaunchGraph:
    """Kernels that are launched again and again with the same arguments, as one CUDA graph.

    Numba takes 20 to 80 microseconds to launch a kernel, which is longer than most of these kernels run. The first
    launch is one by one, since it may compile and load kernels; the second records them, and all following ones take
    one call of the driver. The simulator has no graphs.
    """

    def __init__(self, stream: DeviceStream) -> None:
        self._stream, self._executable, self._has_launched = stream, None, False

    def launch_together(self, launch_kernels: Callable[[], None]) -> None:
        """Launch the kernels.

        Args:
            launch_kernels: launches them on the stream, one by one, with arguments that are the same in each call; it
                may neither copy to the host nor wait.
        """
        if is_simulated() or not self._has_launched:
            self._has_launched = True
            launch_kernels()
            return
        driver: Any = import_module("cuda.bindings.driver")
        if self._executable is None:
            self._executable = self._record(driver, launch_kernels)
            weakref.finalize(self, driver.cuGraphExecDestroy, self._executable).atexit = False
        _require_success(driver.cuGraphLaunch(self._executable, int(self._stream.cuda_stream)))

    def _record(self, driver: Any, launch_kernels: Callable[[], None]) -> Any:
        """Record the kernels; return the executable graph."""
        stream = int(self._stream.cuda_stream)
        mode = driver.CUstreamCaptureMode.CU_STREAM_CAPTURE_MODE_RELAXED  # Numba may free other arrays then
        _require_success(driver.cuStreamBeginCapture(stream, mode))
        try:
            launch_kernels()
        finally:
            status, graph = driver.cuStreamEndCapture(stream)
        _require_success((status,))
        found = driver.cuGraphInstantiate(graph, 0)
        driver.cuGraphDestroy(graph)
        _require_success(found)
        return found[1]


def _require_success(result: tuple[Any, ...]) -> None:
    """Raise DeviceFailure for a status of the driver other than success."""
    if int(result[0]):
        raise DeviceFailure(f"the device failed: {result[0].name}")

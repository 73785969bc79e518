"""Options and interfaces for methods that run on the processor or on a device.

A method that supports both inherits `DeviceOptions` or `PrecisionOptions`. For a device, its `prepare` delegates to the
module `device_*` of the method, which is imported only then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from springbench.solvers.model.step_problem import Positions, Solution, StepProblem

DeviceName = Literal["cpu", "cuda"]
SIMULATOR_NAME = "Numba's simulator, no device"
"""Name of Numba's simulator in rows."""


@dataclass(frozen=True, kw_only=True)
class DeviceOptions:
    """The option that selects the processor or a device.

    Attributes:
        device: processor or device.
        omitted_defaults: parameters that rows and hashes omit at their default, so that they equal those from before
            the parameter existed.
    """

    omitted_defaults: ClassVar[frozenset[str]] = frozenset({"device", "precision"})

    device: DeviceName = "cpu"


@dataclass(frozen=True, kw_only=True)
class PrecisionOptions(DeviceOptions):
    """The precision of device kernels, float32 by default.

    Residuals are in float64, and so are all computations of the processor.
    """

    precision: Literal["float32", "float64"] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for float32 on the processor."""
        if self.precision == "float32" and self.device == "cpu":
            raise ValueError("precision: float32 is for `device: cuda`; the processor computes in float64 here")

    @property
    def real_dtype(self) -> type[np.float32] | type[np.float64]:
        """Floating-point type of device kernels."""
        return np.float64 if self.precision == "float64" else np.float32


class StreamEvent(Protocol):
    """A point on a device's stream."""

    def elapsed_time(self, event: Any) -> float:
        """Return the milliseconds from this event to a later one on the stream."""
        ...


class SolveEvents(NamedTuple):
    """The events of a solve: start, data uploaded (up), kernels finished (done), result downloaded (down)."""

    start_event: StreamEvent
    upload_event: StreamEvent
    kernel_event: StreamEvent
    download_event: StreamEvent


@runtime_checkable
class PreparedDeviceSolver(Protocol):
    """A prepared solver on a device.

    Its iterates are copied on request only; timings are taken of the same iterates without copies.
    """

    @property
    def device_columns(self) -> Mapping[str, Any]:
        """Columns of rows that describe the device."""
        ...

    def device_state(self) -> dict[str, float | None]:
        """Return columns of the device's current clocks, power and temperature; None for unavailable ones."""
        ...

    def replay_iterations(self, problem: StepProblem, iterations: int) -> tuple[Solution, SolveEvents | None]:
        """Repeat a solve by its number of iterations, without residuals.

        Args:
            problem: the step on the host.
            iterations: number of iterations.

        Returns:
            The solution, and its events; None for a device without a clock.
        """
        ...

    def iterates_without_copy(self, problem: StepProblem) -> Iterator[Callable[[], Positions]]:
        """Yield the iterates of `iterates` as callables, each of which copies one to the host."""
        ...


_DEVICE_FAILURES: list[str] = []


def record_device_loss(reason: str) -> None:
    """Record that this process has lost its device permanently.

    Args:
        reason: error of the driver.
    """
    _DEVICE_FAILURES.append(reason)


def is_device_lost() -> bool:
    """Return whether this process has lost its device permanently."""
    return bool(_DEVICE_FAILURES)

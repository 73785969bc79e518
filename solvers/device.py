"""Options and interfaces for methods that run on the processor or on a device.

A method that supports both inherits `OnDevice` or `Precise`, and delegates its `prepare` to its file in
`solvers.cuda`, which is imported only if a device is requested.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from solvers.problem import Positions, Solution, StepProblem

Device = Literal["cpu", "cuda"]
SIMULATED = "Numba's simulator, no device"
"""Name of Numba's simulator in rows."""


@dataclass(frozen=True, kw_only=True)
class OnDevice:
    """The option where to compute.

    Attributes:
        device: processor or device.
        unstated: parameters that rows and hashes omit at their default, so that they equal those from before
            the parameter existed.
    """

    unstated: ClassVar[frozenset[str]] = frozenset({"device", "precision"})

    device: Device = "cpu"


@dataclass(frozen=True, kw_only=True)
class Precise(OnDevice):
    """The precision of device kernels, float32 by default, with residuals in float64; the processor uses float64."""

    precision: Literal["float32", "float64"] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for float32 on the processor."""
        if self.precision == "float32" and self.device == "cpu":
            raise ValueError("precision: float32 is for `device: cuda`; the processor computes in float64 here")

    @property
    def real(self) -> type[np.float32] | type[np.float64]:
        """Floating-point type of device kernels."""
        return np.float64 if self.precision == "float64" else np.float32


class Event(Protocol):
    """A point on a device's stream."""

    def elapsed_time(self, event: Any) -> float:
        """Return the milliseconds from this event to a later one on the stream."""
        ...


class Marks(NamedTuple):
    """The events of a solve: start, data uploaded (up), kernels finished (done), result downloaded (down)."""

    began: Event
    up: Event
    done: Event
    down: Event


@runtime_checkable
class Remote(Protocol):
    """A prepared solver on a device.

    Its iterates are copied on request only; timings are taken of the same iterates without copies.
    """

    @property
    def columns(self) -> Mapping[str, Any]:
        """Columns of rows that describe the device."""
        ...

    def state(self) -> dict[str, float | None]:
        """Return columns of the device's current clocks, power and temperature; None for unavailable ones."""
        ...

    def replay(self, problem: StepProblem, iterations: int) -> tuple[Solution, Marks | None]:
        """Return the solution of a host problem after n iterations, without residual, and its events.

        The events are None for a device without a clock.
        """
        ...

    def uncopied(self, problem: StepProblem) -> Iterator[Callable[[], Positions]]:
        """Yield the iterates of `iterates` when computed, as callables that copy them."""
        ...


def told(prepared: object) -> dict[str, Any]:
    """Return the columns that describe a prepared solver's device; empty for one on the processor."""
    usual = getattr(prepared, "usual", prepared)  # of two systems
    return dict(usual.columns) if isinstance(usual, Remote) else {}


_BROKEN: list[str] = []


def broken(reason: str = "") -> bool:
    """Return whether this process has lost its device permanently; a reason records such a loss."""
    if reason:
        _BROKEN.append(reason)
    return bool(_BROKEN)

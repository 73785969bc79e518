"""Where a method computes: on the processor, or on a device.

A method that can do both inherits `OnDevice`, or `Precise`, and hands its `prepare` over to its file of `solvers.cuda`,
which nobody imports who does not ask for a device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from solvers.problem import Positions, Solution, StepProblem

Device = Literal["cpu", "cuda"]
SIMULATED = "Numba's simulator, no device"
"""What rows call Numba's simulator."""


@dataclass(frozen=True, kw_only=True)
class OnDevice:
    """device: where it computes.

    unstated: parameters that rows and hashes leave out where they have their default, which is what was before there
    was another.
    """

    unstated: ClassVar[frozenset[str]] = frozenset({"device", "precision"})

    device: Device = "cpu"


@dataclass(frozen=True, kw_only=True)
class Precise(OnDevice):
    """precision: of kernels on a device, float32 if left out, with residuals in float64; the processor has float64."""

    precision: Literal["float32", "float64"] | None = None

    def __post_init__(self) -> None:
        """Raises ValueError."""
        if self.precision == "float32" and self.device == "cpu":
            raise ValueError("precision: float32 is for `device: cuda`; the processor computes in float64 here")

    @property
    def real(self) -> type[np.float32] | type[np.float64]:
        """What kernels on a device compute in."""
        return np.float64 if self.precision == "float64" else np.float32


class Event(Protocol):
    """A point on a device's stream."""

    def elapsed_time(self, event: Any) -> float:
        """Milliseconds from here to an event that is later on the stream."""
        ...


class Marks(NamedTuple):
    """What a solve put on the stream: it began, its data are there (up), kernels are done, its end is copied (down)."""

    began: Event
    up: Event
    done: Event
    down: Event


@runtime_checkable
class Remote(Protocol):
    """A prepared solver that computes on a device. Its iterates are copied where somebody asks for them; its times are
    taken of the same iterates where nobody does."""

    @property
    def columns(self) -> Mapping[str, Any]:
        """What rows tell of the device."""
        ...

    def state(self) -> dict[str, float | None]:
        """Columns of the device's clocks, power and temperature now; None for what it does not tell."""
        ...

    def replay(self, problem: StepProblem, iterations: int) -> tuple[Solution, Marks | None]:
        """The solution of a host's problem after so many iterations, without a residual; None for marks of a device
        that has no clock."""
        ...

    def uncopied(self, problem: StepProblem) -> Iterator[Callable[[], Positions]]:
        """The iterates of `iterates`, each done when it is yielded, and copied where it is called."""
        ...


def told(prepared: object) -> dict[str, Any]:
    """The columns of rows that tell of a prepared solver's device; none of one that computes on the processor."""
    usual = getattr(prepared, "usual", prepared)  # of two systems
    return dict(usual.columns) if isinstance(usual, Remote) else {}


_BROKEN: list[str] = []


def broken(reason: str = "") -> bool:
    """Whether this process lost its device, and cannot have it back; with a reason it has."""
    if reason:
        _BROKEN.append(reason)
    return bool(_BROKEN)

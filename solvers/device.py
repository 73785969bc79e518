"""Where a method computes: on the processor, or on a device.

A method that can do both inherits `OnDevice`, or `Precise`, and hands its `prepare` over to its file of `solvers.cuda`,
which nobody imports who does not ask for a device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from solvers.problem import Positions, Solution, StepProblem, StopRule, System

Device = Literal["cpu", "cuda"]
SIMULATED = "Numba's simulator, no device"
"""What rows call Numba's simulator."""


_MORE = 100.0
"""So many times the work that the processor may have in a step."""


@dataclass(frozen=True, kw_only=True)
class OnDevice:
    """device: where it computes.

    unstated: parameters that rows and hashes leave out where they have their default, which is what was before there
    was another.
    """

    unstated: ClassVar[frozenset[str]] = frozenset({"device", "precision"})

    device: Device = "cpu"

    def allowed(self, most: float) -> float:
        """How much work a step may be, which on the processor is `most`: a device goes through it in less time."""
        return _MORE * most if self.device == "cuda" else most


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


class Rule(NamedTuple):
    """An integrator of one unknown x a step, in numbers: origin = p + recalls (p - p'), target = origin + leads v +
    bends (v - v'), with p', v' one step before, and leads and bends [s]. ahead [s]: how far what is lagged is
    extrapolated; when: the time of x within the step, 1 at its end."""

    recalls: float
    leads: float
    bends: float
    ahead: float
    when: float


@dataclass(frozen=True, eq=False)
class Course:
    """What a device needs to go on by itself from step to step of a time integrator.

    rule: of the integrator; first: the method ready for the system of the first step, and the rule of that, where it is
    another; positions [m], velocity [m/s]: at the start, (n, 3); load: the forces that never change, (n, 3) [N];
    filters: of the velocity (`solvers.filters`), before each step, in their order; first_guess: its name; pins_at:
    where the pins want their vertices at a time [s], (q, 3) [m]; pins_move: whether that changes.
    """

    system: System
    rule: Rule
    first: tuple[Remote, Rule] | None
    positions: Positions
    velocity: Positions
    load: Positions
    filters: tuple[object, ...]
    first_guess: str
    pins_at: Callable[[float], Positions]
    pins_move: bool


class Steps(Protocol):
    """Steps that follow each other on a device."""

    def restart(self) -> None:
        """Bring the start to the device; waits for it."""
        ...

    def step(self, iterations: int) -> Marks | None:
        """The next step by so many iterations, and no look at it; waits for its end."""
        ...

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The next step up to where `stop` ends it, and a copy of that; problem: the same step, as a host states it."""
        ...

    def positions(self) -> Positions:
        """A copy of where the last step ended, (n, 3) [m]."""
        ...


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

    def triad(self) -> tuple[float, Event, Event] | None:
        """Bytes that a triad a = b + s c read and wrote, between two events that have been waited for; None of a device
        without a clock, or without room for it."""
        ...

    def stepping(self, course: Course) -> Steps:
        """Steps that stay on the device. Raises Unsupported with the reason why a host has to state each."""
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

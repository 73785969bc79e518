"""The interfaces between a scene and a solver: Energy, System, StepProblem, Solver.

A step of implicit Euler minimises the incremental potential (Liu et al. 2013, eq. 6)

    g(p) = sum of energies(p) + c/(2 dt^2) |p - target|_M^2 - tr(p' f) + sum_pins w/2 |p_i - pin_i|^2

over the positions p that keep all exact lengths, with c = 1 and target = 2 p^t - p^(t-dt); other integrators have
others (see `solvers.integrators`). `StepProblem` states g in plain NumPy: every accuracy figure is taken from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal, Protocol, TypeGuard, runtime_checkable

import numpy as np
import scipy
from numpy.typing import NDArray

from solvers.held import Lengths, Pins

Positions = NDArray[np.float64]
"""Positions [m], shape (n, 3), float64, C-contiguous."""
ResidualOf = Literal["returned", "previous", "none"]
"""The iterate that a residual belongs to: what a solve returns, or the one before; none where there is no residual."""


class WrongAnswer(Exception):
    """A part of a solver of somebody's own gave something else than was asked; the message begins with its line."""


class Unsupported(Exception):
    """A solver cannot minimise this system; the message says which part of it and why."""


class NotPositiveDefinite(Exception):
    """The system matrix has no Cholesky factor: some vertex is loose, or round-off or the input spoils it.

    vertices: those that the message names.
    """

    def __init__(self, message: str = "", vertices: Sequence[int] = ()) -> None:
        super().__init__(message)
        self.vertices = tuple(vertices)


class Energy(Protocol):
    """A potential [J] of positions [m]."""

    def value(self, p: Positions) -> float:
        """The energy [J] at p, shape (n, 3)."""
        ...

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N], shape (n, 3), to `out`."""
        ...

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """The Hessian [N/m], shape (3n, 3n), the coordinates of a vertex side by side."""
        ...


@runtime_checkable
class ProjectiveEnergy(Energy, Protocol):
    """min over d of sum_e w_e/2 |(A p)_e - d_e|^2 with each d_e on a manifold (Bouaziz et al. 2014)."""

    def stiffness_matrix(self, n: int) -> scipy.sparse.csr_array:
        """The energy's share A'KA [N/m] of the system matrix, shape (n, n)."""
        ...

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add A'K d(p) [N], shape (n, 3), its share of the right-hand side, to `out`."""
        ...


@dataclass(frozen=True, eq=False)
class System:
    """What stays fixed in a run, and so is factorised once.

    mass: (n,) [kg], zero is allowed where springs or pins hold the vertex; time_step: dt [s];
    energies: potentials of the positions; pins: which vertices are pinned, and how; factor, speed: of the integrator,
    c and the unknown's velocity over its change in 1/dt, None for sqrt(c); lengths: what is kept exactly.
    """

    mass: NDArray[np.float64]
    time_step: float
    energies: tuple[Energy, ...] = ()
    pins: Pins = field(default_factory=Pins)
    factor: float = 1.0
    speed: float | None = None
    lengths: tuple[Lengths, ...] = ()

    @property
    def rate(self) -> float:
        """sqrt(c)/dt, or speed/dt [1/s], as `Start` has it."""
        return (self.factor**0.5 if self.speed is None else self.speed) / self.time_step

    @cached_property
    def inertia(self) -> NDArray[np.float64]:
        """c m/dt^2 (n,) [N/m], the inertia's share of Q."""
        return self.factor * self.mass / self.time_step**2

    @property
    def vertices(self) -> int:
        """n, the number of vertices."""
        return len(self.mass)

    @cached_property
    def free(self) -> NDArray[np.int64]:
        """The vertices that are unknowns: all but the exactly pinned, shape (f,)."""
        return np.setdiff1d(np.arange(self.vertices), self.pins.vertices[self.pins.exact])

    @cached_property
    def unpinned(self) -> NDArray[np.bool_]:
        """Which vertices no pin holds, exact or penalty, shape (n,)."""
        mask = np.ones(self.vertices, bool)
        mask[self.pins.vertices] = False
        return mask

    @cached_property
    def penalty(self) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.float64]]:
        """The pins by penalty: which of `pins` they are (q,), their vertices and their weights [N/m]."""
        soft = ~self.pins.exact
        return soft, self.pins.vertices[soft], self.pins.weight[soft]


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a step starts, for energies that depend on it and for methods that do not minimise.

    positions: p^t (n, 3) [m]; velocity: v^t, filters included, (n, 3) [m/s]; time: t [s]; origin (n, 3) [m] and rate
    [1/s]: the unknown x moves with the velocity rate (x - origin); until: the time of x [s] (nan, which spoils all that
    depends on it, where it is not told); ahead: how far [s] to extrapolate what is lagged; lagged: where it is taken
    instead, (n, 3) [m]; acceleration: what the motion so far leads to expect, (n, 3) [m/s^2]; kept: by the last solve;
    pressed: an iterate of x, (n, 3) [m], whose normal forces friction takes; None: those of the step's start.
    """

    positions: Positions
    velocity: Positions
    time: float
    origin: Positions
    rate: float
    until: float = float("nan")
    ahead: float = 0.0
    lagged: Positions | None = None
    acceleration: Positions | None = None
    kept: NDArray[np.float64] | None = None
    pressed: Positions | None = None

    @property
    def expected(self) -> Positions:
        """The positions that an energy is lagged at, (n, 3) [m]: p^t, or extrapolated by `ahead`, or `lagged`."""
        p = self.positions if self.lagged is None else self.lagged
        return p + self.ahead * self.velocity if self.ahead else p

    def velocity_at(self, x: Positions) -> Positions:
        """The velocity [m/s] of the unknown x, both (n, 3)."""
        return self.rate * (x - self.origin)


class LaggedEnergy(Energy, Protocol):
    """An energy that depends on where the step starts: damping, friction, obstacles that move. Of that, the stiffness
    of a projective one may depend on the rate alone, for Q is made once."""

    def begin_step(self, start: Start) -> Energy:
        """The energy of this one step."""
        ...


def is_lagged(energy: Energy) -> TypeGuard[LaggedEnergy]:
    """Whether it does; to ask the protocol itself takes a hundredth of a small step."""
    return hasattr(energy, "begin_step")


@dataclass(frozen=True, eq=False)
class StepProblem:
    """What one step minimises. All arrays are float64 and are never written to.

    target: where inertia alone would bring the unknown, velocity filters included, (n, 3) [m]; force: (n, 3) [N];
    pin_targets: where the pins want their vertices, (q, 3) [m], in the order of `system.pins`;
    current: p^t with its pinned vertices on their targets, (n, 3) [m], the yardstick of the stop rule;
    first_guess: where the iteration starts, (n, 3) [m]; start: of the step.
    """

    system: System
    target: Positions
    force: Positions
    pin_targets: Positions
    current: Positions
    first_guess: Positions
    start: Start

    @cached_property
    def energies(self) -> tuple[Energy, ...]:
        """The system's energies, as they are in this step, in their order."""
        return tuple(e.begin_step(self.start) if is_lagged(e) else e for e in self.system.energies)

    def terms(self, p: Positions) -> dict[str, float]:
        """The terms [J] of the objective at p by name: inertia, force, pins, and energies by their class."""
        s, values, away = self.system, dict[str, float](), p - self.target
        for energy in self.energies:
            name = type(energy).__name__.lower()  # which may be that of one of the three
            name = f"energy {name}" if name in ("inertia", "force", "pins") else name
            values[name] = values.get(name, 0.0) + energy.value(p)
        values["inertia"] = 0.5 * float(s.inertia @ np.einsum("ij,ij->i", away, away))
        values["force"] = -float(np.einsum("ij,ij->", p, self.force))
        soft, vertices, weight = s.penalty
        sag = p[vertices] - self.pin_targets[soft]
        values["pins"] = 0.5 * float(weight @ np.einsum("ij,ij->i", sag, sag))
        return values

    def value(self, p: Positions) -> float:
        """The objective g(p) [J]; exact pins are taken to be on their targets."""
        return sum(self.terms(p).values())

    def magnitude(self, p: Positions) -> float:
        """The sum of the terms' absolute values [J]: the scale of round-off in `value`."""
        return sum(abs(term) for term in self.terms(p).values())

    def gradient(self, p: Positions) -> Positions:
        """The gradient of g at p [N], shape (n, 3); zero rows at exactly pinned vertices."""
        s = self.system
        out = s.inertia[:, None] * (p - self.target) - self.force
        for energy in self.energies:
            energy.add_gradient(p, out)
        soft, vertices, weight = s.penalty
        out[vertices] += weight[:, None] * (p[vertices] - self.pin_targets[soft])
        out[s.pins.vertices[s.pins.exact]] = 0.0
        return out


@dataclass(frozen=True, slots=True)
class StopRule:
    """When a solve ends: after `iterations`; once the residual is at most `within` [J^(1/2)], or `tolerance` times that
    at the current positions; or once the gradient is no more than round-off, so that a scene at rest stops at once.

    The residual is |Q^-1 grad g(p)|_Q = |p - LG(p)|_Q over the unpinned vertices. A gradient counts as round-off where
    at each of them it is at most `floor` times the bound of `solvers.round_off`; a floor of 0 turns this off."""

    iterations: int = 50
    tolerance: float | None = None
    floor: float = 8.0
    within: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where a solve ended. positions: (n, 3) [m]; iterations: how many were done; residual: |Q^-1 grad g|_Q [J^(1/2)]
    over the unpinned vertices, by which the rule judged (nan for a method that does not minimise), of the iterate that
    residual_of names; yardstick: the same at the current positions (nan without a tolerance); stopped: "iterations",
    "tolerance", "floor", or "stalled" where nothing descends any more; velocity: (n, 3) [m/s], of a method's own; kept
    (of any shape): what it begins the next step with."""

    positions: Positions
    iterations: int
    residual: float
    yardstick: float
    stopped: str
    velocity: Positions | None = None
    residual_of: ResidualOf = "returned"
    kept: NDArray[np.float64] | None = None


class Prepared(Protocol):
    """A solver that has factorised, coloured and compiled what one system needs."""

    @property
    def choice(self) -> str:
        """What the solver chose by itself, and why, in words; empty where it had nothing to choose."""
        ...

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built, by name (for example `nnz_system`, `nnz_factor`)."""
        ...

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The iterates, one more each time it is asked; a yielded array may be reused (copy to keep)."""
        ...

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The same iterates on the fast path, up to where `stop` ends them."""
        ...

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """|Q^-1 grad g|_Q [J^(1/2)] at p (n, 3) [m], which may take an iteration; nan where none is known."""
        ...

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """The parts of an iteration by name, if any; each returns the array (or what else) that it has computed."""
        ...


class Solver(Protocol):
    """A frozen dataclass of a method's parameters. minimises: whether its iterates tend to a minimum of the step's
    objective; others are graded on their trajectories. descends: whether it rises in no iteration, round-off apart.
    One that keeps exact lengths has `keeps_lengths` as well, True."""

    minimises: ClassVar[bool]
    descends: ClassVar[bool]

    def prepare(self, system: System) -> Prepared:
        """Raises Unsupported, before any work, for what the method cannot do, and NotPositiveDefinite."""
        ...

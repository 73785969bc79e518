"""The interface of an effect: what a scene declares, bound to a mesh, contributes to the step's formula.

An absent effect is an empty tuple: no flag, no branch, no allocation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import InputError
from harness.scenes.mesh.base import Mesh
from harness.scenes.motion import KeyedMotion
from solvers import integrators
from solvers.energies.springs import Springs
from solvers.held import Lengths
from solvers.integrators import splits
from solvers.problem import Energy, Positions

if TYPE_CHECKING:  # for those who have any
    from harness.scenes.intersections import Apart


class Force(Protocol):
    """An external force, folded into the right-hand side once a step."""

    def __call__(self, p: Positions, v: Positions, t: float) -> Positions:
        """The force [N], shape (n, 3), at positions p [m], velocities v [m/s] and time t [s] of the step's start."""
        ...


class VelocityFilter(Protocol):
    """A change of the velocity at the start of a step."""

    def __call__(self, v: Positions) -> Positions:
        """The changed velocity [m/s], shape (n, 3)."""
        ...


class Derived(Protocol):
    """Energies that follow from those of a scene's other effects."""

    def __call__(self, energies: Sequence[Energy]) -> tuple[Energy, ...]:
        """The energies to be added to these."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Pin:
    """Vertices (q,) held at targets (q, 3) [m] with a penalty weight [N/m]; an infinite weight is exact.

    motion: takes the targets along, where they move.
    """

    vertices: NDArray[np.int64]
    targets: Positions
    weight: float
    motion: KeyedMotion | None = None


class Check(Protocol):
    """What an effect asks of a scene's other parts."""

    def __call__(self, start: Positions, pins: Sequence[Pin]) -> None:
        """Raise InputError where the effect does not fit the start (n, 3) [m], or the pins."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """The places that the step formula has, and no others."""

    energies: tuple[Energy, ...] = field(default=())
    forces: tuple[Force, ...] = field(default=())
    pins: tuple[Pin, ...] = field(default=())
    filters: tuple[VelocityFilter, ...] = field(default=())
    derived: tuple[Derived, ...] = field(default=())
    lengths: tuple[Lengths, ...] = field(default=())
    checks: tuple[Check, ...] = field(default=())
    once: tuple[str, ...] = field(default=())
    """What a scene can have but once, in words; a second one would be added to the first."""
    apart: tuple[Apart, ...] = ()
    """What may not pass through what, for whoever looks."""
    ends: tuple[str, ...] = ()
    """Why each unknown has to be where a step ends, in words."""
    continuous: tuple[Callable[[], Contribution], ...] = field(default=())
    """Makes what does the same by forces and energies alone: for integrators that take forces at their unknowns."""

    def by(self, method: integrators.AnyIntegrator) -> Contribution:
        """What an integrator takes of it."""
        return self.continuous[0]() if self.continuous and not splits(method) else self

    @property
    def empty(self) -> bool:
        """Whether there is nothing in any place."""
        return not (self.energies or self.forces or self.pins or self.filters or self.derived or self.lengths)


class Effect(Protocol):
    """A pydantic model with a literal `kind`.

    Its class states `exact_to`, a class variable: the order of the error, by steps, up to which integrators keep their
    own with it; infinite where it is smooth and they take it where it acts. One that does not say so promises nothing.
    It may state class variables: `damps`, True where it takes energy out of any motion; `plain`, True where scenes have
    it that the prices of effects are told against, so that it has none; and
    `called_for(seen: Seen) -> str`, a class method: by what evidence the motion of a scene that does not list it asks
    for it, "" where it does not.
    """

    @property
    def kind(self) -> str:
        """The effect's name in `harness.scenes.effects.effect_names`."""
        ...

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """What the effect contributes on this mesh with these vertex masses [kg] and dt [s], once a scene.

        Raises InputError when the effect does not fit the mesh.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What was seen of a scene, for effects that it does not list.

    springs: with (m, 2) ends and their (m,) rest lengths [m]; length: the mean of these, or the mesh's spacing [m];
    mass: (n,) [kg]; held: whether pins hold it; driven: whether forces or obstacles keep it moving; damped: whether an
    effect takes energy out of it; positions [m], velocities [m/s]: (frames, n, 3).
    """

    mesh: Mesh
    springs: Springs
    length: float
    mass: NDArray[np.float64]
    time_step: float
    held: bool
    driven: bool
    damped: bool
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]

    def time(self, frame: int) -> float:
        """Of a frame's end [s]; counted from 0."""
        return (frame + 1) * self.time_step


FEW = 0.01
"""Of springs, and of edges: fewer are the corners that hang on a pin, where strain and curvature grow without bound as
the mesh is refined."""


@dataclass(frozen=True, slots=True, eq=False)
class Steady:
    """A force (n, 3) [N] that never changes; a scene adds all of these up once."""

    force: Positions

    def __call__(self, p: Positions, v: Positions, t: float) -> Positions:
        """The same force at all times."""
        return self.force


def kept(mesh: Mesh, springs: NDArray[np.int64], shortest: float, longest: float) -> Contribution:
    """Lengths of springs (m, 2) that are exact, from `shortest` to `longest` times those at rest; nothing for none.

    Raises InputError for a spring of no length.
    """
    if not len(springs):
        return Contribution()
    rest = Springs.at_rest(mesh.rest, springs, np.ones(len(springs)))
    r = rest.rest_length
    if len(none := np.flatnonzero(r == 0.0)):
        i, j = springs[none[0]]
        problem = f"the spring {i}-{j} has no length at rest, and none that could be kept; give a stiffness in figures"
        raise InputError(problem)
    lengths = Lengths(rest.edges, shortest * r, longest * r, rest.rest_direction)
    return Contribution(lengths=(lengths,), ends=("keeps lengths as they are at the end of a step",))


def steady(force: Positions) -> tuple[Steady, ...]:
    """A force (n, 3) [N] that never changes; none at all where it is zero everywhere."""
    force.flags.writeable = False
    return (Steady(force),) if force.any() else ()

"""Interface of an effect: its contribution to the step objective for a given mesh.

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
    """External force, added to the right-hand side once per step."""

    def __call__(self, p: Positions, v: Positions, t: float) -> Positions:
        """Return the force [N].

        Args:
            p: positions (n, 3) [m] at the start of the step.
            v: velocities (n, 3) [m/s] at the start of the step.
            t: time [s] of the start of the step.

        Returns:
            The force (n, 3) [N].
        """
        ...


class VelocityFilter(Protocol):
    """Modification of the velocity at the start of a step."""

    def __call__(self, v: Positions) -> Positions:
        """Return the modified velocity (n, 3) [m/s]."""
        ...


class Derived(Protocol):
    """Energies that depend on the energies of the scene's other effects."""

    def __call__(self, energies: Sequence[Energy]) -> tuple[Energy, ...]:
        """Return the additional energies."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Pin:
    """Vertices (q,) pinned to targets (q, 3) [m] with a penalty weight [N/m]; an infinite weight is exact.

    Attributes:
        motion: motion of the targets, None if they are fixed.
    """

    vertices: NDArray[np.int64]
    targets: Positions
    weight: float
    motion: KeyedMotion | None = None


class Check(Protocol):
    """Requirement of an effect on the other parts of a scene."""

    def __call__(self, start: Positions, pins: Sequence[Pin]) -> None:
        """Raise InputError if the effect is incompatible with the start (n, 3) [m] or the pins."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """Contributions of an effect to the step problem, by kind of term."""

    energies: tuple[Energy, ...] = field(default=())
    forces: tuple[Force, ...] = field(default=())
    pins: tuple[Pin, ...] = field(default=())
    filters: tuple[VelocityFilter, ...] = field(default=())
    derived: tuple[Derived, ...] = field(default=())
    lengths: tuple[Lengths, ...] = field(default=())
    checks: tuple[Check, ...] = field(default=())
    once: tuple[str, ...] = field(default=())
    """Features that a scene can have only once, in words; a second one would be added to the first."""
    apart: tuple[Apart, ...] = ()
    """Primitives that must not intersect, for verification."""
    ends: tuple[str, ...] = ()
    """Reasons why each stage has to lie at the end of a step, in words."""
    continuous: tuple[Callable[[], Contribution], ...] = field(default=())
    """Builds an equivalent form with forces and energies only, for integrators that evaluate forces at their stages."""

    def by(self, method: integrators.AnyIntegrator) -> Contribution:
        """Return the form of the contribution that an integrator supports."""
        return self.continuous[0]() if self.continuous and not splits(method) else self

    @property
    def empty(self) -> bool:
        """Whether the contribution has no terms."""
        return not (self.energies or self.forces or self.pins or self.filters or self.derived or self.lengths)


class Effect(Protocol):
    """A pydantic model with a literal `kind`.

    Its class states `exact_to`, a class variable: the order of the error in the step size up to which
    integrators retain their own order with the effect. It is infinite if the effect is smooth and evaluated where it
    acts; without it, no order is guaranteed. Optional class variables: `damps`, True if the effect removes
    energy from any motion; `plain`, True if the baseline scenes of the effects' cost contain it, so it has
    no cost of its own; and `called_for(seen: Seen) -> str`, a class method that returns the evidence
    in the motion of a scene that the effect is missing, or "".
    """

    @property
    def kind(self) -> str:
        """Name of the effect in `harness.scenes.effects.effect_names`."""
        ...

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Build the contribution of the effect, once per scene.

        Args:
            mesh: the mesh.
            mass: vertex masses (n,) [kg].
            time_step: dt [s].

        Raises:
            InputError: if the effect does not fit the mesh.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Observed motion of a scene, for the detection of missing effects.

    Attributes:
        springs: ends (m, 2) and rest lengths (m,) [m].
        length: mean rest length, or the mesh's spacing [m].
        mass: (n,) [kg].
        held: whether vertices are pinned.
        driven: whether forces or obstacles maintain the motion.
        damped: whether an effect dissipates energy.
        positions: (frames, n, 3) [m].
        velocities: (frames, n, 3) [m/s].
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
        """Return the time [s] of the end of a frame; frames count from 0."""
        return (frame + 1) * self.time_step


FEW = 0.01
"""Fraction of springs or edges that is negligible: the corners next to a pin, where strain and curvature grow without
bound under mesh refinement."""


@dataclass(frozen=True, slots=True, eq=False)
class Steady:
    """A constant force field (n, 3) [N]; a scene adds all of them once."""

    force: Positions

    def __call__(self, p: Positions, v: Positions, t: float) -> Positions:
        """Return the force, which is the same at all times."""
        return self.force


def kept(mesh: Mesh, springs: NDArray[np.int64], shortest: float, longest: float) -> Contribution:
    """Build length constraints of springs, empty for no springs.

    Args:
        mesh: the mesh.
        springs: (m,) indices of springs.
        shortest: smallest length relative to the rest length.
        longest: largest length relative to the rest length.

    Raises:
        InputError: for a spring of zero length.
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
    """Wrap a constant force (n, 3) [N]; empty if it is zero everywhere."""
    force.flags.writeable = False
    return (Steady(force),) if force.any() else ()

"""Interface of an effect: its contribution to the step objective for a given mesh.

An absent effect is an empty tuple: no flag, no branch, no allocation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.solvers.model import integrators
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.integrators import has_split_filters
from springbench.solvers.model.step_problem import Energy, LengthConstraints, Positions

if TYPE_CHECKING:
    from springbench.harness.scenes.edge_triangle_intersections import IntersectionCheck


class ForceFunction(Protocol):
    """External force, added to the right-hand side once per step.

    Example:
        >>> import numpy as np
        >>> drag: springbench.ForceFunction = lambda p, v, t: -0.1 * v
        >>> drag(np.zeros((1, 3)), np.ones((1, 3)), 0.0).tolist()
        [[-0.1, -0.1, -0.1]]
    """

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
    """Modification of the velocity at the start of a step.

    Example:
        >>> import numpy as np
        >>> halve: springbench.VelocityFilter = lambda v: 0.5 * v
        >>> halve(np.ones((1, 3))).tolist()
        [[0.5, 0.5, 0.5]]
    """

    def __call__(self, v: Positions) -> Positions:
        """Return the modified velocity (n, 3) [m/s]."""
        ...


class DerivedEnergies(Protocol):
    """Energies that depend on the energies of the scene's other effects.

    Example:
        >>> def derive_none(energies):
        ...     return ()
        >>> springbench.EffectContribution(derived_energies=(derive_none,)).is_empty
        False
    """

    def __call__(self, energies: Sequence[Energy]) -> tuple[Energy, ...]:
        """Return the additional energies."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class PinGroup:
    """Vertices that are pinned to targets.

    Attributes:
        vertices: pinned vertices (q,).
        targets: targets (q, 3) [m].
        weight: penalty weight [N/m]; infinite for exact pins.
        motion: motion of the targets, None if they are fixed.

    Example:
        >>> import numpy as np
        >>> springbench.PinGroup(np.array([0]), targets=np.zeros((1, 3)), weight=np.inf).weight
        inf
    """

    vertices: NDArray[np.int64]
    targets: Positions
    weight: float
    motion: KeyFrameMotion | None = None


class SceneCheck(Protocol):
    """Requirement of an effect on the other parts of a scene.

    Example:
        >>> def require_pin(start, pins):
        ...     if not pins:
        ...         raise springbench.InputError("the effect needs a pin")
        >>> (check,) = springbench.EffectContribution(scene_checks=(require_pin,)).scene_checks
        >>> check([], pins=[])
        Traceback (most recent call last):
        springbench.harness.errors.InputError: the effect needs a pin
    """

    def __call__(self, start: Positions, pins: Sequence[PinGroup]) -> None:
        """Raise InputError if the effect is incompatible with the start or the pins.

        Args:
            start: initial positions (n, 3) [m].
            pins: all pins of the scene.

        Raises:
            InputError: the effect does not work with them.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class EffectContribution:
    """Contributions of an effect to the step problem, by kind of term.

    Attributes:
        energies: potentials, minimised in each step.
        forces: forces, evaluated once per step.
        pins: pinned vertices.
        velocity_filters: changes of the velocity at the start of a step.
        derived_energies: functions of the energies of the scene's other effects.
        length_constraints: lengths that are satisfied exactly.
        scene_checks: requirements on the start and the pins.

    Example:
        >>> springbench.EffectContribution(forces=(lambda p, v, t: -0.1 * v,)).is_empty
        False
    """

    energies: tuple[Energy, ...] = field(default=())
    forces: tuple[ForceFunction, ...] = field(default=())
    pins: tuple[PinGroup, ...] = field(default=())
    velocity_filters: tuple[VelocityFilter, ...] = field(default=())
    derived_energies: tuple[DerivedEnergies, ...] = field(default=())
    length_constraints: tuple[LengthConstraints, ...] = field(default=())
    scene_checks: tuple[SceneCheck, ...] = field(default=())
    exclusive_features: tuple[str, ...] = field(default=())
    """Features that a scene can have only once, in words; a second one would be added to the first."""
    intersection_checks: tuple[IntersectionCheck, ...] = ()
    """Primitives that must not intersect, for verification."""
    end_of_step_reasons: tuple[str, ...] = ()
    """Reasons why each stage has to lie at the end of a step, in words."""
    continuous_forms: tuple[Callable[[], EffectContribution], ...] = field(default=())
    """At most one function that builds an equivalent form with forces and energies only, for integrators that evaluate
    forces at their stages."""

    def adapt_to_integrator(self, integrator: integrators.AnyIntegrator) -> EffectContribution:
        """Return the form of the contribution that an integrator supports."""
        return self.continuous_forms[0]() if self.continuous_forms and not has_split_filters(integrator) else self

    @property
    def is_empty(self) -> bool:
        """Whether the contribution has no terms."""
        return not (
            self.energies
            or self.forces
            or self.pins
            or self.velocity_filters
            or self.derived_energies
            or self.length_constraints
        )


class SceneEffect(Protocol):
    """A pydantic model with a literal `kind`.

    Its class states `max_convergence_order`, a class variable: the order of the error in the step size up to which
    integrators retain their own order with the effect. It is infinite if the effect is smooth and evaluated where it
    acts; without it, no order is guaranteed. The class may have two more class variables. `is_dissipative` is True if
    the effect removes energy from any motion. `is_baseline_effect` is True if the baseline scenes of the effects' cost
    contain the effect, so that no cost of it is measured. It may also have a class method
    `find_evidence(observed: ObservedMotion) -> str`, which returns the evidence in the motion of a scene that the
    effect is missing, or "".

    Example:
        >>> class Drag(springbench.ConfigModel):
        ...     kind: str = "drag"
        ...     coefficient: float
        ...     def build_contribution(self, mesh, mass, time_step):
        ...         return springbench.EffectContribution(forces=(lambda p, v, t: -self.coefficient * v,))
        >>> scene = springbench.make_scene(
        ...     mesh={"kind": "chain"}, mass=1.0, time_step=1 / 30, frames=30, effects=[Drag(coefficient=0.1)]
        ... )
        >>> scene.effects[0].coefficient
        0.1
    """

    @property
    def kind(self) -> str:
        """Name of the effect in `springbench.harness.scenes.effects.effect_table`."""
        ...

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
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
class ObservedMotion:
    """Observed motion of a scene, for the detection of missing effects.

    Attributes:
        mesh: the mesh at rest.
        springs: ends (m, 2) and rest lengths (m,) [m].
        mean_spring_length: mean rest length, or the mesh's spacing [m].
        mass: vertex masses (n,) [kg].
        time_step: duration of a frame [s].
        has_pins: whether vertices are pinned.
        is_driven: whether forces or obstacles maintain the motion.
        is_damped: whether an effect dissipates energy.
        positions: (frames, n, 3) [m].
        velocities: (frames, n, 3) [m/s].

    Example:
        >>> import numpy as np
        >>> rest, springs = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), {"stretch": np.array([[0, 1]])}
        >>> mesh = springbench.assemble_mesh(rest_positions=rest, springs=springs)
        >>> observed = springbench.ObservedMotion(
        ...     mesh=mesh,
        ...     springs=springbench.Springs.from_rest_shape(rest, mesh.springs, np.array([100.0])),
        ...     mean_spring_length=1.0,
        ...     mass=np.ones(2),
        ...     time_step=0.5,
        ...     has_pins=False,
        ...     is_driven=False,
        ...     is_damped=False,
        ...     positions=np.zeros((3, 2, 3)),
        ...     velocities=np.zeros((3, 2, 3)),
        ... )
        >>> observed.compute_frame_time(2)
        1.5
    """

    mesh: Mesh
    springs: Springs
    mean_spring_length: float
    mass: NDArray[np.float64]
    time_step: float
    has_pins: bool
    is_driven: bool
    is_damped: bool
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]

    def compute_frame_time(self, frame: int) -> float:
        """Return the time [s] of the end of a frame; frames count from 0."""
        return (frame + 1) * self.time_step


NEGLIGIBLE_FRACTION = 0.01
"""Fraction of springs or edges that is negligible: the corners next to a pin, where strain and curvature grow without
bound under mesh refinement."""


@dataclass(frozen=True, slots=True, eq=False)
class ConstantForceField:
    """A constant force field (n, 3) [N]; a scene adds all of them once."""

    force: Positions

    def __call__(self, p: Positions, v: Positions, t: float) -> Positions:
        """Return the force (n, 3) [N], which is the same at all times.

        Args:
            p, v, t: positions (n, 3) [m], velocities (n, 3) [m/s] and time [s], which do not matter here.
        """
        return self.force


def build_length_constraints(
    mesh: Mesh, springs: NDArray[np.int64], min_ratio: float, max_ratio: float
) -> EffectContribution:
    """Build length constraints of springs, empty for no springs.

    Args:
        mesh: the mesh.
        springs: (m,) indices of springs.
        min_ratio: smallest length relative to the rest length.
        max_ratio: largest length relative to the rest length.

    Raises:
        InputError: for a spring of zero length.
    """
    if not len(springs):
        return EffectContribution()
    rest = build_rest_springs(mesh, springs, np.ones(len(springs)))
    r = rest.rest_length
    if len(none := np.flatnonzero(r == 0.0)):
        i, j = rest.edges[none[0]]
        problem = (
            f"the spring {i}-{j} has no length at rest, and so no length to constrain; give a stiffness in figures"
        )
        raise InputError(problem)
    lengths = LengthConstraints(rest.edges, min_ratio * r, max_ratio * r, rest.rest_direction)
    return EffectContribution(
        length_constraints=(lengths,), end_of_step_reasons=("corrects lengths at the end of a step",)
    )


def build_rest_springs(mesh: Mesh, indices: NDArray[np.int64], stiffness: NDArray[np.float64]) -> Springs:
    """Build springs of a mesh with its rest lengths.

    Args:
        mesh: the mesh.
        indices: (m,) indices of its springs.
        stiffness: (m,) [N/m].
    """
    springs = Springs.from_rest_shape(mesh.rest_positions, mesh.springs[indices], stiffness)
    own = mesh.spring_properties
    return springs if own is None else replace(springs, rest_length=own.rest_length[indices])


def build_constant_force(force: Positions) -> tuple[ConstantForceField, ...]:
    """Wrap a constant force (n, 3) [N]; empty if it is zero everywhere.

    Example:
        >>> import numpy as np
        >>> (weight,) = springbench.build_constant_force(np.array([[0.0, -9.81, 0.0]]))
        >>> weight.force.tolist()
        [[0.0, -9.81, 0.0]]
    """
    force.flags.writeable = False
    return (ConstantForceField(force),) if force.any() else ()

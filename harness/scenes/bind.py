"""Build the simulated system of a scene for a mesh size, with only the terms that the scene requires."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import InputError, Mistake
from harness.scenes import own
from harness.scenes.effects.base import Contribution, Force, Pin, Steady, VelocityFilter
from harness.scenes.mesh.base import Mesh
from harness.scenes.mesh.topology import by_area
from harness.scenes.motion import KeyedMotion
from harness.scenes.selection import Selection
from harness.scenes.spec import SceneSpec
from harness.scenes.start import Rest
from solvers import integrators
from solvers.energies.springs import Springs
from solvers.integrators import IMPLICIT_EULER, find
from solvers.matrices import assemble
from solvers.problem import NotPositiveDefinite, Pins, Positions, ProjectiveEnergy, System

if TYPE_CHECKING:  # for those who have any
    from harness.scenes.intersections import Apart

_LOG = logging.getLogger("springbench")
AT_REST = Rest()
COARSEST = 9
"""Smallest mesh size that is coarsened for nested iteration: below it, a solve costs next to nothing."""
LONG = 1.0
"""Time steps [s] above this value cause a warning: most motion ends within a few of them."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene, built for one mesh size.

    Attributes:
        mesh: the mesh at rest.
        start: the deviation of the initial state from the rest state.
        system: the data that solvers factorise.
        load: sum of the constant forces, (n, 3) [N], read-only.
        forces: the other external forces.
        filters: changes of the velocity before a step.
        pin_targets: (q, 3) [m], in the order of `system.pins`.
        moving: which of the targets move, and how.
        velocity: of every vertex [m/s], without the start's spin.
        integrator: the time integrator; its factor and velocity rule are those of the system.
        apart: primitives that must not intersect; empty unless an effect prevents intersections.
        alternate: the same scene with the time step of every second step, if that differs.
        halved: builds the scene on a mesh of half the size, None if there is none.
    """

    mesh: Mesh
    system: System
    load: Positions
    forces: tuple[Force, ...]
    filters: tuple[VelocityFilter, ...]
    pin_targets: Positions
    velocity: tuple[float, float, float]
    integrator: integrators.AnyIntegrator = IMPLICIT_EULER
    moving: tuple[tuple[NDArray[np.int64], KeyedMotion], ...] = ()
    start: Rest = AT_REST
    apart: tuple[Apart, ...] = ()

    @property
    def self_contact(self) -> bool:
        """Whether an effect prevents self-intersection of the mesh."""
        return any(one.beside is None for one in self.apart)

    alternate: Scene | None = None
    halved: Callable[[], Scene] | None = None

    def at(self, index: int) -> Scene:
        """Return the scene of the step that follows step `index`."""
        return self.alternate if self.alternate and index % 2 else self

    def time(self, index: int) -> float:
        """Return the time [s] at which step `index` ends and the next starts; 0 is the start."""
        if not self.alternate:
            return index * self.system.time_step
        return (index + 1) // 2 * self.system.time_step + index // 2 * self.alternate.system.time_step

    def pins_at(self, time: float) -> Positions:
        """Return the pin targets at a time [s], (q, 3) [m]."""
        if not self.moving:
            return self.pin_targets
        targets = self.pin_targets.copy()
        for rows, motion in self.moving:
            targets[rows] = motion.moved(self.pin_targets[rows], time)
        return targets

    def pins_moving(self, time: float) -> Positions:
        """Return the velocities of the pin targets at a time [s], (q, 3) [m/s]."""
        velocity = np.zeros_like(self.pin_targets)
        for rows, motion in self.moving:
            velocity[rows] = motion.velocity(self.pin_targets[rows], time)
        return velocity

    @cached_property
    def springs(self) -> Springs:
        """All springs with stiffness, by effect and in mesh order; then length constraints with infinite stiffness."""
        exact = [x for x in self.system.lengths if (x.low == x.high).all()]
        return Springs.joined(
            [
                *(energy for energy in self.system.energies if isinstance(energy, Springs)),
                *(Springs(x.edges, np.full(len(x.low), np.inf), x.high, x.rest_direction) for x in exact),
            ]
        )


def build(spec: SceneSpec, size: int, integrator: str = "implicit-euler", *, warns: bool = True) -> Scene:
    """Build a scene for a mesh size and an integrator.

    Args:
        spec: the scene.
        size: mesh size, ignored by a mesh from a file.
        integrator: name of the time integrator.
        warns: whether valid but unusual values are logged; False if the program chooses the time step.

    Raises:
        InputError: if the parts of the scene do not fit together.
    """
    spec = spec.opened()
    mesh, method = _mesh(spec, size), find(integrator)
    mass = _mass(spec, mesh)
    parts = [_bound(spec, i, mesh, mass).by(method) for i in range(len(spec.effects))]
    _single(spec, parts)
    _ends(parts, method, integrator)
    pins, targets, moving = _pins(parts, mesh)
    energies = tuple(energy for part in parts for energy in part.energies)
    energies += tuple(energy for part in parts for derive in part.derived for energy in derive(energies))
    forces = [force for part in parts for force in part.forces]
    lengths = tuple(one for part in parts for one in part.lengths)
    load = np.zeros_like(mesh.rest)
    for force in forces:
        if isinstance(force, Steady):
            load += force.force
    load.flags.writeable = False
    system = System(mass, spec.time_step, energies, pins, method.factor, method.speed, lengths)
    _require_determined(system, mesh)
    start = spec.start or AT_REST
    _check(parts, start.positions(mesh.rest))
    if warns:
        _doubt(spec)
    other = spec.alternate_time_step
    return Scene(
        mesh=mesh,
        system=system,
        load=load,
        forces=tuple(force for force in forces if not isinstance(force, Steady)),
        filters=tuple(one for part in parts for one in part.filters),
        pin_targets=targets,
        velocity=spec.velocity,
        integrator=method,
        moving=moving,
        start=start,
        apart=tuple(one for part in parts for one in part.apart),
        alternate=None if other in (None, spec.time_step) else build(spec.stepped(other), size, integrator),
        halved=_halved(spec, size, integrator),
    )


def _halved(spec: SceneSpec, size: int, integrator: str) -> Callable[[], Scene] | None:
    """Return a builder of the coarser scene, None if there is none.

    There is none for fixed-size meshes, the coarsest ones, and effects with vertex indices.
    """
    half = (size + 1) // 2
    numbered = any(isinstance(e, Selection) and (e.indices or e.every > 1) for e in spec.effects)
    return None if half < COARSEST or numbered else partial(build, spec, half, integrator)


def _mesh(spec: SceneSpec, size: int) -> Mesh:
    if "mesh" not in spec.own:
        return spec.mesh.build(size)
    plugin, _ = spec.own["mesh"]
    try:
        with own.blaming(plugin, "generate"):
            made: Any = spec.mesh.build(size)
        return own.sound(plugin, made)
    except InputError as error:
        raise InputError([replace(one, key=one.key or "mesh") for one in error.mistakes]) from error


def _bound(spec: SceneSpec, i: int, mesh: Mesh, mass: NDArray[np.float64]) -> Contribution:
    effect, (plugin, _) = spec.effects[i], spec.own.get(f"effects[{i}]", (None, None))
    try:
        given = mesh, mass, spec.time_step
        bound = effect.bind(*given) if plugin is None else own.bound(plugin, effect, *given)
    except InputError as error:
        raise InputError([replace(mistake, key=f"effects[{i}]") for mistake in error.mistakes]) from error
    if bound.empty:
        _LOG.info("effects[%d] (%s) does nothing with these parameters and is left out", i, spec.effects[i].kind)
    return bound


def _check(parts: list[Contribution], start: Positions) -> None:
    """Raise InputError if an effect is incompatible with the start (n, 3) [m] or the pins."""
    pins = [pin for part in parts for pin in part.pins]
    for i, part in enumerate(parts):
        try:
            for check in part.checks:
                check(start, pins)
        except InputError as error:
            raise InputError([replace(mistake, key=f"effects[{i}]") for mistake in error.mistakes]) from error


def _single(spec: SceneSpec, parts: list[Contribution]) -> None:
    """Raise InputError if two effects provide a feature that a scene can have only once."""
    first: dict[str, int] = {}
    for i, part in enumerate(parts):
        for what in part.once:
            if first.setdefault(what, i) != i:
                problem = f"{what} is there already, as effects[{first[what]}]; the two would add up, so keep one"
                raise InputError(Mistake(problem, key=f"effects[{i}]"))


def _ends(parts: list[Contribution], method: integrators.AnyIntegrator, name: str) -> None:
    """Raise InputError if an effect requires stages at the end of the step and the integrator has others."""
    there = [n for n, known in integrators.INTEGRATORS.items() if getattr(known, "when", 0.0) == 1.0 and n != "own"]
    for i, part in enumerate(parts):
        if part.ends and getattr(method, "when", 0.0) != 1.0:
            problem = f"{part.ends[0]}, and {name} has other unknowns; take {' or '.join(there)}"
            raise InputError(Mistake(problem, key=f"effects[{i}]"))


def _doubt(spec: SceneSpec) -> None:
    """Warn about valid but unusual values."""
    if spec.time_step > LONG:
        _LOG.warning("%s: a time step of %g s is long; is it meant in seconds?", spec.path.name, spec.time_step)
    for i, effect in enumerate(spec.effects):
        k = spec.effects.index(effect)
        if k < i:
            _LOG.warning("%s: effects[%d] repeats effects[%d] (%s); both act", spec.path.name, i, k, effect.kind)


def _mass(spec: SceneSpec, mesh: Mesh) -> NDArray[np.float64]:
    if spec.mass is not None and spec.mass_per_area is not None:
        raise InputError(Mistake("is given beside `mass`; leave out one of them", key="mass_per_area"))
    if spec.mass is not None:
        return spec.mass * mesh.shares
    if spec.mass_per_area is not None:
        if mesh.dimension != 2 or not len(mesh.triangles):
            raise InputError(Mistake("needs a surface, and this mesh is none; give `mass`", key="mass_per_area"))
        return spec.mass_per_area * (by_area(mesh.rest, mesh.triangles) if mesh.areas is None else mesh.areas)
    if mesh.mass is None:
        raise InputError(Mistake("is missing; this mesh brings no masses, so give the total [kg]", key="mass"))
    return mesh.mass


def _require_determined(system: System, mesh: Mesh) -> None:
    """Raise InputError if a vertex without mass has an undetermined position."""
    if system.mass.all():
        return
    try:
        assemble(system, [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)])
    except NotPositiveDefinite as error:
        numbers = mesh.in_file(*error.vertices) if error.vertices else ""
        raise InputError(Mistake(f"{error}{numbers}", key="mesh")) from error


def _pins(
    parts: list[Contribution], mesh: Mesh
) -> tuple[Pins, Positions, tuple[tuple[NDArray[np.int64], KeyedMotion], ...]]:
    """Merge all pins by vertex, with targets and motions; duplicates must agree."""
    pins: list[Pin] = [pin for part in parts for pin in part.pins]
    if not pins:
        return Pins(), np.empty((0, 3)), ()
    vertices = np.concatenate([pin.vertices for pin in pins])
    weight = np.concatenate([np.full(len(pin.vertices), pin.weight) for pin in pins])
    targets = np.concatenate([pin.targets for pin in pins])
    unique, first, back = np.unique(vertices, return_index=True, return_inverse=True)
    motions = list(dict.fromkeys(pin.motion for pin in pins))
    motion, owner = (
        np.repeat(of, [len(pin.vertices) for pin in pins])
        for of in ([motions.index(pin.motion) for pin in pins], [i for i, part in enumerate(parts) for _ in part.pins])
    )
    clash = (weight != weight[first][back]) | (targets != targets[first][back]).any(axis=1)
    clash |= motion != motion[first][back]
    if clash.any():
        one, two = owner[first][back][clash][0], owner[clash][0]
        vertex = int(vertices[clash][0])
        raise InputError(
            f"pins: vertex {vertex} is pinned twice, by effects[{one}] and effects[{two}], to different "
            f"places, with different weights or with different motions{mesh.in_file(vertex)}"
        )
    moving = ((np.flatnonzero(motion[first] == k), path) for k, path in enumerate(motions) if path is not None)
    return Pins(unique, weight[first]), targets[first], tuple(moving)

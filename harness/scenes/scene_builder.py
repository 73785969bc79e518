"""Builder of the simulated system of a scene for a mesh size.

The system has only the terms that the scene requires.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes import scene_plugins
from springbench.harness.scenes.effects.effect_interface import (
    ConstantForceField,
    EffectContribution,
    ForceFunction,
    PinGroup,
    SceneEffect,
    VelocityFilter,
)
from springbench.harness.scenes.fabric_table import DENSITY_RANGE, PlausibleRange
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_topology import lump_areas
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.start_positions import MergedStart, RestStart
from springbench.harness.scenes.vertex_selectors import find_selections
from springbench.solvers.model import integrators
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.integrators import IMPLICIT_EULER, find_integrator
from springbench.solvers.model.step_problem import (
    DirichletPins,
    NotPositiveDefinite,
    Positions,
    ProjectiveEnergy,
    System,
)
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

if TYPE_CHECKING:
    from springbench.harness.scenes.edge_triangle_intersections import IntersectionCheck

_LOG = logging.getLogger("springbench")
REST_START = RestStart()
MIN_COARSENING_SIZE = 9
"""Smallest mesh size that is coarsened for nested iteration: below it, a solve costs next to nothing."""
LONG_TIME_STEP = 1.0
"""Time steps [s] above this value cause a warning: most motion ends within a few of them."""


@runtime_checkable
class StatesMaterial(Protocol):
    """An effect that states the material of a cloth."""

    def list_material_values(self, mesh: Mesh, mass: NDArray[np.float64]) -> list[tuple[PlausibleRange, float]]:
        """Return values of the material, each with the range of published fabrics.

        Args:
            mesh: the cloth at rest.
            mass: vertex masses (n,) [kg].

        Returns:
            Ranges and values, in the unit of the range.
        """
        ...


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene, built for one mesh size.

    Attributes:
        mesh: the mesh at rest.
        start: the deviation of the initial state from the rest state.
        system: the data that solvers factorise.
        constant_force: sum of the constant forces, (n, 3) [N], read-only.
        varying_forces: the other external forces.
        velocity_filters: changes of the velocity before a step.
        pin_targets: (q, 3) [m], in the order of `system.pins`.
        pin_motions: rows of the targets that move, with their motion.
        initial_velocity: velocity of every vertex [m/s], without the spin of the start.
        integrator: the time integrator; its factor and velocity rule are those of the system.
        intersection_checks: primitives that must not intersect; empty unless an effect prevents intersections.
        alternate_scene: the same scene with the time step of every second step, if that differs.
        build_coarser: builds the scene on a mesh of half the size, None if there is none.
    """

    mesh: Mesh
    system: System
    constant_force: Positions
    varying_forces: tuple[ForceFunction, ...]
    velocity_filters: tuple[VelocityFilter, ...]
    pin_targets: Positions
    initial_velocity: tuple[float, float, float]
    integrator: integrators.AnyIntegrator = IMPLICIT_EULER
    pin_motions: tuple[tuple[NDArray[np.int64], KeyFrameMotion], ...] = ()
    start: RestStart = REST_START
    intersection_checks: tuple[IntersectionCheck, ...] = ()
    alternate_scene: Scene | None = None
    build_coarser: Callable[[], Scene] | None = None

    @property
    def has_self_contact(self) -> bool:
        """Whether an effect prevents self-intersection of the mesh."""
        return any(one.obstacle_positions is None for one in self.intersection_checks)

    def find_step_scene(self, step_index: int) -> Scene:
        """Return the scene of the step that follows step `step_index`."""
        return self.alternate_scene if self.alternate_scene and step_index % 2 else self

    def compute_time(self, step_index: int) -> float:
        """Return the time [s] at which step `step_index` ends; index 0 is the start."""
        if not self.alternate_scene:
            return step_index * self.system.time_step
        return (step_index + 1) // 2 * self.system.time_step + step_index // 2 * self.alternate_scene.system.time_step

    def compute_pin_targets(self, time: float) -> Positions:
        """Return the pin targets at a time [s], (q, 3) [m]."""
        if not self.pin_motions:
            return self.pin_targets
        targets = self.pin_targets.copy()
        for rows, motion in self.pin_motions:
            targets[rows] = motion.transform_points(self.pin_targets[rows], time)
        return targets

    def compute_pin_velocities(self, time: float) -> Positions:
        """Return the velocities of the pin targets at a time [s], (q, 3) [m/s]."""
        velocity = np.zeros_like(self.pin_targets)
        for rows, motion in self.pin_motions:
            velocity[rows] = motion.compute_velocity(self.pin_targets[rows], time)
        return velocity

    @cached_property
    def all_springs(self) -> Springs:
        """All springs with stiffness, by effect and in mesh order, then springs that only pull.

        Exact length constraints follow, as springs of infinite stiffness.
        """
        exact = [x for x in self.system.length_constraints if (x.min_length == x.max_length).all()]
        return Springs.from_parts(
            [
                *(energy for energy in self.system.energies if isinstance(energy, Springs)),
                *(convert() for energy in self.system.energies if (convert := getattr(energy, "to_springs", None))),
                *(Springs(x.edges, np.full(len(x.min_length), np.inf), x.max_length, x.rest_direction) for x in exact),
            ]
        )


def build_scene(spec: SceneSpec, size: int, integrator: str = "implicit-euler", *, log_warnings: bool = True) -> Scene:
    """Build a scene for a mesh size and an integrator.

    Args:
        spec: the scene.
        size: mesh size, ignored by a mesh from a file.
        integrator: name of the time integrator.
        log_warnings: whether valid but unusual values are logged; False if the program chooses the time step.

    Raises:
        InputError: if the parts of the scene do not fit together.
    """
    spec = spec.load_plugins()
    mesh, method = _build_mesh(spec, size), find_integrator(integrator)
    if spec.fabric is not None and mesh.dimension != 2:
        problem = "is the material of a cloth, and this mesh is none; state `stretch` of the springs and `mass` instead"
        raise InputError(InputMistake(problem, key="fabric"))
    mass = _compute_vertex_masses(spec, mesh)
    parts = [_build_contribution(spec, i, mesh, mass).adapt_to_integrator(method) for i in range(len(spec.effects))]
    _require_unique(spec, parts)
    _require_end_of_step_stages(parts, method, integrator)
    pins, targets, moving = _merge_pins(parts, mesh)
    energies = tuple(energy for part in parts for energy in part.energies)
    energies += tuple(energy for part in parts for derive in part.derived_energies for energy in derive(energies))
    forces = [force for part in parts for force in part.forces]
    lengths = tuple(one for part in parts for one in part.length_constraints)
    load = np.zeros_like(mesh.rest_positions)
    for force in forces:
        if isinstance(force, ConstantForceField):
            load += force.force
    load.flags.writeable = False
    system = System(mass, spec.time_step, energies, pins, method.inertia_factor, method.velocity_factor, lengths)
    _require_determined_positions(system, mesh)
    start = spec.start or REST_START
    _check_start(parts, start.compute_positions(mesh.rest_positions))
    if log_warnings:
        _warn_unusual(spec)
        for problem in find_implausible_materials(spec.effects, mesh, mass):
            _LOG.warning("%s: %s", spec.path.name, problem)
    other = spec.alternate_time_step
    return Scene(
        mesh=mesh,
        system=system,
        constant_force=load,
        varying_forces=tuple(force for force in forces if not isinstance(force, ConstantForceField)),
        velocity_filters=tuple(one for part in parts for one in part.velocity_filters),
        pin_targets=targets,
        initial_velocity=spec.velocity,
        integrator=method,
        pin_motions=moving,
        start=start,
        intersection_checks=tuple(one for part in parts for one in part.intersection_checks),
        alternate_scene=None
        if other in (None, spec.time_step)
        else build_scene(spec.with_time_step(other), size, integrator, log_warnings=log_warnings),
        build_coarser=_make_coarser_builder(spec, size, integrator, log_warnings=log_warnings),
    )


def _make_coarser_builder(
    spec: SceneSpec, size: int, integrator: str, *, log_warnings: bool
) -> Callable[[], Scene] | None:
    """Return a builder of the scene on a mesh of half the size, or None.

    There is none for meshes of fixed size, for the coarsest meshes, and for effects and starts that select vertices by
    index.
    """
    half = (size + 1) // 2
    selections = [selection for effect in spec.effects for _, selection in find_selections(effect)]
    if half < MIN_COARSENING_SIZE or isinstance(spec.start, MergedStart):
        return None
    if any(selection.indices or selection.stride > 1 for selection in selections):
        return None
    return partial(build_scene, spec, half, integrator, log_warnings=log_warnings)


def _build_mesh(spec: SceneSpec, size: int) -> Mesh:
    if "mesh" not in spec.plugins:
        return spec.mesh.build_mesh(size)
    plugin, _ = spec.plugins["mesh"]
    try:
        with scene_plugins.attribute_errors(plugin, "generate_mesh"):
            made: Any = spec.mesh.build_mesh(size)
        return scene_plugins.check_plugin_mesh(plugin, made)
    except InputError as error:
        raise InputError([replace(one, key=one.key or "mesh") for one in error.mistakes]) from error


def _build_contribution(spec: SceneSpec, i: int, mesh: Mesh, mass: NDArray[np.float64]) -> EffectContribution:
    effect, (plugin, _) = spec.effects[i], spec.plugins.get(f"effects[{i}]", (None, None))
    try:
        given = mesh, mass, spec.find_effect_time_step(effect)
        bound = (
            effect.build_contribution(*given)
            if plugin is None
            else scene_plugins.build_checked_contribution(plugin, effect, *given)
        )
    except InputError as error:
        raise InputError([replace(mistake, key=f"effects[{i}]") for mistake in error.mistakes]) from error
    if bound.is_empty:
        _LOG.info("effects[%d] (%s) does nothing with these parameters and is left out", i, spec.effects[i].kind)
    return bound


def _check_start(parts: list[EffectContribution], start: Positions) -> None:
    """Raise InputError if an effect is incompatible with the start (n, 3) [m] or the pins."""
    pins = [pin for part in parts for pin in part.pins]
    for i, part in enumerate(parts):
        try:
            for check in part.scene_checks:
                check(start, pins)
        except InputError as error:
            raise InputError([replace(mistake, key=f"effects[{i}]") for mistake in error.mistakes]) from error


def _require_unique(spec: SceneSpec, parts: list[EffectContribution]) -> None:
    """Raise InputError if two effects provide a feature that a scene can have only once."""
    first: dict[str, int] = {}
    for i, part in enumerate(parts):
        for what in part.exclusive_features:
            if first.setdefault(what, i) != i:
                problem = f"{what} repeats effects[{first[what]}], and the two would add up; remove one"
                raise InputError(InputMistake(problem, key=f"effects[{i}]"))


def _require_end_of_step_stages(parts: list[EffectContribution], method: integrators.AnyIntegrator, name: str) -> None:
    """Raise InputError unless the integrator has the end-of-step stages that an effect requires."""
    there = [
        n
        for n, known in integrators.INTEGRATORS.items()
        if getattr(known, "stage_fraction", 0.0) == 1.0 and n != "substepping"
    ]
    for i, part in enumerate(parts):
        if part.end_of_step_reasons and getattr(method, "stage_fraction", 0.0) != 1.0:
            problem = f"{part.end_of_step_reasons[0]}, and {name} has stages at other times; take {' or '.join(there)}"
            raise InputError(InputMistake(problem, key=f"effects[{i}]"))


def _warn_unusual(spec: SceneSpec) -> None:
    """Warn about valid but unusual values."""
    if spec.time_step > LONG_TIME_STEP:
        _LOG.warning("%s: a time step of %g s is long; is it meant in seconds?", spec.path.name, spec.time_step)
    for i, effect in enumerate(spec.effects):
        k = spec.effects.index(effect)
        if k < i:
            _LOG.warning("%s: effects[%d] repeats effects[%d] (%s); both act", spec.path.name, i, k, effect.kind)


def find_implausible_materials(effects: Sequence[SceneEffect], mesh: Mesh, mass: NDArray[np.float64]) -> Iterator[str]:
    """Find stiffnesses and densities of a cloth that are far from those of published fabrics.

    Args:
        effects: the effects of the scene; those that state a material are checked.
        mesh: the mesh; only cloth is checked.
        mass: vertex masses (n,) [kg].

    Yields:
        Descriptions of the values.
    """
    if mesh.dimension != 2 or not len(mesh.triangles):
        return
    area = lump_areas(mesh.rest_positions, mesh.triangles).sum()
    if problem := DENSITY_RANGE.describe_outlier(float(mass.sum() / area) if area else 0.0):
        yield problem
    for i, effect in enumerate(effects):
        values = effect.list_material_values(mesh, mass) if isinstance(effect, StatesMaterial) else []
        problems = (plausible.describe_outlier(value) for plausible, value in values)
        yield from (f"effects[{i}] ({effect.kind}): {problem}" for problem in problems if problem)


def _compute_vertex_masses(spec: SceneSpec, mesh: Mesh) -> NDArray[np.float64]:
    if spec.mass is not None and spec.mass_per_area is not None:
        raise InputError(InputMistake("cannot be combined with `mass`; leave out one of them", key="mass_per_area"))
    if spec.mass is not None:
        return spec.mass * mesh.mass_fractions
    if spec.mass_per_area is not None:
        if mesh.dimension != 2 or not len(mesh.triangles):
            raise InputError(InputMistake("needs a surface, and this mesh has none; give `mass`", key="mass_per_area"))
        return spec.mass_per_area * (
            lump_areas(mesh.rest_positions, mesh.triangles) if mesh.vertex_areas is None else mesh.vertex_areas
        )
    if mesh.mass is None:
        raise InputError(InputMistake("is missing, and this mesh has no masses; give the total mass [kg]", key="mass"))
    return mesh.mass


def _require_determined_positions(system: System, mesh: Mesh) -> None:
    """Raise InputError if a vertex without mass has an undetermined position."""
    if system.mass.all():
        return
    try:
        assemble_system_matrix(system, [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)])
    except NotPositiveDefinite as error:
        numbers = mesh.format_file_numbers(*error.vertices) if error.vertices else ""
        remedy = "" if mesh.file_numbers is None else "; `unused: drop` of the mesh drops vertices without a face"
        raise InputError(InputMistake(f"{error}{numbers}{remedy}", key="mesh")) from error


def _merge_pins(
    parts: list[EffectContribution], mesh: Mesh
) -> tuple[DirichletPins, Positions, tuple[tuple[NDArray[np.int64], KeyFrameMotion], ...]]:
    """Merge all pins by vertex, with targets and motions; duplicates must agree."""
    pins: list[PinGroup] = [pin for part in parts for pin in part.pins]
    if not pins:
        return DirichletPins(), np.empty((0, 3)), ()
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
            f"places, with different weights or with different motions{mesh.format_file_numbers(vertex)}"
        )
    moving = ((np.flatnonzero(motion[first] == k), path) for k, path in enumerate(motions) if path is not None)
    return DirichletPins(unique, weight[first]), targets[first], tuple(moving)

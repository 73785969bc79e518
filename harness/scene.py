"""A scene bound to a mesh size: what the step formula needs, and nothing that the scene does not call for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from harness.effects.base import Contribution, Force, Pin, Steady, VelocityFilter
from harness.errors import InputError, Mistake
from harness.mesh.base import Mesh
from harness.spec import SceneSpec
from solvers.energies.springs import Springs
from solvers.integrators import IMPLICIT_EULER, INTEGRATORS, Integrator
from solvers.problem import Pins, Positions, System


@dataclass(frozen=True, eq=False)
class Scene:
    """What is simulated.

    mesh: at rest, which is also the start; system: what is factorised; load: the sum of the forces that never
    change, (n, 3) [N], read-only; forces: those that change; filters: of the velocity;
    pin_targets: (q, 3) [m], in the order of `system.pins`; velocity: of every vertex at the start [m/s];
    integrator: its factor is the system's.
    """

    mesh: Mesh
    system: System
    load: Positions
    forces: tuple[Force, ...]
    filters: tuple[VelocityFilter, ...]
    pin_targets: Positions
    velocity: tuple[float, float, float]
    integrator: Integrator = IMPLICIT_EULER

    @cached_property
    def springs(self) -> Springs:
        """All springs that have stiffness: effect by effect, each in the mesh's order."""
        return Springs.joined([energy for energy in self.system.energies if isinstance(energy, Springs)])


def build(spec: SceneSpec, size: int, integrator: str = "implicit-euler") -> Scene:
    """Bind a scene to a mesh of one size, which means nothing to a mesh from a file, and to an integrator by name.

    Raises InputError where the scene's parts do not fit together.
    """
    mesh = spec.mesh.build(size)
    mass = _mass(spec, mesh)
    parts = [_bound(spec, i, mesh, mass) for i in range(len(spec.effects))]
    pins, targets = _pins(parts)
    energies = tuple(energy for part in parts for energy in part.energies)
    forces = [force for part in parts for force in part.forces]
    load = np.zeros_like(mesh.rest)
    for force in forces:
        if isinstance(force, Steady):
            load += force.force
    load.flags.writeable = False
    return Scene(
        mesh=mesh,
        system=System(mass, spec.time_step, energies, pins, INTEGRATORS[integrator].factor),
        load=load,
        forces=tuple(force for force in forces if not isinstance(force, Steady)),
        filters=tuple(one for part in parts for one in part.filters),
        pin_targets=targets,
        velocity=spec.velocity,
        integrator=INTEGRATORS[integrator],
    )


def _bound(spec: SceneSpec, i: int, mesh: Mesh, mass: NDArray[np.float64]) -> Contribution:
    try:
        return spec.effects[i].bind(mesh, mass, spec.time_step)
    except InputError as error:
        raise InputError([replace(mistake, key=f"effects[{i}]") for mistake in error.mistakes]) from error


def _mass(spec: SceneSpec, mesh: Mesh) -> NDArray[np.float64]:
    if spec.mass is not None:
        return spec.mass * mesh.shares
    if mesh.mass is None:
        raise InputError(Mistake("is missing; this mesh brings no masses, so give the total [kg]", key="mass"))
    return mesh.mass


def _pins(parts: list[Contribution]) -> tuple[Pins, Positions]:
    """All pins by vertex; a vertex may be named twice if both times mean the same."""
    pins: list[Pin] = [pin for part in parts for pin in part.pins]
    if not pins:
        return Pins(), np.empty((0, 3))
    vertices = np.concatenate([pin.vertices for pin in pins])
    weight = np.concatenate([np.full(len(pin.vertices), pin.weight) for pin in pins])
    targets = np.concatenate([pin.targets for pin in pins])
    unique, first, back = np.unique(vertices, return_index=True, return_inverse=True)
    clash = (weight != weight[first][back]) | (targets != targets[first][back]).any(axis=1)
    if clash.any():
        vertex = int(vertices[clash][0])
        raise InputError(f"pins: vertex {vertex} is pinned twice, to different places or with different weights")
    return Pins(unique, weight[first]), targets[first]

"""Reference terms of a scene: its declaration and the terms of each effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.scenes.bind import Scene
from harness.scenes.effects.effect_names import EFFECTS
from harness.scenes.mesh.base import Mesh
from harness.scenes.spec import SceneSpec
from harness.simulation.opinion import contact, edges, forces, self_contact, surface_contact, surfaces, vertices
from harness.simulation.opinion.declared import Array, Begin, Declared, Opinion
from harness.simulation.opinion.outside import from_outside, resistance

_OPINIONS: dict[str, Callable[[Any, Declared], Opinion]] = {
    "air-drag": vertices.air_drag,
    "attachments": vertices.attachments,
    "bending": surfaces.bending,
    "constant-force": forces.constant_force,
    "contact": contact.contact,
    "dashpots": edges.dashpots,
    "ether-drag": vertices.ether_drag,
    "gas": surfaces.gas,
    "gravity": forces.gravity,
    "pins": vertices.pins,
    "rayleigh": vertices.rayleigh,
    "self-contact": self_contact.self_contact,
    "sewing": edges.sewing,
    "springs": edges.springs,
    "strain-limits": edges.strain_limits,
    "surface-contact": surface_contact.surface_contact,
    "wind": forces.wind,
}


@dataclass(frozen=True, eq=False)
class Side:
    """A scene with a fixed step size, and its reference terms.

    Attributes:
      declared: declaration of the scene.
      opinions: reference terms of each effect.
      begins: builder of the energy of each effect, None for none.
      owned: indices of the scene's energies that belong to each effect.
      outside: effects without a reference implementation.
    """

    declared: Declared
    opinions: list[Opinion]
    begins: list[Begin | None]
    owned: list[list[int]]
    outside: set[int]

    def name(self, k: int) -> str:
        """Return a description of effect k."""
        return f"effects[{k}] {self.declared.effects[k].kind}"

    def shortest(self, k: int | None = None) -> float:
        """Return the smallest length [m] of effect k, or of springs at rest."""
        lengths = self.declared.mesh.rest_lengths
        springs = float(lengths[lengths > 0.0].min(initial=self.declared.mesh.spacing))
        return springs if k is None else min(springs, self.opinions[k].shortest)


def side(spec: SceneSpec, scene: Scene) -> Side:
    """Build the reference terms of a scene built from the specification."""
    mesh, dt = scene.mesh, spec.time_step
    mass = _mass(spec, mesh)
    declared = Declared(mesh, mass, dt, tuple(spec.effects), not getattr(scene.integrator, "splits", False))
    bound = [effect.bind(mesh, mass, dt).by(scene.integrator) for effect in declared.effects]
    # The order is that of the scene's energies: those of each effect first, then those derived from all of them.
    first = [energy for part in bound for energy in part.energies]
    owners = [k for k, part in enumerate(bound) for _ in part.energies]
    owners += [k for k, part in enumerate(bound) for derive in part.derived for _ in derive(first)]
    owned = [[i for i, owner in enumerate(owners) if owner == k] for k in range(len(bound))]
    outside = {k for k, effect in enumerate(declared.effects) if not _known(effect)}
    if any(owned[k] for k in outside):  # nobody knows what damping by stiffness makes of their energies
        outside |= {k for k, one in enumerate(declared.effects) if one.kind == "rayleigh" and one.stiffness}
    opinions = list[Opinion]()
    resists: Array = mass / dt**2
    for k, (effect, part) in enumerate(zip(declared.effects, bound, strict=True)):
        if k in outside:
            opinions.append(from_outside(part))
            resists = resists + resistance(part.energies, len(mass), dt)
        else:
            opinions.append(Opinion() if part.empty else _OPINIONS[effect.kind](effect, declared))
            if (share := opinions[k].resists) is not None:
                resists = resists + share
    begins = [opinion.needs(resists) if opinion.needs else opinion.begin for opinion in opinions]
    return Side(declared, opinions, begins, owned, outside)


def _mass(spec: SceneSpec, mesh: Mesh) -> Array:
    """Compute the masses (n,) [kg]."""
    if spec.mass_per_area is not None:
        area = sum(float(np.linalg.norm(np.cross(b - a, c - a))) / 2 for a, b, c in mesh.rest[mesh.triangles])
        return spec.mass_per_area * area * mesh.shares
    return np.asarray(mesh.mass if spec.mass is None else spec.mass * mesh.shares)


def _known(effect: Any) -> bool:
    """Return whether an effect is the shipped one of its kind."""
    kind: type = effect.__class__
    return effect.kind in _OPINIONS and EFFECTS.get(effect.kind) == f"{kind.__module__}:{kind.__qualname__}"

"""Reference terms of a scene: its declaration and the terms of each effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec

from tests.oracles import (
    edge_terms,
    force_terms,
    half_space_terms,
    obstacle_terms,
    per_vertex_terms,
    self_contact_terms,
    surface_terms,
)
from tests.oracles.external_effects import build_external_effect, sum_diagonals
from tests.oracles.scene_declaration import Array, BeginFunction, EffectTerms, SceneDeclaration

_EFFECT_BUILDERS: dict[str, Callable[[Any, SceneDeclaration], EffectTerms]] = {
    "air-drag": per_vertex_terms.build_air_drag_terms,
    "attachments": per_vertex_terms.build_attachments_terms,
    "bending": surface_terms.build_bending_terms,
    "constant-force": force_terms.build_constant_force_terms,
    "contact": half_space_terms.build_contact_terms,
    "dashpots": edge_terms.build_dashpots_terms,
    "ether-drag": per_vertex_terms.build_ether_drag_terms,
    "gas": surface_terms.build_gas_terms,
    "gravity": force_terms.build_gravity_terms,
    "pins": per_vertex_terms.build_pins_terms,
    "rayleigh": per_vertex_terms.build_rayleigh_terms,
    "self-contact": self_contact_terms.build_self_contact_terms,
    "sewing": edge_terms.build_sewing_terms,
    "springs": edge_terms.build_springs_terms,
    "strain-limits": edge_terms.build_strain_limits_terms,
    "surface-contact": obstacle_terms.build_surface_contact_terms,
    "wind": force_terms.build_wind_terms,
}


@dataclass(frozen=True, eq=False)
class SceneTerms:
    """A scene with a fixed step size, and its reference terms.

    Attributes:
      declaration: declaration of the scene.
      effect_terms: reference terms of each effect.
      energy_builders: builder of the energy of each effect, None for none.
      energy_indices: indices of the scene's energies that belong to each effect.
      external_effects: effects without a reference implementation.
    """

    declaration: SceneDeclaration
    effect_terms: list[EffectTerms]
    energy_builders: list[BeginFunction | None]
    energy_indices: list[list[int]]
    external_effects: set[int]

    def format_effect_name(self, k: int) -> str:
        """Return a description of effect k."""
        return f"effects[{k}] {self.declaration.effects[k].kind}"

    def min_length(self, k: int | None = None) -> float:
        """Return the smallest length [m] of effect k, or of springs at rest."""
        lengths = self.declaration.mesh.rest_lengths
        springs = float(lengths[lengths > 0.0].min(initial=self.declaration.mesh.spacing))
        return springs if k is None else min(springs, self.effect_terms[k].min_length)


def build_scene_terms(spec: SceneSpec, scene: Scene) -> SceneTerms:
    """Build the reference terms of a scene built from the specification."""
    mesh, dt = scene.mesh, spec.time_step
    mass = _compute_masses(spec, mesh)
    declared = SceneDeclaration(
        mesh, mass, dt, tuple(spec.effects), not getattr(scene.integrator, "has_split_filters", False)
    )
    contributions = [
        effect.build_contribution(mesh, mass, dt).adapt_to_integrator(scene.integrator) for effect in declared.effects
    ]
    # The order is that of the scene's energies: those of each effect first, then those derived from all of them.
    first = [energy for part in contributions for energy in part.energies]
    owners = [k for k, part in enumerate(contributions) for _ in part.energies]
    owners += [k for k, part in enumerate(contributions) for derive in part.derived_energies for _ in derive(first)]
    indices = [[i for i, owner in enumerate(owners) if owner == k] for k in range(len(contributions))]
    external = {k for k, effect in enumerate(declared.effects) if not _is_shipped(effect)}
    if any(indices[k] for k in external):  # damping by stiffness is derived from their energies
        external |= {
            k for k, one in enumerate(declared.effects) if one.kind == "rayleigh" and one.stiffness_coefficient
        }
    effect_terms = list[EffectTerms]()
    resists: Array = mass / dt**2
    for k, (effect, part) in enumerate(zip(declared.effects, contributions, strict=True)):
        if k in external:
            effect_terms.append(build_external_effect(part))
            resists = resists + sum_diagonals(part.energies, len(mass), dt)
        else:
            effect_terms.append(EffectTerms() if part.is_empty else _EFFECT_BUILDERS[effect.kind](effect, declared))
            if (share := effect_terms[k].diagonal) is not None:
                resists = resists + share
    builders = [
        terms.build_from_diagonal(resists) if terms.build_from_diagonal else terms.build_energy
        for terms in effect_terms
    ]
    return SceneTerms(declared, effect_terms, builders, indices, external)


def _compute_masses(spec: SceneSpec, mesh: Mesh) -> Array:
    """Compute the masses (n,) [kg]."""
    if spec.mass_per_area is not None:
        area = sum(float(np.linalg.norm(np.cross(b - a, c - a))) / 2 for a, b, c in mesh.rest_positions[mesh.triangles])
        return spec.mass_per_area * area * mesh.mass_fractions
    return np.asarray(mesh.mass if spec.mass is None else spec.mass * mesh.mass_fractions)


def _is_shipped(effect: Any) -> bool:
    """Return whether an effect is the shipped one of its kind."""
    kind: type = effect.__class__
    return (
        effect.kind in _EFFECT_BUILDERS and EFFECT_CLASSES.get(effect.kind) == f"{kind.__module__}:{kind.__qualname__}"
    )

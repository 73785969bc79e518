"""Supports of a mesh in a scene: pinned and attached vertices, and sewn seams."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from springbench.harness.scenes.effects.springs_effect import SpringsEffect, StretchConstant
from springbench.harness.scenes.membrane_modulus import compute_membrane_modulus
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_checks import NO_VERTICES, MeshSupport
from springbench.harness.scenes.mesh.mesh_report import find_mesh_remarks, format_finding
from springbench.harness.scenes.mesh.mesh_topology import NO_PAIRS
from springbench.harness.scenes.orthotropic_cloth import OrthotropicStiffness
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.vertex_selectors import find_selections
from springbench.solvers.model.energies.spring_energy import Springs

_SUPPORTING_EFFECTS = ("pins", "attachments")
_JOINING_EFFECTS = ("sewing",)
_OTHER_EFFECTS = ("springs", "gravity", "constant-force", "wind", "air-drag", "ether-drag", "dashpots", "rayleigh",
                  "bending", "strain-limits", "gas", "self-contact")  # fmt: skip
"""Effects that neither support nor join anything; an obstacle or user code may."""
_MAX_MODULUS_VERTICES = 50_000
"""Number of vertices above which the modulus is not computed: its factorisation would delay the start by seconds."""
_LOG = logging.getLogger("springbench")


def find_mesh_support(scene: SceneSpec, mesh: Mesh) -> MeshSupport | None:
    """Find the supports of the mesh of a scene.

    Args:
        scene: scene whose effects pin, attach or sew vertices.
        mesh: mesh on which the effects select their vertices.

    Returns:
        The supports; None if there are obstacles or user code, which may support the mesh as well.

    Raises:
        InputError: an effect selects vertices that the mesh does not have.
    """
    supported, joined = [NO_VERTICES], [NO_PAIRS]
    for k, effect in enumerate(scene.effects):
        if effect.kind not in (*_SUPPORTING_EFFECTS, *_JOINING_EFFECTS, *_OTHER_EFFECTS):
            return None
        chosen = [one.select_vertices(mesh, f"effects[{k}]") for _, one in find_selections(effect)]
        if effect.kind in _SUPPORTING_EFFECTS:
            supported += chosen
        elif effect.kind in _JOINING_EFFECTS:
            every = np.concatenate([NO_VERTICES, *chosen])
            joined.append(np.column_stack([every[:-1], every[1:]]))
    return MeshSupport(np.unique(np.concatenate(supported)), np.concatenate(joined))


def log_mesh_remarks(scene: SceneSpec, mesh: Mesh) -> None:
    """Log suspicious findings and the membrane stiffness of a mesh from a file.

    Args:
        scene: scene that names the file; nothing is logged for generated meshes.
        mesh: mesh of that file.
    """
    if not isinstance(scene.mesh, FileMesh):
        return
    path: Path = scene.mesh.find_geometry_path()
    found = [one for one in find_mesh_remarks(mesh, find_mesh_support(scene, mesh)) if one.is_suspicious]
    for one in found:
        _LOG.warning("%s: %s", path, format_finding(one, mesh))
    for line in describe_membranes(scene, mesh):
        _LOG.info("%s: %s", path, line)
    if found:
        _LOG.warning("`springbench mesh %s` checks it and marks the places in a picture", scene.path)


def describe_membranes(scene: SceneSpec, mesh: Mesh) -> list[str]:
    """Describe the membrane stiffness of a scene's springs, one line for each effect.

    Args:
        scene: scene with the springs effects and the time step.
        mesh: mesh on which the springs act.

    Returns:
        The lines; none unless the mesh is a surface of at most `_MAX_MODULUS_VERTICES` vertices.
    """
    if mesh.dimension != 2 or len(mesh.rest_positions) > _MAX_MODULUS_VERTICES:
        return []
    lines = list[str]()
    for k, effect in enumerate(scene.effects):
        if not isinstance(effect, SpringsEffect) or (stated := _describe_stretch(effect.find_stretch(mesh))) is None:
            continue
        energies = effect.build_contribution(mesh, np.ones(len(mesh.rest_positions)), scene.time_step).energies
        springs = Springs.from_parts([energy for energy in energies if isinstance(energy, Springs)])
        if len(springs.edges):
            words = compute_membrane_modulus(mesh, springs.edges, springs.stiffness).describe_modulus()
            lines.append(f"effects[{k}] (springs, {effect.scaling_rule}){stated}: {words}")
    return lines


def _describe_stretch(stretch: StretchConstant | None) -> str | None:
    """Describe the stiffness that an effect states along the lines; None for exact lengths.

    Exact lengths have no modulus.
    """
    if stretch == "exact":
        return None
    if isinstance(stretch, OrthotropicStiffness):
        return f" states {stretch.warp:g}, {stretch.weft:g} and {stretch.bias:g} N/m along warp, weft and bias"
    return "" if stretch is None else f" states {stretch:g} N/m"

"""What holds a mesh in a scene: pinned and attached vertices, and seams that effects sew."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_checks import NO_VERTICES, MeshSupport
from springbench.harness.scenes.mesh.mesh_report import find_mesh_remarks, format_finding
from springbench.harness.scenes.mesh.mesh_topology import NO_PAIRS
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.vertex_selectors import find_selections

_HOLDING_EFFECTS = ("pins", "attachments")
_JOINING_EFFECTS = ("sewing",)
_OTHER_EFFECTS = ("springs", "gravity", "constant-force", "wind", "air-drag", "ether-drag", "dashpots", "rayleigh",
                  "bending", "strain-limits", "gas", "self-contact")  # fmt: skip
"""Effects that neither hold nor join anything; an obstacle or user code may."""
_LOG = logging.getLogger("springbench")


def find_mesh_support(scene: SceneSpec, mesh: Mesh) -> MeshSupport | None:
    """Find what holds the mesh of a scene; None if obstacles or user code may do so."""
    held, joined = [NO_VERTICES], [NO_PAIRS]
    for k, effect in enumerate(scene.effects):
        if effect.kind not in (*_HOLDING_EFFECTS, *_JOINING_EFFECTS, *_OTHER_EFFECTS):
            return None
        chosen = [one.select_vertices(mesh, f"effects[{k}]") for _, one in find_selections(effect)]
        if effect.kind in _HOLDING_EFFECTS:
            held += chosen
        elif effect.kind in _JOINING_EFFECTS:
            every = np.concatenate([NO_VERTICES, *chosen])
            joined.append(np.column_stack([every[:-1], every[1:]]))
    return MeshSupport(np.unique(np.concatenate(held)), np.concatenate(joined))


def log_mesh_remarks(scene: SceneSpec, mesh: Mesh) -> None:
    """Log what is suspicious in the mesh of a scene if it comes from a file, each finding in one line."""
    if not isinstance(scene.mesh, FileMesh):
        return
    path: Path = scene.mesh.find_geometry_path()
    found = [one for one in find_mesh_remarks(mesh, find_mesh_support(scene, mesh)) if one.is_suspicious]
    for one in found:
        _LOG.warning("%s: %s", path, format_finding(one, mesh))
    if found:
        _LOG.warning("`springbench mesh %s` checks it and marks the places in a picture", scene.path)

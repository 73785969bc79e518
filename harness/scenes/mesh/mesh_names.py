"""Table of the mesh types as `module:Class`; a run imports only the type that it uses."""

from solvers.plugins import PluginTable

MESH_CLASSES: dict[str, str] = {
    "chain": "harness.scenes.mesh.chain:Chain",
    "rope": "harness.scenes.mesh.chain:Rope",
    "grid": "harness.scenes.mesh.grid:Grid",
    "stack": "harness.scenes.mesh.stack:Stack",
    "net": "harness.scenes.mesh.grid:Net",
    "skirt": "harness.scenes.mesh.surfaces:Skirt",
    "balloon": "harness.scenes.mesh.surfaces:Balloon",
    "tower": "harness.scenes.mesh.solids:Tower",
    "body": "harness.scenes.mesh.body:Body",
    "block": "harness.scenes.mesh.solids:Block",
    "star": "harness.scenes.mesh.star:Star",
    "network": "harness.scenes.mesh.network:Network",
    "file": "harness.scenes.mesh.files:File",
}

MESH_TABLE = PluginTable("springbench.meshes", MESH_CLASSES)
"""All mesh types by name."""

"""Table of the mesh types as `module:Class`.

A run imports only the type that it uses.
"""

from springbench.solvers.plugins.plugin_discovery import PluginTable

MESH_CLASSES: dict[str, str] = {
    "chain": "springbench.harness.scenes.mesh.chain_mesh:ChainMesh",
    "rope": "springbench.harness.scenes.mesh.chain_mesh:RopeMesh",
    "grid": "springbench.harness.scenes.mesh.grid_mesh:GridMesh",
    "stack": "springbench.harness.scenes.mesh.stack_mesh:StackMesh",
    "net": "springbench.harness.scenes.mesh.grid_mesh:NetMesh",
    "skirt": "springbench.harness.scenes.mesh.surface_meshes:SkirtMesh",
    "balloon": "springbench.harness.scenes.mesh.surface_meshes:BalloonMesh",
    "tower": "springbench.harness.scenes.mesh.solid_meshes:TowerMesh",
    "body": "springbench.harness.scenes.mesh.body_mesh:BodyMesh",
    "block": "springbench.harness.scenes.mesh.solid_meshes:BlockMesh",
    "star": "springbench.harness.scenes.mesh.star_mesh:StarMesh",
    "network": "springbench.harness.scenes.mesh.network_mesh:NetworkMesh",
    "file": "springbench.harness.scenes.mesh.file_mesh:FileMesh",
}

MESH_TABLE = PluginTable("springbench.meshes", MESH_CLASSES)
"""All mesh types by name."""

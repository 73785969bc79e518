"""The kinds of mesh that a scene may name, as `module:Class`, so that a run imports the one it uses."""

MESHES: dict[str, str] = {
    "chain": "harness.mesh.chain:Chain",
    "grid": "harness.mesh.grid:Grid",
    "net": "harness.mesh.grid:Net",
    "skirt": "harness.mesh.surfaces:Skirt",
    "balloon": "harness.mesh.surfaces:Balloon",
    "tower": "harness.mesh.solids:Tower",
    "block": "harness.mesh.solids:Block",
    "star": "harness.mesh.star:Star",
    "network": "harness.mesh.network:Network",
    "file": "harness.mesh.files:File",
}

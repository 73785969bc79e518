"""A mesh of one's own, a wheel: a hub, a rim, and spokes. In a scene:

mesh: {kind: "./own_mesh.py:Wheel", radius: 0.5}
"""

from typing import ClassVar, Literal

import numpy as np
import springbench
from springbench import SHEAR, STRETCH, LengthMetres, Mesh, MeshGenerator, assemble_mesh


class Wheel(MeshGenerator):
    """The hub, vertex 0, and `size` vertices around it; the rim is of stretch springs, the spokes of shear springs."""

    kind: Literal["wheel"] = "wheel"
    radius: LengthMetres = 1.0
    MIN_SIZE: ClassVar[int] = 3
    SIZE_MEANING: ClassVar[str] = "vertices of the rim"
    SPRINGS_PER_VERTEX: ClassVar[int] = 2

    def count_vertices(self, size: int) -> int:
        return size + 1

    def generate_mesh(self, size: int) -> Mesh:
        angle, i = 2.0 * np.pi * np.arange(size) / size, np.arange(1, size + 1)
        rest = np.zeros((size + 1, 3))
        rest[1:, :2] = self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        springs = {STRETCH: np.stack([i, np.roll(i, -1)], axis=1), SHEAR: np.stack([0 * i, i], axis=1)}
        return assemble_mesh(rest_positions=rest, springs=springs, resolution=size, parts={"hub": [0]})


if __name__ == "__main__":
    springs = {"kind": "springs", "stretch": 500.0, "shear": 500.0}
    effects = [springs, {"kind": "gravity"}, {"kind": "pins", "parts": ["hub"]}]
    scene = springbench.make_scene(mesh=Wheel(radius=0.5), effects=effects, mass=1.0, time_step=0.02, frames=20)
    print(f"the rim sinks to {springbench.Simulation(scene, size=12).run_steps(20)[:, :, 1].min():.3f} m")

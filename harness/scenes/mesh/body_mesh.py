"""A dress form with a head, on which garments hang."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from springbench.harness.scenes.mesh.mesh import SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import LengthMetres, MeshGenerator, count_cells
from springbench.harness.scenes.mesh.mesh_topology import (
    PointArray,
    assemble_mesh,
    build_capped_triangles,
    build_offset_pairs,
    lump_areas,
)

_HORIZONTAL_OUTLINE = np.array(
    [
        (1.0, 0.0, 0.0),
        (0.985, 0.041, 0.052),
        (0.95, 0.064, 0.083),
        (0.89, 0.083, 0.108),
        (0.82, 0.078, 0.092),
        (0.775, 0.058, 0.06),
        (0.73, 0.056, 0.058),
        (0.695, 0.07, 0.066),
        (0.675, 0.12, 0.078),
        (0.65, 0.18, 0.094),
        (0.61, 0.212, 0.112),
        (0.52, 0.196, 0.136),
        (0.42, 0.165, 0.12),
        (0.34, 0.148, 0.106),
        (0.22, 0.186, 0.132),
        (0.1, 0.205, 0.142),
        (0.03, 0.19, 0.128),
        (0.0, 0.16, 0.105),
        (0.0, 0.0, 0.0),
    ]
)
"""Height, half width and half depth from the crown down, relative to the height of the form."""


class BodyMesh(MeshGenerator):
    """A closed surface that stands on y = 0: head, neck, shoulders, waist and hips.

    The front faces +z. `size` vertices around, ring by ring from the crown, which is one vertex, down to the last one,
    in the middle of the base. Cells are about square at the waist. Springs: along rings and down (STRETCH), then the
    diagonals down forwards and down backwards (SHEAR). Triangles face outwards. Parts: crown, base (one vertex each).
    Mass is proportional to area. Dimension 2.
    """

    kind: Literal["body"] = "body"
    height: LengthMetres = 0.9
    """Height from the base to the crown [m]."""

    MIN_SIZE: ClassVar[int] = 4
    SIZE_MEANING: ClassVar[str] = "vertices around"
    SPRINGS_PER_VERTEX: ClassVar[int] = 4

    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return size * (_count_rows(size) - 1) + 2

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        along: PointArray = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(_HORIZONTAL_OUTLINE, axis=0), axis=1))]
        )
        places: PointArray = np.linspace(0.0, float(along[-1]), _count_rows(size) + 1)
        y, across, deep = (self.height * _interpolate_rows(places, along, column) for column in _HORIZONTAL_OUTLINE.T)
        inner = np.arange(1, len(places) - 1)
        angle = np.linspace(0, 2 * np.pi, size, endpoint=False)
        x, z = np.outer(across[inner], np.cos(angle)), -np.outer(deep[inner], np.sin(angle))
        rings = np.stack([x, np.broadcast_to(y[inner, None], x.shape), z], axis=2).reshape(-1, 3)
        rest = np.concatenate([[[0.0, y[0], 0.0]], rings, [[0.0, y[-1], 0.0]]])
        index = 1 + np.arange(len(rings)).reshape(-1, size)
        closed, first, last = np.column_stack([index, index[:, 0]]), 0, len(rest) - 1
        triangles = build_capped_triangles(closed, first, last)
        down = [triangles[:size, :2], build_offset_pairs(index, (1, 0)), triangles[-size:, [2, 0]]]
        return assemble_mesh(
            rest_positions=rest,
            springs={
                STRETCH: np.concatenate([build_offset_pairs(closed, (0, 1)), *down]),
                SHEAR: build_offset_pairs(closed, (1, 1), (1, -1)),
            },
            triangles=triangles,
            vertex_weights=lump_areas(rest, triangles),
            dimension=2,
            resolution=size,
            parts={"crown": [first], "base": [last]},
        )


def _interpolate_rows(places: PointArray, along: PointArray, values: PointArray) -> PointArray:
    return np.asarray(np.interp(places, along, values), np.float64)


def _count_rows(size: int) -> int:
    """Return the number of cells from crown to base along the outline."""
    length = float(np.linalg.norm(np.diff(_HORIZONTAL_OUTLINE, axis=0), axis=1).sum())
    # 0.127 is the mean of half width and half depth at the waist, where cells are about square.
    return max(8, count_cells(length, 2 * np.pi * 0.127 / size))

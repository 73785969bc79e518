"""A mesh: rest positions, triangles, and springs by family."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

STRETCH = "stretch"
"""Family of springs along the lines of a mesh."""
SHEAR = "shear"
"""Family of springs across the cells of a mesh."""
BEND = "bend"
"""Family of springs from a vertex to the next but one."""


@dataclass(frozen=True, slots=True, eq=False)
class SpringProperties:
    """Properties of springs that the mesh defines.

    Attributes:
        stiffness: (m,) [N/m], NaN for springs whose stiffness an effect determines.
        rest_length: (m,) [m].
        only_pulls: (m,), springs without any force while they are shorter than their rest length.

    Example:
        >>> import numpy as np
        >>> cable = springbench.SpringProperties(
        ...     stiffness=np.array([500.0]), rest_length=np.array([0.98]), only_pulls=np.array([True])
        ... )
        >>> cable.rest_length.tolist()
        [0.98]
    """

    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    only_pulls: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A spring network at rest. All arrays are read-only.

    Attributes:
        rest_positions: (n, 3) [m], also the initial positions.
        springs: (m, 2), vertex indices, in a fixed order.
        spring_families: STRETCH, SHEAR and BEND -> indices of their springs, a partition of range(m).
        triangles: (f, 3), vertices of the surface; empty if there is none.
        mass_fractions: (n,), share of the total mass of each vertex, sums to 1.
        dimension: 1 chain and truss, 2 cloth, 3 solid.
        spacing: typical rest length h [m].
        resolution: mesh size, usually vertices per side; 0 for a mesh from a file.
        parts: named sets of vertices (`corners`, `top`, `left`, ...), each (q,), sorted.
        mass: (n,) [kg] if a file gives absolute masses, else None.
        attributes: vertex attributes from a file, each (n,).
        vertex_areas: (n,) [m^2] at rest if they are not thirds of the triangles, else None.
        spring_areas: area [m^2] that each spring represents, (m,), volume [m^3] in solids; None if unknown.
        file_numbers: number of each vertex in the mesh's file, (n,); None if there is none.
        spring_properties: stiffness, rest lengths and kinds of the springs if the mesh states them, else None.

    Example:
        >>> import numpy as np
        >>> mesh = springbench.assemble_mesh(
        ...     rest_positions=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]]),
        ...     springs={"stretch": np.array([[0, 1], [1, 2]])},
        ...     parts={"start": [0]},
        ... )

        >>> mesh.rest_lengths.tolist(), mesh.parts["start"].tolist()
        ([1.0, 2.0], [0])
    """

    rest_positions: NDArray[np.float64]
    springs: NDArray[np.int64]
    spring_families: Mapping[str, NDArray[np.int64]]
    triangles: NDArray[np.int64]
    mass_fractions: NDArray[np.float64]
    dimension: int
    spacing: float
    resolution: int = 0
    parts: Mapping[str, NDArray[np.int64]] = field(default_factory=dict[str, NDArray[np.int64]])
    mass: NDArray[np.float64] | None = None
    attributes: Mapping[str, NDArray[np.float64]] = field(default_factory=dict[str, NDArray[np.float64]])
    vertex_areas: NDArray[np.float64] | None = None
    spring_areas: NDArray[np.float64] | None = None
    file_numbers: NDArray[np.int64] | None = None
    spring_properties: SpringProperties | None = None

    def __post_init__(self) -> None:
        arrays = [self.rest_positions, self.springs, self.triangles, self.mass_fractions]
        arrays += [self.mass, self.vertex_areas, self.spring_areas, self.file_numbers]
        if own := self.spring_properties:
            arrays += [own.stiffness, own.rest_length, own.only_pulls]
        for array in [*arrays, *self.spring_families.values(), *self.parts.values(), *self.attributes.values()]:
            if array is not None:
                array.flags.writeable = False

    @property
    def bounding_box_diagonal(self) -> float:
        """Diagonal of the bounding box of the rest shape [m]."""
        return float(np.linalg.norm(np.ptp(self.rest_positions, axis=0))) if len(self.rest_positions) else 0.0

    @property
    def surface_area(self) -> float:
        """Area of the triangles at rest [m^2]."""
        a, b, c = (self.rest_positions[self.triangles[:, k]] for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    def format_file_numbers(self, *vertices: int) -> str:
        """Format the file numbers of zero-based vertices for a message; empty if they are equal."""
        if self.file_numbers is None or (numbers := self.file_numbers[list(vertices)].tolist()) == list(vertices):
            return ""
        return f" ({', '.join(map(str, numbers))} in the file)"

    @property
    def rest_lengths(self) -> NDArray[np.float64]:
        """Rest length of each spring [m], shape (m,)."""
        if self.spring_properties is not None:
            return self.spring_properties.rest_length
        return self.spring_distances

    @property
    def spring_distances(self) -> NDArray[np.float64]:
        """Distance of the ends of each spring at rest [m], shape (m,)."""
        i, j = self.springs.T
        return np.linalg.norm(self.rest_positions[i] - self.rest_positions[j], axis=1)


def sort_unique_vertices(vertices: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Return vertices in ascending order, each once.

    `np.unique` would import `numpy.ma`, which takes a tenth of the time of the command `list`.

    Args:
        vertices: vertex indices below n, in any order.
        n: number of vertices of the mesh.
    """
    there = np.zeros(n, np.bool_)
    there[vertices] = True
    return np.flatnonzero(there)

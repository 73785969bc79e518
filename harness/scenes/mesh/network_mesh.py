"""A spring network: vertices, springs and masses listed in the scene or in tables."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, NonNegativeInt, ValidationInfo, field_validator, model_validator
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import MAX_VERTICES
from springbench.harness.scenes.mesh.mesh_topology import NO_TRIANGLES, find_box_parts
from springbench.harness.scenes.mesh.spring_network import MAX_COORDINATE
from springbench.harness.scenes.mesh.spring_values import SpringValueKeys, read_vertex_pairs, spread_columns
from springbench.harness.scenes.mesh.table_reader import DataTable, read_data_table

CoordinateValue = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
VertexPairs = tuple[tuple[NonNegativeInt, NonNegativeInt], ...]


class NetworkMesh(SpringValueKeys):
    """Vertices, and springs between pairs of them; multiple springs per pair are allowed. Dimension 1.

    Parts: the sides of its bounding box, if it has a vertex table. Attributes: the other columns of that table.
    """

    kind: Literal["network"] = "network"
    positions: tuple[tuple[CoordinateValue, CoordinateValue, CoordinateValue], ...] = Field(default=(), min_length=1)
    """Rest position of each vertex [m]."""
    vertex_table: Path | None = None
    """CSV or Parquet table of the vertices instead of `positions`: columns `x`, `y`, `z` [m], and `mass` [kg] if there
    is one; the other columns of numbers are attributes, by which effects select vertices."""
    springs: VertexPairs = ()
    """Springs along the lines (stretch), as pairs of zero-based vertices."""
    spring_table: Path | None = None
    """CSV or Parquet table of the springs instead of `springs`: columns `i` and `j`, zero-based vertices, and values of
    springs."""
    shear: VertexPairs = ()
    """Springs across cells."""
    bend: VertexPairs = ()
    """Springs from a vertex to the next but one."""
    mass: tuple[NonNegativeFloat, ...] | None = None
    """Mass of each vertex [kg]; by default equal shares of the scene's mass."""

    @field_validator("springs", "shear", "bend")
    @classmethod
    def _check_pairs(cls, pairs: VertexPairs, info: ValidationInfo) -> VertexPairs:
        n = len(info.data.get("positions", ())) or np.inf  # invalid positions are reported separately
        for k, (i, j) in enumerate(pairs):
            if i == j:
                raise ValueError(f"spring {k} joins the vertex {i} to itself; remove it or name another vertex")
            if max(i, j) >= n:
                raise ValueError(f"spring {k} names the vertex {max(i, j)}; the vertices are 0 to {n - 1}")
        return pairs

    @field_validator("mass")
    @classmethod
    def _check_mass_count(cls, mass: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        n = len(info.data.get("positions", ()))
        if mass is not None and n and len(mass) != n:
            raise ValueError(f"has {len(mass)} masses for {n} vertices; give each vertex one")
        if mass is not None and not any(mass):
            raise ValueError("is zero at every vertex; give some vertex a mass")
        return mass

    @model_validator(mode="after")
    def _check_sources(self) -> NetworkMesh:
        if bool(self.positions) == (self.vertex_table is not None):
            raise ValueError("needs either `positions` or a `vertex_table`")
        if self.springs and self.spring_table is not None:
            raise ValueError("has `springs` and a `spring_table`; leave out one of them")
        return self

    def build_mesh(self, size: int = 0) -> Mesh:
        """Build the network, ignoring the size.

        Raises:
            InputError: for tables that are malformed or do not fit, and for values of springs that contradict.
        """
        rest, mass, attributes = self._read_vertices()
        along, columns = _to_pairs(self.springs), dict[str, NDArray[np.float64]]()
        if self.spring_table is not None:
            table = read_data_table(self.spring_table)
            along, columns = read_vertex_pairs(table, len(rest)), table.find_numeric_columns()
        families = {STRETCH: along, SHEAR: _to_pairs(self.shear), BEND: _to_pairs(self.bend)}
        springs = np.concatenate(list(families.values()))
        if springs.max(initial=-1) >= len(rest):
            problem = f"names the vertex {springs.max()}; the vertices are 0 to {len(rest) - 1}"
            raise InputError(InputMistake(problem, key="mesh.springs"))
        ends: list[int] = np.cumsum([0, *map(len, families.values())]).tolist()
        i, j = springs.T
        distances = np.linalg.norm(rest[i] - rest[j], axis=1)
        properties = self.build_spring_properties(
            distances, spread_columns(columns, np.arange(len(along)), len(springs))
        )
        return Mesh(
            rest_positions=rest,
            springs=springs,
            spring_families={name: np.arange(a, b) for name, (a, b) in zip(families, pairwise(ends), strict=True)},
            triangles=NO_TRIANGLES,
            mass_fractions=np.full(len(rest), 1.0 / len(rest)) if mass is None else mass / mass.sum(),
            dimension=1,
            spacing=float(np.median(distances[distances > 0.0])) if distances.any() else 1.0,
            parts=find_box_parts(rest) if self.vertex_table is not None else {},
            mass=mass,
            attributes=attributes,
            spring_properties=properties,
        )

    def _read_vertices(self) -> tuple[NDArray[np.float64], NDArray[np.float64] | None, dict[str, NDArray[np.float64]]]:
        """Return the rest positions (n, 3) [m], the masses (n,) [kg] or None, and the attributes of the vertices."""
        mass = None if self.mass is None else np.array(self.mass, float)
        if self.vertex_table is None:
            return np.array(self.positions, float), mass, {}
        table = read_data_table(self.vertex_table)
        if table.num_rows > MAX_VERTICES:
            raise InputError(InputMistake(f"has {table.num_rows:,} vertices of at most {MAX_VERTICES:,}", table.path))
        rest = np.column_stack([_require_all(table, axis) for axis in "xyz"])
        if (far := (np.abs(rest) > MAX_COORDINATE).any(axis=1)).any():
            raise table.make_error(f"a coordinate is beyond {MAX_COORDINATE:g} m", int(far.argmax()))
        columns = table.find_numeric_columns()
        if "mass" in columns and mass is None:
            mass = _require_all(table, "mass")
            if (wrong := mass < 0.0).any() or not mass.any():
                raise table.make_error("mass should not be negative, nor zero at every vertex", int(wrong.argmax()))
        if mass is not None and len(mass) != len(rest):
            problem = f"has {len(mass)} masses for {len(rest)} vertices; give each vertex one"
            raise InputError(InputMistake(problem, key="mesh.mass"))
        others = {name: values for name, values in columns.items() if name not in ("x", "y", "z", "mass")}
        return rest, mass, others


def _to_pairs(pairs: VertexPairs) -> NDArray[np.int64]:
    return np.array(pairs, np.int64).reshape(-1, 2)


def _require_all(table: DataTable, name: str) -> NDArray[np.float64]:
    """Return a column; raise InputError if a cell of it is empty."""
    values = table.require_column(name)
    if np.isnan(values).any():
        raise table.make_error(f"{name} is empty; give each vertex one", int(np.isnan(values).argmax()))
    return values

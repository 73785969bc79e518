"""Base class of mesh generators, which build meshes of any size from physical parameters."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_right
from typing import Annotated, ClassVar

from pydantic import Field
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.linalg import memory

MAX_VERTICES = 5_000_000
"""Maximum number of vertices: positions, springs and a factor of that size fill the memory of a workstation."""

_BYTES_PER_VERTEX, _BYTES_PER_SPRING = 150, 240
"""Memory per vertex and per spring [bytes], an upper bound while mesh, springs and Q are built: chains took 380 bytes a
vertex, sheets 1090, solids 2740. A solver's data is estimated later, when Q is available."""

LengthMetres = Annotated[float, Field(ge=1e-6, le=1e6)]
"""A length [m] from 1e-6 to 1e6."""


class MeshGenerator(ConfigModel):
    """Parameters of a family of meshes that differ only in their size.

    Example:
        >>> import numpy as np
        >>> class Line(springbench.MeshGenerator):
        ...     kind: str = "line"
        ...     SIZE_MEANING, SPRINGS_PER_VERTEX = "vertices", 1
        ...     def count_vertices(self, size):
        ...         return size
        ...     def generate_mesh(self, size):
        ...         i, rest = np.arange(size), np.zeros((size, 3))
        ...         rest[:, 0] = i
        ...         springs = {"stretch": np.stack([i[:-1], i[1:]], axis=1)}
        ...         return springbench.assemble_mesh(rest_positions=rest, springs=springs, resolution=size)
        >>> Line().build_mesh(4).springs.tolist()
        [[0, 1], [1, 2], [2, 3]]
    """

    MIN_SIZE: ClassVar[int] = 2
    """Smallest valid size."""
    SIZE_MEANING: ClassVar[str]
    """Meaning of the size, for messages."""
    SPRINGS_PER_VERTEX: ClassVar[int]
    """Number of springs per vertex in the interior of a large mesh."""

    def build_mesh(self, size: int) -> Mesh:
        """Build the mesh of a size; raise InputError as `check_size` does, before any allocation."""
        self.check_size(size)
        return self.generate_mesh(size)

    def check_size(self, size: int) -> None:
        """Raise InputError for a size outside the limits of the generator, `MAX_VERTICES` and the memory."""
        if size < self.MIN_SIZE:
            raise self._make_size_error(size, "is too small")
        if excess := self.describe_excess(size):
            raise self._make_size_error(size, excess)

    def describe_excess(self, size: int) -> str:
        """Describe why a size is too large; empty if it is not."""
        if size > MAX_VERTICES:
            return "is too large"
        if (vertices := self.count_vertices(size)) <= self._max_vertices:
            return ""
        needs, has = (
            memory.format_bytes(vertices * self._vertex_bytes),
            memory.format_bytes(memory.compute_memory_limit()),
        )
        return (
            f"would give {vertices:,} vertices of at most {self._max_vertices:,}; "
            "with their springs and Q they would take "
            f"about {needs} of memory, where {has} may be taken"
        )

    @property
    def _vertex_bytes(self) -> int:
        """Memory per vertex with its springs [bytes]."""
        return _BYTES_PER_VERTEX + _BYTES_PER_SPRING * self.SPRINGS_PER_VERTEX

    @property
    def _max_vertices(self) -> int:
        """Maximum number of vertices on this machine."""
        return min(MAX_VERTICES, int(memory.compute_memory_limit() // self._vertex_bytes))

    @abstractmethod
    def count_vertices(self, size: int) -> int:
        """Return the number of vertices of a mesh; nondecreasing in its size.

        Args:
            size: from MIN_SIZE to MAX_VERTICES.
        """

    @abstractmethod
    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""

    def _make_size_error(self, size: int, why: str) -> InputError:
        largest = (
            self.MIN_SIZE
            - 1
            + bisect_right(range(self.MIN_SIZE, MAX_VERTICES + 1), self._max_vertices, key=self.count_vertices)
        )
        allowed = f"{self.MIN_SIZE} to {largest}" if largest >= self.MIN_SIZE else "none with these proportions"
        kind = getattr(self, "kind", type(self).__name__)
        return InputError(
            InputMistake(f"{size} {why}; allowed for {kind}: {allowed} ({self.SIZE_MEANING})", key="size")
        )


def count_cells(length: float, spacing: float) -> int:
    """Return the number of cells that divide a length, at least one.

    Args:
        length: length [m] that is divided.
        spacing: approximate length of a cell [m], positive.
    """
    return max(1, round(length / spacing))

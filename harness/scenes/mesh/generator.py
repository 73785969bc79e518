"""Base class of the mesh generators: physical parameters, from which meshes of any size are built."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_right
from typing import Annotated, ClassVar

from pydantic import Field

from harness.base.errors import InputError, Mistake
from harness.base.model import Model
from harness.scenes.mesh.base import Mesh
from solvers import memory

MAX_VERTICES = 5_000_000
"""Maximum number of vertices: positions, springs and a factor of that size fill the memory of a workstation."""

_BYTES, _BYTES_PER_SPRING = 150, 240
"""Memory per vertex and per spring [bytes], an upper bound while mesh, springs and Q are built: chains took 380 bytes a
vertex, sheets 1090, solids 2740. A solver's data is estimated later, when Q is available."""

Metres = Annotated[float, Field(ge=1e-6, le=1e6)]
"""A length [m] from 1e-6 to 1e6."""


class Generator(Model):
    """Parameters of a family of meshes that differ only in their size."""

    SMALLEST: ClassVar[int] = 2
    """Smallest valid size."""
    COUNTS: ClassVar[str]
    """Meaning of the size, for messages."""
    SPRINGS: ClassVar[int]
    """Number of springs per vertex in the interior of a large mesh."""

    def build(self, size: int) -> Mesh:
        """Build the mesh of a size; raise InputError as `check_size` does, before any allocation."""
        self.check(size)
        return self.generate(size)

    def check(self, size: int) -> None:
        """Raise InputError for a size outside the limits of the generator, `MAX_VERTICES` and the memory."""
        if size < self.SMALLEST:
            raise self._refusal(size, "is too small")
        if excess := self.excess(size):
            raise self._refusal(size, excess)

    def excess(self, size: int) -> str:
        """Describe why a size is too large; empty if it is not."""
        if size > MAX_VERTICES:
            return "is too large"
        if (vertices := self.count(size)) <= self._most:
            return ""
        needs, has = memory.in_words(vertices * self._bytes), memory.in_words(memory.of_machine())
        return (
            f"would give {vertices:,} vertices of at most {self._most:,}; with their springs and Q they would take "
            f"about {needs} of memory, where {has} may be taken"
        )

    @property
    def _bytes(self) -> int:
        """Memory per vertex with its springs [bytes]."""
        return _BYTES + _BYTES_PER_SPRING * self.SPRINGS

    @property
    def _most(self) -> int:
        """Maximum number of vertices on this machine."""
        return min(MAX_VERTICES, int(memory.of_machine() // self._bytes))

    @abstractmethod
    def count(self, size: int) -> int:
        """Return the number of vertices for a size from SMALLEST to MAX_VERTICES; nondecreasing in the size."""

    @abstractmethod
    def generate(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""

    def _refusal(self, size: int, why: str) -> InputError:
        largest = self.SMALLEST - 1 + bisect_right(range(self.SMALLEST, MAX_VERTICES + 1), self._most, key=self.count)
        allowed = f"{self.SMALLEST} to {largest}" if largest >= self.SMALLEST else "none with these proportions"
        kind = type(self).__name__.lower()
        return InputError(Mistake(f"{size} {why}; allowed for {kind}: {allowed} ({self.COUNTS})", key="size"))


def cells(length: float, spacing: float) -> int:
    """Return the number of cells of about `spacing` [m] in `length` [m], at least one."""
    return max(1, round(length / spacing))

"""The base of the mesh generators: a model of physical parameters that builds meshes of any size."""

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
"""No mesh may have more: positions, springs and a factor of that size fill the memory of a workstation."""

_BYTES, _BYTES_PER_SPRING = 150, 240
"""Of each vertex and spring, at most while mesh, springs and Q are made: chains took 380 bytes a vertex, sheets 1090,
solids 2740. What a solver makes of Q comes later, and is estimated when Q is known."""

Metres = Annotated[float, Field(ge=1e-6, le=1e6)]
"""A length [m] from a micrometre to a thousand kilometres."""


class Generator(Model):
    """Parameters of a family of meshes that differ in their size alone."""

    SMALLEST: ClassVar[int] = 2
    """The smallest size that makes a mesh."""
    COUNTS: ClassVar[str]
    """What the size counts, for messages."""
    SPRINGS: ClassVar[int]
    """How many springs a vertex has, inside a large mesh."""

    def build(self, size: int) -> Mesh:
        """The mesh of this size; raises InputError as `check` does, before anything is allocated."""
        self.check(size)
        return self.generate(size)

    def check(self, size: int) -> None:
        """Raise InputError for a size outside the range that the generator, `MAX_VERTICES` and the memory allow."""
        if size < self.SMALLEST:
            raise self._refusal(size, "is too small")
        if excess := self.excess(size):
            raise self._refusal(size, excess)

    def excess(self, size: int) -> str:
        """What is wrong with a size that is too large, in words; nothing is with others."""
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
        """Of a vertex and its springs."""
        return _BYTES + _BYTES_PER_SPRING * self.SPRINGS

    @property
    def _most(self) -> int:
        """The most vertices on this machine."""
        return min(MAX_VERTICES, int(memory.of_machine() // self._bytes))

    @abstractmethod
    def count(self, size: int) -> int:
        """How many vertices a mesh of a size from SMALLEST to MAX_VERTICES has; never falls as it grows."""

    @abstractmethod
    def generate(self, size: int) -> Mesh:
        """The mesh of a size that has been checked."""

    def _refusal(self, size: int, why: str) -> InputError:
        largest = self.SMALLEST - 1 + bisect_right(range(self.SMALLEST, MAX_VERTICES + 1), self._most, key=self.count)
        allowed = f"{self.SMALLEST} to {largest}" if largest >= self.SMALLEST else "none with these proportions"
        kind = type(self).__name__.lower()
        return InputError(Mistake(f"{size} {why}; allowed for {kind}: {allowed} ({self.COUNTS})", key="size"))


def cells(length: float, spacing: float) -> int:
    """How many cells of about `spacing` [m] fill `length` [m]: at least one."""
    return max(1, round(length / spacing))

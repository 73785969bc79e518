"""The base of the mesh generators: a model of physical parameters that builds meshes of any size."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_right
from typing import Annotated, ClassVar

from pydantic import Field

from harness.errors import InputError, Mistake
from harness.mesh.base import Mesh
from harness.model import Model

MAX_VERTICES = 5_000_000
"""No mesh may have more: positions, springs and a factor of that size fill the memory of a workstation."""

Metres = Annotated[float, Field(ge=1e-6, le=1e6)]
"""A length [m] from a micrometre to a thousand kilometres."""


class Generator(Model):
    """Parameters of a family of meshes that differ in their size alone."""

    SMALLEST: ClassVar[int] = 2
    """The smallest size that makes a mesh."""
    COUNTS: ClassVar[str]
    """What the size counts, for messages."""

    def build(self, size: int) -> Mesh:
        """The mesh of this size; raises InputError as `check` does, before anything is allocated."""
        self.check(size)
        return self.generate(size)

    def check(self, size: int) -> None:
        """Raise InputError for a size outside the range that the generator and `MAX_VERTICES` allow."""
        if size < self.SMALLEST:
            raise self._refusal(size, "is too small")
        if size > MAX_VERTICES:
            raise self._refusal(size, "is too large")
        if (vertices := self.count(size)) > MAX_VERTICES:
            raise self._refusal(size, f"would give {vertices:,} vertices of at most {MAX_VERTICES:,}")

    @abstractmethod
    def count(self, size: int) -> int:
        """How many vertices a mesh of a size from SMALLEST to MAX_VERTICES has; never falls as it grows."""

    @abstractmethod
    def generate(self, size: int) -> Mesh:
        """The mesh of a size that has been checked."""

    def _refusal(self, size: int, why: str) -> InputError:
        largest = self.SMALLEST - 1 + bisect_right(range(self.SMALLEST, MAX_VERTICES + 1), MAX_VERTICES, key=self.count)
        allowed = f"{self.SMALLEST} to {largest}" if largest >= self.SMALLEST else "none with these proportions"
        kind = type(self).__name__.lower()
        return InputError(Mistake(f"{size} {why}; allowed for {kind}: {allowed} ({self.COUNTS})", key="size"))


def cells(length: float, spacing: float) -> int:
    """How many cells of about `spacing` [m] fill `length` [m]: at least one."""
    return max(1, round(length / spacing))

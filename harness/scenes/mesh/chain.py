"""A chain of vertices on a straight line with springs between neighbours; a rope also resists bending."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator

from harness.scenes.mesh.base import BEND, STRETCH, Mesh
from harness.scenes.mesh.generator import Generator, Metres
from harness.scenes.mesh.topology import NO_PAIRS, Indices, assemble, by_length, offset_pairs


def _not_zero(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(direction):
        raise ValueError("a direction needs a component that is not zero")
    return direction


class Chain(Generator):
    """`size` vertices from the origin along `direction`; vertices and springs are numbered along the line.

    Parts: first, last, ends. Mass is proportional to length. Dimension 1: every spring is a piece of the same rope.
    """

    kind: Literal["chain"] = "chain"
    length: Metres = 1.0
    """Length from the first vertex to the last [m]."""
    direction: Annotated[tuple[float, float, float], AfterValidator(_not_zero)] = (1.0, 0.0, 0.0)
    """Direction of the chain, of any length but zero."""

    COUNTS: ClassVar[str] = "vertices along the chain"
    SPRINGS: ClassVar[int] = 1

    def count(self, size: int) -> int:
        """Return the number of vertices of a mesh of this size."""
        return size

    def generate(self, size: int) -> Mesh:
        """Generate the mesh of a valid size."""
        direction = np.array(self.direction) / np.max(np.abs(self.direction))
        direction /= np.linalg.norm(direction)
        rest = np.linspace(0.0, self.length, size)[:, None] * direction
        pairs = offset_pairs(np.arange(size), (1,))
        return assemble(
            rest=rest,
            springs={STRETCH: pairs, BEND: self._bends(size)},
            weights=by_length(rest, pairs),
            dimension=1,
            spacing=self.length / (size - 1),
            resolution=size,
            parts={"first": [0], "last": [size - 1], "ends": [0, size - 1]},
        )

    def _bends(self, size: int) -> Indices:
        """Return the pairs of the springs against bending (k, 2)."""
        return NO_PAIRS


class Rope(Chain):
    """A chain with additional springs from each vertex to the next but one (BEND), against bending."""

    kind: Literal["rope"] = "rope"  # pyright: ignore[reportIncompatibleVariableOverride]

    SPRINGS: ClassVar[int] = 2

    def _bends(self, size: int) -> Indices:
        return offset_pairs(np.arange(size), (2,))

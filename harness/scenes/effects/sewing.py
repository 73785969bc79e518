"""Sewing springs: two rows of vertices are pulled together over time, and stay together."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, model_validator

from harness.base.errors import InputError
from harness.base.model import Model
from harness.scenes.effects.base import Contribution
from harness.scenes.mesh.base import Mesh
from harness.scenes.selection import Selection
from solvers.energies.sewing import Sewing as Energy

Indices = NDArray[np.int64]


class Sewing(Model):
    """Threads between each vertex of one row and the nearest vertex at rest of the other row, in both directions.

    A thread pulls if it is longer than its current limit, which decreases linearly from `begin` to `end`; it never
    pushes.
    """

    exact_to: ClassVar[float] = 1.0

    kind: Literal["sewing"] = "sewing"
    first: Selection
    """First row: a vertex selection as for pins."""
    second: Selection
    """Second row."""
    stiffness: NonNegativeFloat
    """Total stiffness of the threads [N/m], divided equally, so that it is independent of the mesh size."""
    begin: NonNegativeFloat = 0.0
    """Time [s] at which the threads start to shorten; until then they have their rest lengths."""
    end: NonNegativeFloat = 1.0
    """Time [s] at which the threads reach their final length; equal to `begin` for an instantaneous change."""
    gap: NonNegativeFloat = 0.0
    """Final length [m]; with self-contact at least its thickness plus range, or contact forces oppose it."""

    @model_validator(mode="after")
    def _in_order(self) -> "Sewing":
        if self.end < self.begin:
            raise ValueError(f"end at {self.end:g} s, before they begin at {self.begin:g} s")
        return self

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the threads as one energy, empty for zero stiffness; raise InputError if the rows overlap."""
        rows = self.first.chosen(mesh, f"{self.kind}: first"), self.second.chosen(mesh, f"{self.kind}: second")
        if len(both := np.intersect1d(*rows)):
            raise InputError(
                f"{self.kind}: vertex {both[0]}{mesh.in_file(both[0])} is in both rows; each should be in one of them"
            )
        if not self.stiffness:
            return Contribution()
        pairs = _matched(mesh, *rows)
        at_rest = np.linalg.norm(mesh.rest[pairs[:, 0]] - mesh.rest[pairs[:, 1]], axis=1)
        drawn = np.minimum(at_rest, self.gap)

        def longest(time: float) -> NDArray[np.float64]:
            long = self.end - self.begin
            done = float(np.clip((time - self.begin) / long, 0.0, 1.0)) if long else float(time >= self.begin)
            return at_rest + done * (drawn - at_rest)

        k = np.full(len(pairs), self.stiffness / len(pairs))
        return Contribution(energies=(Energy.of(mesh.rest, pairs, k, longest),))


def _matched(mesh: Mesh, first: Indices, second: Indices) -> Indices:
    """Match each vertex with the nearest one of the other row, (m, 2).

    Each pair occurs once.
    """
    from scipy.spatial import cKDTree  # for those who sew

    one = np.asarray(cKDTree(mesh.rest[second]).query(mesh.rest[first])[1], np.int64)
    other = np.asarray(cKDTree(mesh.rest[first]).query(mesh.rest[second])[1], np.int64)
    pairs = [np.column_stack([first, second[one]]), np.column_stack([first[other], second])]
    return np.unique(np.concatenate(pairs), axis=0)

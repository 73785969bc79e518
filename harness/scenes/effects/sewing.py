"""Sewing springs: two rows of vertices are drawn together over time, and stay so."""

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
    """Threads from each vertex of one row to that of the other row which is nearest at rest, and back. They pull where
    they are longer than they may be, which becomes less from `begin` to `end`, evenly; they never push.
    """

    exact_to: ClassVar[float] = 1.0

    kind: Literal["sewing"] = "sewing"
    first: Selection
    """One of the rows: chosen as pins choose."""
    second: Selection
    """The other row."""
    stiffness: NonNegativeFloat
    """The stiffness of all the threads together [N/m], shared equally, so that it means the same at every mesh size."""
    begin: NonNegativeFloat = 0.0
    """When the threads begin to be drawn in [s]; until then they are as long as at rest."""
    end: NonNegativeFloat = 1.0
    """When they are as short as they get [s]; as `begin` for at once."""
    gap: NonNegativeFloat = 0.0
    """How long they are then [m]; with self-contact no less than its thickness and range, or it pushes back."""

    @model_validator(mode="after")
    def _in_order(self) -> "Sewing":
        if self.end < self.begin:
            raise ValueError(f"end at {self.end:g} s, before they begin at {self.begin:g} s")
        return self

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The threads as one energy, none for a stiffness of zero; raises InputError for rows that share a vertex."""
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
    """Each vertex of either row with the nearest one of the other, (m, 2), each pair once."""
    from scipy.spatial import cKDTree  # for those who sew

    one = np.asarray(cKDTree(mesh.rest[second]).query(mesh.rest[first])[1], np.int64)
    other = np.asarray(cKDTree(mesh.rest[first]).query(mesh.rest[second])[1], np.int64)
    pairs = [np.column_stack([first, second[one]]), np.column_stack([first[other], second])]
    return np.unique(np.concatenate(pairs), axis=0)

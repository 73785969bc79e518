"""Self-contact: a mesh that cannot pass through itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from harness.base.errors import InputError
from harness.base.model import Model
from harness.scenes.effects.base import Contribution, Pin, Seen
from harness.scenes.intersections import Apart, crossings
from harness.scenes.mesh.base import Mesh
from harness.scenes.touching import ENDS, outline, require_open, require_still, resisting, told
from solvers.contact.friction_rounds import ROUNDS
from solvers.contact.self_contact import SelfContact as Energy
from solvers.contact.surface import Surface
from solvers.problem import Energy as AnyEnergy
from solvers.problem import Positions

NEAR = 0.5
"""Of the mean rest length: vertices that come closer than that lie as good as inside each other."""
LOOKS = 30
"""How many frames of a motion are looked at for vertices that come close, evenly spread."""


class SelfContact(Model):
    """Keeps points from triangles and edges from edges of the mesh, by a barrier that grows without bound as their gap
    closes (formulas: `solvers.contact.barrier`). Every position on the way is free of intersections.

    Pairs that share a vertex are left out. Those that are nearer at rest than thickness and range keep both in
    proportion to their distance there, so that a mesh may be as fine as it likes. Vertices that are in no edge and no
    triangle meet nothing.
    """

    exact_to: ClassVar[float] = 1.0

    kind: Literal["self-contact"] = "self-contact"
    thickness: Annotated[PositiveFloat, Field(le=1e9)] = 0.002
    """How far apart points and triangles, edges and edges stay at least [m]: two layers lie so far apart, and a little
    more."""
    range: PositiveFloat | None = None
    """How far beyond that they feel each other [m]; as far as the thickness if left out."""
    stiffness: PositiveFloat | None = None
    """The barrier's stiffness k [N/m] at each vertex; a tenth of what inertia and springs resist with if left out."""
    friction: NonNegativeFloat = 0.0
    """Coulomb's coefficient mu, the same at rest and in motion."""
    creep: PositiveFloat = 1e-3
    """Pairs that slip slower than this [m/s] count as sticking, and creep."""
    friction_rounds: PositiveInt = ROUNDS
    """Solves of a step at most, each with the normal forces of the one before, until friction does not change; 1 takes
    those of the step's start, which is of order 1 and misses the first step of contact."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The barrier as one energy, its stiffness by the other effects'; raises InputError for a mesh that touches
        itself at rest."""
        (edges, faces), rest = outline(mesh), mesh.rest
        if not len(edges):
            return Contribution()
        reach = self.thickness if self.range is None else self.range
        if crossed := crossings(rest, edges, mesh.triangles):
            raise InputError(f"self-contact: the mesh passes through itself at rest, {told(crossed, mesh)}; repair it")

        def energy(stiffness: NDArray[np.float64]) -> Energy:
            surface = Surface.of(rest, edges, faces, stiffness, self.thickness, reach)
            if (surface.near[1] <= 0.0).any():
                raise InputError("self-contact: the mesh touches itself at rest; move what touches apart, or join it")
            return Energy(surface, self.friction, self.creep, self.friction_rounds)

        def derived(energies: Sequence[AnyEnergy]) -> tuple[AnyEnergy, ...]:
            return (energy(resisting(self.stiffness, mass, time_step, energies)),)

        def check(start: Positions, pins: Sequence[Pin]) -> None:
            """Raise InputError for exact pins that move, and for a start (n, 3) [m] that is not free."""
            require_still("self-contact", start, pins)
            if crossed := crossings(start, edges, mesh.triangles):
                raise InputError(
                    f"self-contact: the start passes through itself, {told(crossed, mesh)}; move them apart"
                )
            require_open("self-contact", energy(np.ones(len(mass))), start, self.thickness, mesh)

        apart = (Apart(((edges, mesh.triangles),)),)
        return Contribution(derived=(derived,), checks=(check,), once=("self-contact",), ends=ENDS, apart=apart)

    @classmethod
    def called_for(cls, seen: Seen) -> str:
        """See `harness.scenes.effects.base.Effect`: vertices as good as inside each other."""
        frames, n = len(seen.positions), len(seen.mesh.rest)
        reach = NEAR * seen.length
        known = _codes(np.concatenate([seen.mesh.springs, _pairs(seen.mesh.rest, reach)]), n)
        most, closest, at = 0, np.inf, 0
        for frame in np.unique(np.linspace(0, frames - 1, LOOKS).astype(int)):
            p = seen.positions[frame]
            pairs = _pairs(p, reach)
            pairs = pairs[~np.isin(_codes(pairs, n), known)]
            if len(pairs) > most:
                most, at = len(pairs), int(frame)
            if len(pairs):
                closest = min(closest, float(np.linalg.norm(p[pairs[:, 0]] - p[pairs[:, 1]], axis=1).min()))
        if not most:
            return ""
        return (
            f"{most} pairs of vertices without a spring between them are closer than {NEAR:g} mean rest lengths at "
            f"{seen.time(at):.2f} s, two come as close as {closest / seen.length:.2g}; contact with obstacles "
            "does not keep them apart"
        )


def _pairs(p: NDArray[np.float64], reach: float) -> NDArray[np.int64]:
    """Pairs of vertices (k, 2) that are closer than `reach` [m]."""
    from scipy.spatial import KDTree  # for those who look

    return KDTree(p).query_pairs(reach, output_type="ndarray").astype(np.int64)


def _codes(pairs: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """One number for each pair, whichever end comes first."""
    return pairs.min(axis=1) * n + pairs.max(axis=1)

"""Self-contact: the mesh cannot intersect itself."""

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
"""Distance relative to the mean rest length below which vertices practically coincide."""
LOOKS = 30
"""Number of frames, evenly spaced, that are searched for close vertices."""


class SelfContact(Model):
    """Separates points from triangles and edges from edges of the mesh by a barrier that diverges as their gap closes.

    Formulas: `solvers.contact.barrier`. All intermediate positions are intersection-free. Pairs that share a
    vertex are excluded. Pairs that are closer at rest than thickness plus range have both reduced in proportion to
    their rest distance, so the mesh may be arbitrarily fine. Vertices in no edge and no triangle do not collide.
    """

    exact_to: ClassVar[float] = 1.0

    kind: Literal["self-contact"] = "self-contact"
    thickness: Annotated[PositiveFloat, Field(le=1e9)] = 0.002
    """Minimum distance [m] between points and triangles, and between edges: two layers rest at slightly more than this
    distance."""
    range: PositiveFloat | None = None
    """Distance [m] beyond the thickness at which the barrier activates; equal to the thickness by default."""
    stiffness: PositiveFloat | None = None
    """Barrier stiffness k [N/m] at each vertex; by default a tenth of the resistance of inertia and springs."""
    friction: NonNegativeFloat = 0.0
    """Coulomb's friction coefficient mu, both static and kinetic."""
    creep: PositiveFloat = 1e-3
    """Tangential speed [m/s] below which pairs count as sticking, and creep."""
    friction_rounds: PositiveInt = ROUNDS
    """Maximum number of solves per step until friction converges, each with the normal forces of the previous one; 1
    uses those of the step's start, which is of order 1 and misses the first step of contact."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the barrier as one energy, with a stiffness from the other effects.

        Raises:
            InputError: if the mesh intersects itself at rest.
        """
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
            """Raise InputError for exact pins that move, and for a start (n, 3) [m] with intersections."""
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
        """Return evidence for self-contact: vertices that practically coincide."""
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
    """Find pairs of vertices (k, 2) closer than `reach` [m]."""
    from scipy.spatial import KDTree  # for those who look

    return KDTree(p).query_pairs(reach, output_type="ndarray").astype(np.int64)


def _codes(pairs: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Encode each pair as one number, independent of the order of its ends."""
    return pairs.min(axis=1) * n + pairs.max(axis=1)

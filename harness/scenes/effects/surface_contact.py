"""Contact of points, edges and triangles of the mesh with the surfaces of obstacles, meshes among them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from harness.base.errors import InputError
from harness.base.model import Model
from harness.scenes.effects.base import Contribution, Pin
from harness.scenes.intersections import Apart
from harness.scenes.mesh.base import Mesh
from harness.scenes.shapes import AnySurface, Shape, deforming, placed, shape
from harness.scenes.touching import ENDS, outline, require_open, require_still, resisting, told
from solvers.contact.friction_rounds import ROUNDS
from solvers.contact.obstacles import Against, Side
from solvers.contact.self_contact import ObstacleContact
from solvers.problem import Energy, Positions

_SAG = 0.1
"""Largest inward deviation of the triangles of round obstacles, relative to the thickness."""


class SurfaceContact(Model):
    """Separates points, edges and triangles of the mesh from those of obstacles by a barrier.

    The barrier acts on either side and diverges as the gap closes (formulas: `solvers.contact.barrier`). All
    intermediate positions are intersection-free. Moving obstacles advance along their motion without passing through
    the mesh. Planes, spheres, capsules and boxes are represented by triangles too; those of round obstacles lie at most
    a tenth of the thickness inside.
    """

    exact_to: ClassVar[float] = 1.0

    kind: Literal["surface-contact"] = "surface-contact"
    obstacles: tuple[AnySurface, ...] = Field(min_length=1)
    """Obstacles that the mesh collides with."""
    thickness: Annotated[PositiveFloat, Field(le=1e9)] = 0.002
    """Minimum distance [m] from an obstacle's triangles; the mesh rests at slightly more."""
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

    @property
    def reach(self) -> float:
        """Barrier activation distance beyond the thickness [m], with its default resolved."""
        return self.thickness if self.range is None else self.range

    def shapes(self, rest: Positions) -> list[Shape]:
        """Build the surfaces of the obstacles in their declared poses; `rest` (n, 3) [m] of the mesh."""
        return [shape(one, _SAG * self.thickness, rest) for one in self.obstacles]

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the barrier as one energy, with a stiffness from the other effects.

        Raises:
            InputError: if an obstacle is invalid.
        """
        (edges, faces), n, shapes = outline(mesh), len(mesh.rest), self.shapes(mesh.rest)
        if not len(edges):
            return Contribution()
        sizes = np.cumsum([0, *(len(points) for points, _ in shapes)]).tolist()
        points = np.concatenate([points for points, _ in shapes])
        triangles = np.concatenate([first + faces for first, (_, faces) in zip(sizes, shapes, strict=False)])
        sides = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        ends = np.unique(np.sort(sides, axis=1), axis=0)
        moving = any(one.motion or deforming(one) for one in self.obstacles)

        @lru_cache(maxsize=2)  # a step's end is the start of the next one
        def moved(time: float) -> Positions:
            parts = zip(shapes, self.obstacles, strict=True)
            return np.concatenate([placed(one, x, time) for (x, _), one in parts])

        def place(time: float) -> Positions:
            return moved(time) if moving else points

        def carry(begin: float, end: float, p: Positions) -> list[Positions]:
            rigid = [one.motion for one in self.obstacles if one.motion is not None and not deforming(one)]
            ways = [motion.moved(motion.back(p, begin), end) for motion in rigid]
            for (x, _), one in zip(shapes, self.obstacles, strict=True):
                if deforming(one):  # as it does on the whole
                    ways.append(p + (placed(one, x, end) - placed(one, x, begin)).mean(axis=0))
            return ways

        def energy(stiffness: NDArray[np.float64]) -> ObstacleContact:
            own, others = Side.of(mesh.rest, edges, faces), Side.of(points, ends, triangles, n)
            against = Against(own, others, stiffness, self.thickness, self.reach)
            return ObstacleContact.of(against, place, carry, self.friction, self.creep, self.friction_rounds)

        def derived(energies: Sequence[Energy]) -> tuple[Energy, ...]:
            return (energy(resisting(self.stiffness, mass, time_step, energies)),)

        apart = Apart(((edges, n + triangles), (n + ends, mesh.triangles)), place)

        def check(start: Positions, pins: Sequence[Pin]) -> None:
            """Raise InputError for exact pins that move, and for a start (n, 3) [m] with intersections."""
            require_still(self.kind, start, pins)
            if crossed := apart.crossings(start, 0.0):
                raise InputError(
                    f"{self.kind}: the start passes through obstacles, {told(crossed, mesh)}; move them apart"
                )
            require_open(self.kind, energy(np.ones(n)), start, self.thickness, mesh)

        return Contribution(derived=(derived,), checks=(check,), ends=ENDS, apart=(apart,))

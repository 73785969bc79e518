"""Self-contact: a mesh that cannot pass through itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from harness.base.errors import InputError
from harness.base.model import Model
from harness.scenes.effects.base import Contribution, Pin
from harness.scenes.intersections import crossings
from harness.scenes.mesh.base import STRETCH, Mesh
from solvers.contact.self_contact import SelfContact as Energy
from solvers.contact.surface import Surface
from solvers.matrices import assemble
from solvers.problem import Energy as AnyEnergy
from solvers.problem import Pins, Positions, ProjectiveEnergy, System

_STIFF = 0.1
"""Of what inertia and springs resist with at a vertex."""

_NAMED = 3
"""Pairs that a message names."""


class SelfContact(Model):
    """Keeps points from triangles and edges from edges of the mesh, by a barrier that grows without bound as their gap
    closes (formulas: `solvers.contact.barrier`). Every position on the way is free of intersections.

    Pairs that share a vertex are left out. Those that are nearer at rest than thickness and range keep both in
    proportion to their distance there, so that a mesh may be as fine as it likes. Vertices that are in no edge and no
    triangle meet nothing.
    """

    kind: Literal["self-contact"] = "self-contact"
    thickness: Annotated[PositiveFloat, Field(le=1e9)] = 0.002
    """How far apart points and triangles, edges and edges stay at least [m]: two layers lie so far apart, and a little
    more."""
    range: PositiveFloat | None = None
    """How far beyond that they feel each other [m]; as far as the thickness if left out."""
    stiffness: PositiveFloat | None = None
    """The barrier's stiffness k [N/m] at each vertex; a tenth of what inertia and springs resist with if left out."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The barrier as one energy, its stiffness by the other effects'; raises InputError for a mesh that touches
        itself at rest."""
        edges, rest = outline(mesh), mesh.rest
        if not len(edges):
            return Contribution()
        reach = self.thickness if self.range is None else self.range
        if crossed := crossings(rest, edges, mesh.triangles):
            raise InputError(f"self-contact: the mesh passes through itself at rest, {_told(crossed)}; repair it")

        def derived(energies: Sequence[AnyEnergy]) -> tuple[AnyEnergy, ...]:
            stiffness = np.full(len(mass), self.stiffness or 0.0)
            if self.stiffness is None:
                projective = [energy for energy in energies if isinstance(energy, ProjectiveEnergy)]
                held = System(mass, time_step, pins=Pins(np.arange(len(mass)), np.full(len(mass), np.inf)))
                stiffness = _STIFF * np.asarray(assemble(held, projective).diagonal(), np.float64)
            surface = Surface.of(rest, edges, mesh.triangles, stiffness, self.thickness, reach)
            if (surface.near[1] <= 0.0).any():
                raise InputError("self-contact: the mesh touches itself at rest; move what touches apart, or join it")
            return (Energy(surface),)

        def check(start: Positions, pins: Sequence[Pin]) -> None:
            """Raise InputError for exact pins that move, and for a start (n, 3) [m] that is not free."""
            for pin in pins:
                moves = pin.motion is not None or not np.array_equal(pin.targets, start[pin.vertices])
                if np.isinf(pin.weight) and moves:
                    raise InputError(
                        "self-contact: exact pins that move, or do not start where they hold, would carry the mesh "
                        "through itself; give these pins a weight"
                    )
            if crossed := crossings(start, edges, mesh.triangles):
                raise InputError(f"self-contact: the start passes through itself, {_told(crossed)}; move them apart")
            (energy,) = derived(()) if self.stiffness else (Energy(_bare(mesh, edges, self.thickness, reach)),)
            assert isinstance(energy, Energy)
            if closed := energy.closed(start):
                near = "; ".join(
                    f"{'edges' if two else 'vertex'} {_pair(x.tolist(), two)} {apart:.3g} m apart"
                    for x, two, apart in closed[:_NAMED]
                )
                raise InputError(
                    f"self-contact: {len(closed)} pairs start nearer than the thickness of {self.thickness:g} m: {near}"
                    "; move them apart, or take a smaller thickness"
                )

        ends = ("keeps apart what it finds at the end of a step",)
        return Contribution(
            derived=(derived,), checks=(check,), once=("self-contact",), ends=ends, apart=(edges, mesh.triangles)
        )


def outline(mesh: Mesh) -> NDArray[np.int64]:
    """The edges (m, 2) that may touch: sides of triangles, and springs of stretch that run between other vertices."""
    triangles = mesh.triangles
    sides = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    inside = np.zeros(len(mesh.rest), bool)
    inside[triangles] = True
    ropes = mesh.springs[mesh.families.get(STRETCH, np.empty(0, np.int64))]
    ropes = ropes[~inside[ropes].all(axis=1) & (ropes[:, 0] != ropes[:, 1])]
    return np.unique(np.sort(np.concatenate([sides, ropes]), axis=1), axis=0)


def _bare(mesh: Mesh, edges: NDArray[np.int64], thickness: float, reach: float) -> Surface:
    return Surface.of(mesh.rest, edges, mesh.triangles, np.ones(len(mesh.rest)), thickness, reach)


def _pair(x: list[int], edges: bool) -> str:
    return f"{x[0]}-{x[1]} and {x[2]}-{x[3]}" if edges else f"{x[0]} and triangle {x[1]}-{x[2]}-{x[3]}"


def _told(crossed: list[tuple[tuple[int, int], tuple[int, int, int]]]) -> str:
    """The first ones in words."""
    words = "; ".join(
        f"edge {'-'.join(map(str, e))} through triangle {'-'.join(map(str, t))}" for e, t in crossed[:_NAMED]
    )
    return f"{len(crossed)} times: {words}"

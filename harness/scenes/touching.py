"""What effects share that keep a mesh from passing through something: what of it may touch, and what they refuse."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import InputError
from harness.scenes.intersections import Crossing
from harness.scenes.mesh.base import STRETCH, Mesh
from harness.scenes.motion import KeyedMotion
from solvers.contact.self_contact import PairContact
from solvers.matrices import assemble
from solvers.problem import Energy, Pins, Positions, ProjectiveEnergy, System

_STIFF = 0.1
"""Of what inertia and springs resist with at a vertex."""

_NAMED = 3
"""Pairs that a message names."""

ENDS = ("keeps apart what it finds at the end of a step",)


def outline(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The edges (m, 2) that may touch, sides of triangles and springs of stretch that run between other vertices, and
    what points may touch (f, 3): triangles, and such springs i, j as triangles i, j, j.

    Without those, two ropes that lie side by side would feel nothing: nearly parallel edges do not press.
    """
    triangles = mesh.triangles
    sides = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    inside = np.zeros(len(mesh.rest), bool)
    inside[triangles] = True
    ropes = mesh.springs[mesh.families.get(STRETCH, np.empty(0, np.int64))]
    ropes = ropes[~inside[ropes].all(axis=1) & (ropes[:, 0] != ropes[:, 1])]
    ropes = np.unique(np.sort(ropes, axis=1), axis=0)
    edges = np.unique(np.concatenate([np.sort(sides, axis=1), ropes]), axis=0)
    return edges, np.concatenate([triangles, ropes[:, [0, 1, 1]]])


def resisting(
    given: float | None, mass: NDArray[np.float64], time_step: float, energies: Sequence[Energy]
) -> NDArray[np.float64]:
    """A barrier's stiffness (n,) [N/m]: what is given, or by what inertia and springs resist with."""
    if given is not None:
        return np.full(len(mass), given)
    projective = [energy for energy in energies if isinstance(energy, ProjectiveEnergy)]
    held = System(mass, time_step, pins=Pins(np.arange(len(mass)), np.full(len(mass), np.inf)))
    return _STIFF * np.asarray(assemble(held, projective).diagonal(), np.float64)


class PinLike(Protocol):
    """What pins tell of themselves (`harness.scenes.effects.base`)."""

    @property
    def vertices(self) -> NDArray[np.int64]:
        """(q,)"""
        ...

    @property
    def targets(self) -> Positions:
        """(q, 3) [m]"""
        ...

    @property
    def weight(self) -> float:
        """[N/m]"""
        ...

    @property
    def motion(self) -> KeyedMotion | None:
        """Takes the targets along."""
        ...


def require_still(who: str, start: Positions, pins: Sequence[PinLike]) -> None:
    """Raise InputError for exact pins that move."""
    for pin in pins:
        moves = pin.motion is not None or not np.array_equal(pin.targets, start[pin.vertices])
        if np.isinf(pin.weight) and moves:
            raise InputError(
                f"{who}: exact pins that move, or do not start where they hold, would carry the mesh through what it "
                "meets; give these pins a weight"
            )


def require_open(who: str, energy: PairContact, start: Positions, thickness: float, mesh: Mesh) -> None:
    """Raise InputError for a start (n, 3) [m] where pairs are nearer than the thickness [m]."""
    if closed := energy.closed(start):
        near = "; ".join(f"{_pair(x.tolist(), two, mesh)} {apart:.3g} m apart" for x, two, apart in closed[:_NAMED])
        raise InputError(
            f"{who}: {len(closed)} pairs start nearer than the thickness of {thickness:g} m: {near}; move them apart, "
            "or take a smaller thickness"
        )


def _pair(x: list[int], edges: bool, mesh: Mesh) -> str:
    one, two = (x[:2], x[2:]) if edges else (x[:1], x[1:])
    return f"{_part(one, mesh)} and {_part(two, mesh)}"


def _part(x: Sequence[int], mesh: Mesh) -> str:
    """A vertex, an edge or a triangle by its vertices; those beyond the mesh's are those of obstacles."""
    n = len(mesh.rest)
    own = all(i < n for i in x)
    kind = ("vertex", "edge", "triangle")[len(x) - 1]
    return f"{kind} {'-'.join(str(i if own else i - n) for i in x)}{mesh.in_file(*x) if own else ' of the obstacles'}"


def told(crossed: list[Crossing], mesh: Mesh) -> str:
    """The first ones in words; vertices beyond those of the mesh are those of obstacles."""
    words = "; ".join(f"{_part(e, mesh)} through {_part(t, mesh)}" for e, t in crossed[:_NAMED])
    return f"{len(crossed)} times: {words}"

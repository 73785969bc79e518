"""Shared parts of the barrier contact effects: collision primitives, stiffness, validation and messages."""

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
"""Barrier stiffness as a fraction of the resistance of inertia and springs at a vertex."""

_NAMED = 3
"""Maximum number of pairs that a message names."""

ENDS = ("keeps apart what it finds at the end of a step",)


def outline(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the edges (m, 2) and faces (f, 3) of the mesh that can collide.

    Edges are the sides of triangles, and stretch springs between other vertices. Faces are the triangles, and such
    springs i, j as triangles i, j, j. Without these, parallel ropes would not collide, because the edge-edge barrier
    vanishes for nearly parallel edges.
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
    """Compute the barrier stiffness of each vertex.

    Args:
        given: given value [N/m]; None for a fraction of the resistance of inertia and springs.
        mass: (n,) [kg].
        time_step: dt [s].
        energies: energies of the other effects.

    Returns:
        Stiffness (n,) [N/m].
    """
    if given is not None:
        return np.full(len(mass), given)
    projective = [energy for energy in energies if isinstance(energy, ProjectiveEnergy)]
    held = System(mass, time_step, pins=Pins(np.arange(len(mass)), np.full(len(mass), np.inf)))
    return _STIFF * np.asarray(assemble(held, projective).diagonal(), np.float64)


class PinLike(Protocol):
    """Interface of pins (`harness.scenes.effects.base`)."""

    @property
    def vertices(self) -> NDArray[np.int64]:
        """Pinned vertices (q,)."""
        ...

    @property
    def targets(self) -> Positions:
        """Targets (q, 3) [m]."""
        ...

    @property
    def weight(self) -> float:
        """Penalty weight [N/m]."""
        ...

    @property
    def motion(self) -> KeyedMotion | None:
        """Motion of the targets."""
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
    """Raise InputError if pairs start closer than `thickness` [m], at the start (n, 3) [m]."""
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
    """Describe a vertex, an edge or a triangle by its vertices.

    Indices beyond those of the mesh are vertices of obstacles.
    """
    n = len(mesh.rest)
    own = all(i < n for i in x)
    kind = ("vertex", "edge", "triangle")[len(x) - 1]
    return f"{kind} {'-'.join(str(i if own else i - n) for i in x)}{mesh.in_file(*x) if own else ' of the obstacles'}"


def told(crossed: list[Crossing], mesh: Mesh) -> str:
    """Describe the first intersections in words; indices beyond the mesh are those of obstacles."""
    words = "; ".join(f"{_part(e, mesh)} through {_part(t, mesh)}" for e, t in crossed[:_NAMED])
    return f"{len(crossed)} times: {words}"

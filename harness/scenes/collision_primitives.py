"""Shared parts of the barrier contact effects: collision primitives, stiffness, validation and messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError
from springbench.harness.scenes.edge_triangle_intersections import Intersection
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.harness.scenes.mesh.mesh import STRETCH, Mesh
from springbench.solvers.contact.contact_potential import BarrierContact
from springbench.solvers.model.step_problem import DirichletPins, Energy, Positions, ProjectiveEnergy, System
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

_STIFFNESS_FRACTION = 0.1
"""Barrier stiffness as a fraction of the resistance of inertia and springs at a vertex."""

_MAX_NAMED_PAIRS = 3
"""Maximum number of pairs that a message names."""

END_OF_STEP_REASON = ("separates the pairs that it finds at the end of a step",)


def find_collision_primitives(mesh: Mesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the edges (m, 2) and faces (f, 3) of the mesh that can collide.

    Edges are the sides of triangles, and stretch springs with an end outside of all triangles. Faces are the triangles,
    and a triangle i, j, j for each such spring i, j. Without the latter, parallel ropes would not collide, because the
    edge-edge barrier vanishes for nearly parallel edges.
    """
    triangles = mesh.triangles
    sides = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    inside = np.zeros(len(mesh.rest_positions), bool)
    inside[triangles] = True
    ropes = mesh.springs[mesh.spring_families.get(STRETCH, np.empty(0, np.int64))]
    ropes = ropes[~inside[ropes].all(axis=1) & (ropes[:, 0] != ropes[:, 1])]
    ropes = np.unique(np.sort(ropes, axis=1), axis=0)
    edges = np.unique(np.concatenate([np.sort(sides, axis=1), ropes]), axis=0)
    return edges, np.concatenate([triangles, ropes[:, [0, 1, 1]]])


def compute_barrier_stiffness(
    stiffness: float | None, mass: NDArray[np.float64], time_step: float, energies: Sequence[Energy]
) -> NDArray[np.float64]:
    """Compute the barrier stiffness of each vertex.

    Args:
        stiffness: given value [N/m]; None for a fraction of the resistance of inertia and springs.
        mass: (n,) [kg].
        time_step: dt [s].
        energies: energies of the other effects.

    Returns:
        Stiffness (n,) [N/m].
    """
    if stiffness is not None:
        return np.full(len(mass), stiffness)
    projective = [energy for energy in energies if isinstance(energy, ProjectiveEnergy)]
    # Exact pins of all vertices add nothing to Q, and determine the positions of vertices without mass.
    system = System(mass, time_step, pins=DirichletPins(np.arange(len(mass)), np.full(len(mass), np.inf)))
    return _STIFFNESS_FRACTION * np.asarray(assemble_system_matrix(system, projective).diagonal(), np.float64)


class PinTargets(Protocol):
    """Interface of pins (`springbench.harness.scenes.effects.effect_interface`)."""

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
    def motion(self) -> KeyFrameMotion | None:
        """Motion of the targets."""
        ...


def require_fixed_exact_pins(effect_name: str, start: Positions, pins: Sequence[PinTargets]) -> None:
    """Raise InputError for exact pins that move.

    Args:
        effect_name: name of the effect in the message.
        start: initial positions (n, 3) [m], from which the targets of exact pins must not differ.
        pins: all pins of the scene; those with a finite weight may move.

    Raises:
        InputError: an exact pin moves, or does not start at its target.
    """
    for pin in pins:
        is_away = (pin.targets != start[pin.vertices]).any(axis=1)
        if np.isinf(pin.weight) and len(is_away) and (pin.motion is not None or is_away.any()):
            does = "does not start at its target" if pin.motion is None else "moves"
            raise InputError(
                f"{effect_name}: the exact pin of vertex {pin.vertices[is_away.argmax()]} {does}, and would move the "
                "mesh through obstacles or itself; give its effect a finite `weight` [N/m]"
            )


def require_intersection_free(
    effect_name: str, energy: BarrierContact, start: Positions, min_distance: float, mesh: Mesh
) -> None:
    """Raise InputError if pairs start closer than a minimum distance.

    Args:
        effect_name: name of the effect in the message.
        energy: barrier, which finds the pairs.
        start: initial positions (n, 3) [m].
        min_distance: minimum distance [m] that the message states; the search uses that of `energy`.
        mesh: mesh of the scene, by which the message names vertices, edges and triangles.

    Raises:
        InputError: a pair is too close.
    """
    if closed := energy.find_violated_pairs(start):
        near = "; ".join(
            f"{_describe_pair(x.tolist(), two, mesh)} {apart:.3g} m apart"
            for x, two, apart in closed[:_MAX_NAMED_PAIRS]
        )
        raise InputError(
            f"{effect_name}: {len(closed)} pairs start nearer than the min_distance of "
            f"{min_distance:g} m: {near}; move them apart, "
            "or take a smaller min_distance"
        )


def _describe_pair(x: list[int], edges: bool, mesh: Mesh) -> str:
    one, two = (x[:2], x[2:]) if edges else (x[:1], x[1:])
    return f"{_describe_primitive(one, mesh)} and {_describe_primitive(two, mesh)}"


def _describe_primitive(x: Sequence[int], mesh: Mesh) -> str:
    """Describe a vertex, an edge or a triangle by its vertices.

    Indices beyond those of the mesh are vertices of obstacles.
    """
    n = len(mesh.rest_positions)
    own = all(i < n for i in x)
    kind = ("vertex", "edge", "triangle")[len(x) - 1]
    return (
        f"{kind} {'-'.join(str(i if own else i - n) for i in x)}"
        f"{mesh.format_file_numbers(*x) if own else ' of the obstacles'}"
    )


def describe_intersections(intersections: list[Intersection], mesh: Mesh) -> str:
    """Describe the first intersections in words.

    Args:
        intersections: pairs of an edge and a triangle, each by its vertices.
        mesh: mesh of the scene; indices beyond its vertices are those of obstacles.
    """
    words = "; ".join(
        f"{_describe_primitive(e, mesh)} through {_describe_primitive(t, mesh)}"
        for e, t in intersections[:_MAX_NAMED_PAIRS]
    )
    return f"{len(intersections)} times: {words}"

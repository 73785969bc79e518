"""Declaration of a scene as read by the reference implementation, and the data of one step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.mesh.mesh import Mesh

from tests.oracles.complex_step import ExtendedArray, ValueFunction, to_extended

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StepMoment:
    """Data of one step.

    Attributes:
      time_step: step size dt [s].
      velocity_rate: factor [1/s] in the velocity at the solution x, rate (x - origin).
      stage_fraction: fraction of the step at which x is evaluated.
      time: time of the step's start [s].
      stage_time: time of x [s].
      p: positions (n, 3) [m] at the start.
      v: filtered velocities (n, 3) [m/s] at the start.
      lagged_positions: positions (n, 3) [m] at which lagged quantities are evaluated.
      velocity_origin: origin (n, 3) [m] in the velocity.
      normal_force_positions: positions (n, 3) [m] at which friction's normal forces are evaluated, None for the start.
    """

    time_step: float
    velocity_rate: float
    stage_fraction: float
    time: float
    stage_time: float
    p: ExtendedArray
    v: ExtendedArray
    lagged_positions: ExtendedArray
    velocity_origin: ExtendedArray
    normal_force_positions: ExtendedArray | None = None


@dataclass(frozen=True, eq=False)
class SceneDeclaration:
    """Declaration of a scene.

    Attributes:
      mesh: mesh of the scene.
      mass: masses (n,) [kg].
      time_step: step size [s].
      effects: models of all effects.
      has_stages: whether the integrator evaluates forces at its stages, so that drag is a force.
    """

    mesh: Mesh
    mass: Array
    time_step: float
    effects: tuple[Any, ...]
    has_stages: bool = False

    @property
    def rest(self) -> ExtendedArray:
        """The rest positions (n, 3) [m]."""
        return to_extended(self.mesh.rest_positions)

    def select_effects(self, kind: str) -> list[Any]:
        """Return the effects of a kind, in order."""
        return [effect for effect in self.effects if effect.kind == kind]


BeginFunction = Callable[[StepMoment], ValueFunction]
ReferenceForce = Callable[[Array, Array, float], tuple[Array, float]]
"""Maps positions (n, 3) [m], velocities (n, 3) [m/s] and time [s] to the force (n, 3) [N], and to the size [N] whose
product with eps is its round-off."""


class PinnedVertex(NamedTuple):
    """A pin.

    Attributes:
      weight: penalty weight [N/m], infinite for an exact pin.
      position: position (3,) [m] at a time [s].
      velocity: velocity (3,) [m/s] at a time [s].
    """

    weight: float
    position: Callable[[float], ExtendedArray]
    velocity: Callable[[float], ExtendedArray]


@dataclass(frozen=True)
class EffectTerms:
    """Reference terms of one effect.

    Attributes:
      build_energy: builds the energy of a step.
      diagonal: share (n,) [N/m] of the diagonal of Q at the rate 1/dt, None for none.
      build_from_diagonal: builds the energy where it depends on the diagonal of Q (n,) [N/m], the sum over all
        effects and inertia.
      evaluate_force: evaluates the force.
      filter_velocity: filters velocities (n, 3) before a step.
      pinned_vertices: pins by vertex.
      min_length: smallest length [m] that the energy depends on, apart from the springs'.
      coordinate_scale: largest coordinate [m].
      exact_lengths: shortest and longest length [m] allowed for each inextensible edge (i, j).
    """

    build_energy: BeginFunction | None = None
    diagonal: Array | None = None
    build_from_diagonal: Callable[[Array], BeginFunction] | None = None
    evaluate_force: ReferenceForce | None = None
    filter_velocity: Callable[[Array], Array] | None = None
    pinned_vertices: dict[int, PinnedVertex] = field(default_factory=dict[int, PinnedVertex])
    min_length: float = np.inf
    coordinate_scale: float = 0.0
    exact_lengths: dict[tuple[int, int], tuple[float, float]] = field(
        default_factory=dict[tuple[int, int], tuple[float, float]]
    )


def sum_edge_weights(edges: NDArray[np.int64], weight: Array, n: int) -> Array:
    """Sum the weights of the edges at each vertex, without loops.

    Args:
      edges: vertex pairs (m, 2).
      weight: weights (m,).
      n: number of vertices.

    Returns: sums (n,).
    """
    i, j = edges.T
    has_length = i != j
    ends = np.concatenate([i[has_length], j[has_length]])
    return np.asarray(np.bincount(ends, np.tile(weight[has_length], 2), n), np.float64)

"""Declaration of a scene as read by the reference implementation, and the data of one step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.scenes.mesh.base import Mesh
from harness.simulation.opinion.derivatives import Values, Wide, wide

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Moment:
    """Data of one step.

    Attributes:
      time_step: step size dt [s].
      rate: factor [1/s] in the velocity at the solution x, rate (x - origin).
      when: fraction of the step at which x is evaluated.
      time: time of the step's start [s].
      until: time of x [s].
      p: positions (n, 3) [m] at the start.
      v: filtered velocities (n, 3) [m/s] at the start.
      expected: positions (n, 3) [m] at which lagged quantities are evaluated.
      origin: origin (n, 3) [m] in the velocity.
      pressed: positions (n, 3) [m] at which friction's normal forces are evaluated, None for the start.
    """

    time_step: float
    rate: float
    when: float
    time: float
    until: float
    p: Wide
    v: Wide
    expected: Wide
    origin: Wide
    pressed: Wide | None = None


@dataclass(frozen=True, eq=False)
class Declared:
    """Declaration of a scene.

    Attributes:
      mesh: mesh of the scene.
      mass: masses (n,) [kg].
      time_step: step size [s].
      effects: models of all effects.
      staged: whether the integrator evaluates forces at its stages, so that drag is a force.
    """

    mesh: Mesh
    mass: Array
    time_step: float
    effects: tuple[Any, ...]
    staged: bool = False

    @property
    def rest(self) -> Wide:
        """The rest positions (n, 3) [m]."""
        return wide(self.mesh.rest)

    def of_kind(self, kind: str) -> list[Any]:
        """Return the effects of a kind, in order."""
        return [effect for effect in self.effects if effect.kind == kind]


Begin = Callable[[Moment], Values]
Force = Callable[[Array, Array, float], tuple[Array, float]]
"""Maps positions (n, 3) [m], velocities (n, 3) [m/s] and time [s] to the force (n, 3) [N], and to the size [N] whose
product with eps is its round-off."""


class PinnedVertex(NamedTuple):
    """A pin.

    Attributes:
      weight: penalty weight [N/m], infinite for an exact pin.
      place: position (3,) [m] at a time [s].
      speed: velocity (3,) [m/s] at a time [s].
    """

    weight: float
    place: Callable[[float], Wide]
    speed: Callable[[float], Wide]


@dataclass(frozen=True)
class Opinion:
    """Reference terms of one effect.

    Attributes:
      begin: builds the energy of a step.
      resists: share (n,) [N/m] of the diagonal of Q at the rate 1/dt, None for none.
      needs: builds the energy where it depends on the diagonal of Q (n,) [N/m], the sum over all
        effects and inertia.
      force: evaluates the force.
      decay: filters velocities (n, 3) before a step.
      pins: pins by vertex.
      shortest: smallest length [m] that the energy depends on, apart from the springs'.
      reach: largest coordinate [m].
      exact: shortest and longest length [m] allowed for each inextensible edge (i, j).
    """

    begin: Begin | None = None
    resists: Array | None = None
    needs: Callable[[Array], Begin] | None = None
    force: Force | None = None
    decay: Callable[[Array], Array] | None = None
    pins: dict[int, PinnedVertex] = field(default_factory=dict[int, PinnedVertex])
    shortest: float = np.inf
    reach: float = 0.0
    exact: dict[tuple[int, int], tuple[float, float]] = field(
        default_factory=dict[tuple[int, int], tuple[float, float]]
    )


def counts(edges: NDArray[np.int64], weight: Array, n: int) -> Array:
    """Sum the weights of the edges at each vertex, without loops.

    Args:
      edges: vertex pairs (m, 2).
      weight: weights (m,).
      n: number of vertices.

    Returns: sums (n,).
    """
    i, j = edges.T
    apart = i != j
    ends = np.concatenate([i[apart], j[apart]])
    return np.asarray(np.bincount(ends, np.tile(weight[apart], 2), n), np.float64)

"""What a scene declares, as the second opinion reads it, and the moment of one step."""

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
    """One step: dt [s]; the unknown x moves with the velocity rate (x - origin), rate [1/s], and belongs to the time
    `until` [s], the fraction `when` of the step; p, v (n, 3): where the step starts, filtered, at `time` [s];
    expected (n, 3) [m]: where what is lagged is taken; pressed (n, 3) [m]: where friction's normal forces are taken,
    None for the step's start."""

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
    """A mesh, its masses (n,) [kg], dt [s], the models of all effects; staged: whether the integrator takes forces at
    its unknowns, so that drag is a force."""

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
        """The effects of a kind, in their order."""
        return [effect for effect in self.effects if effect.kind == kind]


Begin = Callable[[Moment], Values]
Force = Callable[[Array, Array, float], tuple[Array, float]]
"""Positions (n, 3) [m], velocities (n, 3) [m/s], time [s] -> the force (n, 3) [N], and the size [N] of which eps is its
round-off."""


class PinnedVertex(NamedTuple):
    """A pin: its weight [N/m], where it is (3,) [m] and how fast (3,) [m/s] at a time [s]."""

    weight: float
    place: Callable[[float], Wide]
    speed: Callable[[float], Wide]


@dataclass(frozen=True)
class Opinion:
    """What one effect is thought to contribute.

    begin: the energy of a step; resists: its share (n,) [N/m] of the diagonal of Q at the rate 1/dt, None for none;
    needs: the energy where it depends on the diagonal of Q (n,) [N/m] that all effects and inertia add up to;
    force; decay: of velocities (n, 3) before a step; pins: by vertex;
    shortest: the shortest length [m] that the energy goes by besides the springs', reach: the largest coordinate [m];
    exact: of each edge (i, j) whose length is kept exactly, the shortest and the longest [m] that are allowed.
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
    """The sum (n,) of the weights (m,) of the edges (m, 2) at each vertex; an edge from a vertex to itself is none."""
    i, j = edges.T
    apart = i != j
    ends = np.concatenate([i[apart], j[apart]])
    return np.asarray(np.bincount(ends, np.tile(weight[apart], 2), n), np.float64)

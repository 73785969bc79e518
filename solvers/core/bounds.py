"""Barrier energies, which are infinite beyond a surface in the space of positions and therefore limit the step size.

A method that moves from p along a search direction limits the step size to `reach` at each iterate, so that it
stays on the side on which it started. The line search of the descent methods does this
(`solvers.methods.base.descent_method.search`); the accelerated methods shorten their trial steps
(`solvers.core.acceleration`). Positions from another source, such as the inertial
prediction or an initial guess, are accepted if the straight path to them is free of collisions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from solvers.problem import Energy, Positions, System


class PairBlocks(Protocol):
    """Second derivatives of pairs of few vertices: vertices (a, k) and values (a, 3k, 3k) [N/m]."""

    @property
    def vertices(self) -> NDArray[np.int64]:
        """Vertices of each pair, (a, k)."""
        ...

    @property
    def values(self) -> NDArray[np.float64]:
        """Block of each pair, (a, 3k, 3k)."""
        ...

    def of(self, values: NDArray[np.float64]) -> PairBlocks:
        """Return blocks of the same pairs with other values."""
        ...

    def add_product(self, x: Positions, out: Positions) -> None:
        """Add the product with x (n, 3) to `out`."""
        ...

    def add(self, places: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add the blocks to a matrix with blocks (b, 3, 3), at indices (a, k^2); -1 for none."""
        ...


@runtime_checkable
class Bounded(Energy, Protocol):
    """An energy that is infinite beyond a surface and whose active vertex pairs depend on the positions."""

    def largest_step(self, p: Positions, direction: Positions) -> float:
        """Return the largest collision-free step size up to 1 from p along a direction, both (n, 3) [m]."""
        ...

    def carried(self, p: Positions, direction: Positions, begin: float) -> float:
        """Return the largest collision-free step size up to 1 while obstacles move through the remaining step.

        Args:
            p: positions (n, 3) [m].
            direction: displacement (n, 3) [m] over the remaining part of the step.
            begin: fraction of the step, in [0, 1], at which the obstacles start.
        """
        ...

    def at_part(self, part: float) -> Bounded:
        """Return this energy with obstacles at a fraction of their displacement in the step, 1 at its end."""
        ...

    def with_obstacles(self, p: Positions) -> list[Positions]:
        """Return the end positions of p (n, 3) [m] under the rigid motion of each moving obstacle."""
        ...

    def neighbours(self, p: Positions) -> NDArray[np.int64]:
        """Return the vertices (a, k) of all candidate pairs at and near p (n, 3).

        The index -1 means none.
        """
        ...

    def coupled(self, p: Positions) -> NDArray[np.int64]:
        """Return the vertices (a, k) of each Hessian block at p (n, 3); -1 for none."""
        ...

    def add_curvature(self, p: Positions, keep: float, places: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add the Hessian blocks at p (n, 3) to a matrix.

        Args:
            p: positions (n, 3) [m].
            keep: factor of the blocks' negative part.
            places: (a, k^2), -1 for none.
            values: matrix blocks (b, 3, 3) [N/m].
        """
        ...

    def blocks(self, p: Positions, keep: float = 1.0) -> PairBlocks:
        """Return the Hessian blocks at p (n, 3).

        `keep` is the factor of their negative part; 0 makes them positive semidefinite.
        """
        ...


def is_bounded(energy: Energy) -> TypeGuard[Bounded]:
    """Return whether an energy is a barrier that limits the step size."""
    return hasattr(energy, "largest_step")


def reach(energies: Iterable[Energy], p: Positions, direction: Positions) -> float:
    """Return the largest collision-free step size up to 1 from p along a direction, both (n, 3) [m]."""
    return min((energy.largest_step(p, direction) for energy in energies if is_bounded(energy)), default=1.0)


def without_bounded(system: System) -> System:
    """Return the system without barrier energies; the system itself if it has none."""
    kept = tuple(energy for energy in system.energies if not is_bounded(energy))
    return system if len(kept) == len(system.energies) else replace(system, energies=kept)

"""Energies that no step may pass through: infinite beyond some surface in the space of positions.

A method that moves from p along a direction goes no farther than `reach` says, at each iterate; then it stays on the
side where it began. The line search of the descent methods does so (`solvers.core.descent.search`), the accelerated
ones shorten their trials (`solvers.core.acceleration`). What comes from elsewhere, free fall or a first guess, is
taken where the straight way to it is free.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from solvers.problem import Energy, Positions, System


class PairBlocks(Protocol):
    """Second derivatives of pairs of few vertices. vertices (a, k); values (a, 3k, 3k) [N/m]."""

    @property
    def vertices(self) -> NDArray[np.int64]:
        """Of each pair, (a, k)."""
        ...

    @property
    def values(self) -> NDArray[np.float64]:
        """Of each pair, (a, 3k, 3k)."""
        ...

    def of(self, values: NDArray[np.float64]) -> PairBlocks:
        """The same pairs with other values."""
        ...

    def add_product(self, x: Positions, out: Positions) -> None:
        """Add their product with x (n, 3) to `out`."""
        ...

    def add(self, places: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add them to blocks (b, 3, 3), at places (a, k^2); -1 for none."""
        ...


@runtime_checkable
class Bounded(Energy, Protocol):
    """An energy that is infinite beyond a surface, whose pairs of vertices change with the positions."""

    def largest_step(self, p: Positions, direction: Positions) -> float:
        """The largest t up to 1 by which p may go along a direction, both (n, 3) [m]."""
        ...

    def carried(self, p: Positions, direction: Positions, begin: float) -> float:
        """The largest part of what is left of the step by which p may go along a direction, both (n, 3) [m], while
        obstacles go on from the part `begin` of their way in it."""
        ...

    def at_part(self, part: float) -> Bounded:
        """The same with obstacles at a part of their way in the step, 1 at its end."""
        ...

    def with_obstacles(self, p: Positions) -> list[Positions]:
        """Where p (n, 3) [m] would be at the step's end, were it to move with each of the obstacles that move."""
        ...

    def neighbours(self, p: Positions) -> NDArray[np.int64]:
        """Vertices (a, k) of all pairs at p (n, 3), and of those that may come not far from there; -1 for none."""
        ...

    def coupled(self, p: Positions) -> NDArray[np.int64]:
        """The vertices (a, k) of each block at p (n, 3); -1 for none."""
        ...

    def add_curvature(self, p: Positions, keep: float, places: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add the blocks at p (n, 3) to those of a matrix, (b, 3, 3) [N/m], at places (a, k^2); -1 for none."""
        ...

    def blocks(self, p: Positions, keep: float = 1.0) -> PairBlocks:
        """The second derivatives at p (n, 3); keep: of what bends downwards, 0 leaves them positive semidefinite."""
        ...


def is_bounded(energy: Energy) -> TypeGuard[Bounded]:
    """Whether no step may pass through an energy."""
    return hasattr(energy, "largest_step")


def reach(energies: Iterable[Energy], p: Positions, direction: Positions) -> float:
    """The largest t up to 1 by which p may go along a direction, both (n, 3) [m], for all of the energies."""
    return min((energy.largest_step(p, direction) for energy in energies if is_bounded(energy)), default=1.0)


def without_bounded(system: System) -> System:
    """The same system without such energies; itself where it has none."""
    kept = tuple(energy for energy in system.energies if not is_bounded(energy))
    return system if len(kept) == len(system.energies) else replace(system, energies=kept)

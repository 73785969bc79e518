"""Barrier energies, which are infinite beyond a surface and therefore limit the step size.

The surface is in the space of positions. A method that moves from p along a search direction limits the step size to
`max_step_size` at each iterate, so that it stays on the side on which it started. The line search of the descent
methods does this (`springbench.solvers.iteration.descent_method.backtracking_line_search`); the accelerated methods
shorten their trial steps (`springbench.solvers.methods.local_global.accelerated_local_global`). Positions from another
source, such as the inertial prediction or an initial guess, are accepted if the straight path to them is free of
collisions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Energy, Positions, StepProblem, System


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

    def with_values(self, values: NDArray[np.float64]) -> PairBlocks:
        """Return blocks of the same pairs with other values."""
        ...

    def add_product(self, x: Positions, out: Positions) -> None:
        """Add the product of the blocks with x to `out`.

        Args:
            x: displacements (n, 3) [m].
            out: sum of products (n, 3) [N], updated.
        """
        ...

    def add_blocks(self, block_indices: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add the blocks to a matrix.

        Args:
            block_indices: block of the matrix for each pair of a row's vertices (a, k^2), -1 for none.
            values: blocks of the matrix (b, 3, 3) [N/m], updated.
        """
        ...


@runtime_checkable
class BarrierEnergy(Energy, Protocol):
    """An energy, infinite beyond a surface, whose active vertex pairs depend on the positions."""

    def collision_free_step_size(self, p: Positions, direction: Positions) -> float:
        """Return the largest collision-free step size up to 1 from p along a direction.

        Args:
            p: positions (n, 3) [m].
            direction: displacements (n, 3) [m] at a step size of 1.
        """
        ...

    def collision_free_step_size_moving(self, p: Positions, direction: Positions, start_fraction: float) -> float:
        """Return the largest collision-free step size up to 1 while obstacles move.

        The obstacles move through the remaining part of the step.

        Args:
            p: positions (n, 3) [m].
            direction: displacement (n, 3) [m] over the remaining part of the step.
            start_fraction: fraction of the step, in [0, 1], at which the obstacles start.
        """
        ...

    def at_fraction(self, fraction: float) -> BarrierEnergy:
        """Return this energy with obstacles at a fraction of their displacement in the step.

        The fraction is 1 at the end of the step.
        """
        ...

    def comoving_positions(self, p: Positions) -> list[Positions]:
        """Return the end positions of p (n, 3) [m] under the rigid motion of each moving obstacle."""
        ...

    def candidate_vertices(self, p: Positions) -> NDArray[np.int64]:
        """Return the vertices (a, k) of all candidate pairs at and near p (n, 3).

        The index -1 means none.
        """
        ...

    def block_vertices(self, p: Positions) -> NDArray[np.int64]:
        """Return the vertices (a, k) of each Hessian block at p (n, 3); -1 for none."""
        ...

    def add_hessian_blocks(
        self, p: Positions, negative_fraction: float, block_indices: NDArray[np.int64], values: NDArray[np.float64]
    ) -> None:
        """Add the Hessian blocks at p (n, 3) to a matrix.

        Args:
            p: positions (n, 3) [m].
            negative_fraction: factor of the blocks' negative part.
            block_indices: (a, k^2), -1 for none.
            values: matrix blocks (b, 3, 3) [N/m].
        """
        ...

    def hessian_blocks(self, p: Positions, negative_fraction: float = 1.0) -> PairBlocks:
        """Return the Hessian blocks of the active pairs at p.

        Args:
            p: positions (n, 3) [m].
            negative_fraction: factor of the blocks' negative part; 0 makes them positive semidefinite.
        """
        ...


def is_barrier_energy(energy: Energy) -> TypeGuard[BarrierEnergy]:
    """Return whether an energy is a barrier that limits the step size."""
    return hasattr(energy, "collision_free_step_size")


def max_step_size(energies: Iterable[Energy], p: Positions, direction: Positions) -> float:
    """Return the largest step size up to 1 that is collision-free for all energies.

    Args:
        energies: energies of a step, of which only barriers limit the step size.
        p: positions (n, 3) [m].
        direction: displacements (n, 3) [m] at a step size of 1.
    """
    return min(
        (energy.collision_free_step_size(p, direction) for energy in energies if is_barrier_energy(energy)), default=1.0
    )


def without_barriers(system: System) -> System:
    """Return the system without barrier energies; the system itself if it has none."""
    remaining = tuple(energy for energy in system.energies if not is_barrier_energy(energy))
    return system if len(remaining) == len(system.energies) else replace(system, energies=remaining)


def ignore_barriers(problem: StepProblem) -> StepProblem:
    """Return the problem without barrier energies; the problem itself if it has none."""
    system = without_barriers(problem.system)
    return problem if system is problem.system else replace(problem, system=system)

"""The matrix of a step with barrier energies, whose blocks change with the positions."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from springbench.solvers.model.barrier_energy import BarrierEnergy, PairBlocks
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.hessian_pattern import BlockMatrix, IndexArray


class StepMatrix:
    """The matrix of a step's Hessians.

    When a block outside the common pattern is first needed, the pattern is extended by it and by the blocks that may
    be needed nearby. The extended pattern is reused as long as it suffices, usually to the end of the step.
    """

    def __init__(
        self,
        fixed_objective: FixedObjective,
        barrier_energies: list[BarrierEnergy],
        pattern_positions: Positions | None = None,
    ) -> None:
        """Create the matrix, with the pattern of the objective until a step needs more blocks.

        Args:
            fixed_objective: the objective, without the pairs of barriers.
            barrier_energies: barriers whose candidate pairs extend the pattern.
            pattern_positions: positions (n, 3) [m] near which the first extension finds its pairs; None for p itself.
        """
        self._fixed_objective, self._barrier_energies = fixed_objective, barrier_energies
        self._pattern_positions = pattern_positions
        self._cached_matrix: BlockMatrix | None = None

    def matrix_at(self, p: Positions, i: IndexArray, j: IndexArray, block_vertices: list[IndexArray]) -> BlockMatrix:
        """Return the matrix at p with blocks (i, j) and those of each barrier energy.

        Args:
            p: positions (n, 3) [m], near which the pattern is extended if it does not suffice.
            i, j: rows and columns of blocks (k,), by index among the free vertices.
            block_vertices: vertices (a, k) of the blocks of each barrier energy at p, -1 for none.
        """
        known = self._cached_matrix or self._fixed_objective.hessian_matrix
        if not _covers_blocks(known, i, j, block_vertices) and self._pattern_positions is not None:
            known = self._cached_matrix = self._extend_matrix(known, i, j, self._pattern_positions)
            self._pattern_positions = None
        if not _covers_blocks(known, i, j, block_vertices):
            known = self._cached_matrix = self._extend_matrix(known, i, j, p)
        return known

    def _extend_matrix(self, known: BlockMatrix, i: IndexArray, j: IndexArray, p: Positions) -> BlockMatrix:
        """Return a matrix with the blocks of another one and additional blocks.

        These are the blocks (i, j) and those that may be needed near p.
        """
        near = (
            self._fixed_objective.free_vertex_pairs(energy.candidate_vertices(p)) for energy in self._barrier_energies
        )
        i, j = (np.concatenate(side) for side in zip(known.block_coordinates, (i, j), *near, strict=True))
        return self._fixed_objective.matrix_with_blocks(i, j)


def _covers_blocks(matrix: BlockMatrix, i: IndexArray, j: IndexArray, block_vertices: list[IndexArray]) -> bool:
    """Return whether a matrix has blocks (i, j) and those of barrier energies."""
    return matrix.has_blocks(i, j) and all(
        matrix.has_element_blocks(-1 - k, vertices) for k, vertices in enumerate(block_vertices)
    )


class BarrierHessian:
    """The Hessian blocks of barrier energies at a point."""

    def __init__(self, energies: list[BarrierEnergy], p: Positions) -> None:
        self._barrier_energies, self._positions = energies, p

    @cached_property
    def pair_blocks(self) -> list[PairBlocks]:
        """Exact blocks of each energy."""
        return [energy.hessian_blocks(self._positions) for energy in self._barrier_energies]

    @cached_property
    def block_vertices(self) -> list[IndexArray]:
        """Vertices (a, k) of the blocks of each energy."""
        return [energy.block_vertices(self._positions) for energy in self._barrier_energies]

    def add_to_matrix(self, negative_fraction: float, matrix: BlockMatrix) -> None:
        """Add the blocks to the matrix, with a fraction of their negative parts.

        Args:
            negative_fraction: factor of the blocks' negative part; 0 makes them positive semidefinite.
            matrix: matrix that has all blocks between `block_vertices`; its values are updated.
        """
        for k, (energy, vertices) in enumerate(zip(self._barrier_energies, self.block_vertices, strict=True)):
            if len(vertices):
                indices = matrix.element_block_indices(-1 - k, vertices)
                energy.add_hessian_blocks(self._positions, negative_fraction, indices, matrix.values)

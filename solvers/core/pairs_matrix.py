"""The matrix of a step with barrier energies, whose blocks change with the positions."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from solvers.core.bounds import Bounded, PairBlocks
from solvers.core.fixed_objective import Objective
from solvers.core.pattern import Indices, Matrix
from solvers.problem import Positions


class StepMatrix:
    """The matrix of a step's Hessians.

    Blocks outside the common pattern, and those that may be needed near the positions where this first occurs, are
    analysed once. The result is valid as long as it suffices, usually to the end of the step.
    """

    def __init__(self, whole: Objective, bounded: list[Bounded]) -> None:
        self._whole, self._bounded = whole, bounded
        self._known: Matrix | None = None

    def at(self, p: Positions, i: Indices, j: Indices, met: list[Indices]) -> Matrix:
        """Return the matrix at p with blocks (i, j) of free vertices and the blocks of each barrier energy.

        The latter are between the vertices `met` (a, k).
        """
        known = self._known or self._whole.matrix
        if not (known.has(i, j) and all(known.holds(-1 - k, vertices) for k, vertices in enumerate(met))):
            near = (self._whole.between(energy.neighbours(p)) for energy in self._bounded)
            i, j = (np.concatenate(side) for side in zip(known.blocks, (i, j), *near, strict=True))
            known = self._known = self._whole.matrix_for(i, j)
        return known


class PairsAt:
    """The Hessian blocks of barrier energies at a point."""

    def __init__(self, energies: list[Bounded], p: Positions) -> None:
        self._energies, self._p = energies, p
        self._ends: dict[float, NDArray[np.float64]] = {}

    @cached_property
    def blocks(self) -> list[PairBlocks]:
        """Exact blocks of each energy."""
        return [energy.blocks(self._p) for energy in self._energies]

    @cached_property
    def coupled(self) -> list[Indices]:
        """Vertices (a, k) of the blocks of each energy."""
        return [energy.coupled(self._p) for energy in self._energies]

    def add(self, keep: float, matrix: Matrix) -> None:
        """Add the blocks to the matrix.

        They are linear in the fraction of their negative part.
        """
        if any(map(len, self.coupled)):
            for end, share in ((1.0, keep), (0.0, 1.0 - keep)):
                if share:
                    matrix.values += share * self._at(end, matrix)

    def _at(self, end: float, matrix: Matrix) -> NDArray[np.float64]:
        if end not in self._ends:
            out = self._ends[end] = np.zeros_like(matrix.values)
            for k, (energy, vertices) in enumerate(zip(self._energies, self.coupled, strict=True)):
                energy.add_curvature(self._p, end, matrix.of_elements(-1 - k, vertices), out)
        return self._ends[end]

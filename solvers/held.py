"""Constraints of a system that are not energies: Dirichlet conditions of vertices, and fixed lengths."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Pins:
    """Dirichlet conditions: `vertices` (q,), sorted and unique; `weight` (q,) [N/m], infinite for an exact pin."""

    vertices: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    weight: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    @property
    def exact(self) -> NDArray[np.bool_]:
        """Mask of the pins that are eliminated instead of penalised, shape (q,)."""
        return np.isinf(self.weight)


@dataclass(frozen=True, slots=True, eq=False)
class Lengths:
    """Length constraints that hold exactly, from springs and strain limits of infinite stiffness.

    Attributes:
        edges: (m, 2).
        low, high: bounds of the lengths (m,) [m], 0 <= low <= high, 0 < high; equal for an inextensible
            spring.
        rest_direction: (m, 3), unit directions of edges of zero length.
    """

    edges: NDArray[np.int64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

"""What a system holds by no energy: vertices that are pinned, and lengths that do not change."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Pins:
    """Pinned vertices: `vertices` (q,), sorted and unique; `weight` (q,) [N/m], infinite for an exact pin."""

    vertices: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    weight: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    @property
    def exact(self) -> NDArray[np.bool_]:
        """Which pins are eliminated rows instead of penalties, shape (q,)."""
        return np.isinf(self.weight)


@dataclass(frozen=True, slots=True, eq=False)
class Lengths:
    """Distances that are kept exactly: what springs and strain limits of infinite stiffness are.

    edges: (m, 2); low, high: the lengths allowed (m,) [m], 0 <= low <= high, 0 < high; equal where a spring is
    inextensible; rest_direction: (m, 3), unit vectors that edges of zero length take.
    """

    edges: NDArray[np.int64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

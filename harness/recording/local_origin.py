"""Local origin of stored positions, so that single precision resolves a mesh far from (0, 0, 0).

    stored = float32(p - origin),  origin = cell round(centre / cell)

`cell` is the smallest power of two of at least 8 diagonals of the mesh at rest, so the origin is zero for meshes near
zero. The round-off is 2^-24 of the distance from the origin, not of the distance from zero.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Positions

ORIGIN_PROPERTY = "origin"
"""Property of a recording that states its origin [m] in JSON; absent where the origin is zero."""

_MAX_CELL = 2.0**1000
"""Maximum cell size [m]: the origin of a larger mesh is zero, since cells would overflow."""

MIN_DIAGONALS_PER_CELL = 8.0
"""Minimum cell size, in diagonals of the mesh."""


def compute_local_origin(rest: Positions) -> NDArray[np.float64]:
    """Return the origin (3,) [m] for a mesh with rest positions (n, 3) [m]."""
    low, high = rest.min(axis=0), rest.max(axis=0)
    with np.errstate(over="ignore"):
        size = MIN_DIAGONALS_PER_CELL * math.hypot(*(high - low)) or 1.0  # a single point has no diagonal
    if not size < _MAX_CELL:
        return np.zeros(3)
    cell = 2.0 ** math.ceil(math.log2(size))
    return cell * np.rint((low / 2 + high / 2) / cell) + 0.0  # no negative zero


def store_relative(p: Positions, origin: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return positions relative to the origin, in single precision.

    Args:
        p: positions (n, 3) [m].
        origin: local origin (3,) [m].
    """
    with np.errstate(over="ignore"):
        return (p - origin).astype(np.float32)


def build_origin_property(origin: NDArray[np.float64]) -> dict[str, str]:
    """Return the property that states an origin; empty where the origin is zero."""
    return {ORIGIN_PROPERTY: json.dumps(origin.tolist())} if origin.any() else {}


def read_origin(properties: Mapping[str, object]) -> NDArray[np.float64]:
    """Return the origin (3,) [m] stated by a recording's properties."""
    return np.array(json.loads(str(properties.get(ORIGIN_PROPERTY, "[0, 0, 0]"))), np.float64)

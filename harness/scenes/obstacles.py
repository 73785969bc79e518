"""Analytic obstacles: planes, spheres, capsules and boxes, at rest or moving along key frames."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, model_validator

from harness.base.model import Model, Vector
from harness.scenes.motion import KeyedMotion
from solvers.contact.energy import Obstacle

Array = NDArray[np.float64]
Length = Annotated[PositiveFloat, Field(le=1e9)]


class _Moving(Model):
    motion: KeyedMotion | None = None
    """Key frames of the obstacle's motion; it stays solid at any speed."""

    def _obstacle(self, origin: Vector, axes: Array, low: Array, high: Array, radius: float) -> Obstacle:
        """Build a rounded box with the given axes (3, 3), one per row."""
        frame = np.concatenate([[origin], axes])
        motion = self.motion
        if motion is None:
            return Obstacle(low, high, radius, lambda time: frame)

        @lru_cache(maxsize=2)  # a step's end is the start of the next one
        def moved(time: float) -> Array:
            o, *ends = motion.moved(np.concatenate([frame[:1], frame[:1] + axes]), time)
            return np.concatenate([[o], np.array(ends) - o])

        return Obstacle(low, high, radius, moved)


class Plane(_Moving):
    """An infinite plane, solid below."""

    kind: Literal["plane"] = "plane"
    point: Vector = (0.0, 0.0, 0.0)
    """Any point of the plane [m]."""
    normal: Vector = (0.0, 1.0, 0.0)
    """Outward normal, of any length but zero."""

    @model_validator(mode="after")
    def _directed(self) -> Plane:
        if not any(self.normal):
            raise ValueError("the normal should have a direction; it is zero")
        return self

    def obstacle(self) -> Obstacle:
        """Return the obstacle in the solvers' form."""
        low, high = np.full(3, -np.inf), np.array([np.inf, 0.0, np.inf])
        return self._obstacle(self.point, _about(self.normal), low, high, 0.0)


class Sphere(_Moving):
    """A ball."""

    kind: Literal["sphere"] = "sphere"
    center: Vector = (0.0, 0.0, 0.0)
    """Centre [m]."""
    radius: Length
    """Radius [m]."""

    def obstacle(self) -> Obstacle:
        """Return the obstacle in the solvers' form."""
        return self._obstacle(self.center, np.eye(3), np.zeros(3), np.zeros(3), self.radius)


class Capsule(_Moving):
    """All points within a radius of a segment."""

    kind: Literal["capsule"] = "capsule"
    ends: tuple[Vector, Vector]
    """Two distinct ends of the segment [m]."""
    radius: Length
    """Radius [m]."""

    @model_validator(mode="after")
    def _long(self) -> Capsule:
        if self.ends[0] == self.ends[1]:
            raise ValueError("the ends should lie apart; use a sphere")
        return self

    def obstacle(self) -> Obstacle:
        """Return the obstacle in the solvers' form."""
        first, last = self.ends
        x, y, z = np.array(last) - first
        high = np.array([0.0, np.linalg.norm([x, y, z]), 0.0])
        return self._obstacle(first, _about((x, y, z)), np.zeros(3), high, self.radius)


class Box(_Moving):
    """An axis-parallel box; a motion with one key frame rotates it."""

    kind: Literal["box"] = "box"
    low: Vector
    """The corner with the smallest coordinates [m]."""
    high: Vector
    """The corner with the largest coordinates [m]."""

    @model_validator(mode="after")
    def _solid(self) -> Box:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError("each coordinate of `high` should lie above that of `low`")
        return self

    def obstacle(self) -> Obstacle:
        """Return the obstacle in the solvers' form."""
        return self._obstacle((0.0, 0.0, 0.0), np.eye(3), np.array(self.low), np.array(self.high), 0.0)


AnyObstacle = Annotated[Plane | Sphere | Capsule | Box, Field(discriminator="kind")]


def _about(direction: Vector) -> Array:
    """Build right-handed orthonormal axes (3, 3), the second along a direction."""
    y = np.array(direction) / np.linalg.norm(direction)
    x = np.cross(y, np.eye(3)[np.abs(y).argmin()])
    x /= np.linalg.norm(x)
    return np.array([x, y, np.cross(x, y)], np.float64)

"""Analytic obstacles: planes, spheres, capsules and boxes, at rest or moving along key frames."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, model_validator
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.harness.schema.base_model import ConfigModel, Vector3
from springbench.solvers.contact.half_space.half_space_potential import ConvexObstacle

FloatArray = NDArray[np.float64]
ObstacleLength = Annotated[PositiveFloat, Field(le=1e9)]


class _MovingObstacle(ConfigModel):
    motion: KeyFrameMotion | None = None
    """Key frames of the obstacle's motion; it stays solid at any speed."""

    def _build_rounded_box(
        self, origin: Vector3, axes: FloatArray, low: FloatArray, high: FloatArray, radius: float
    ) -> ConvexObstacle:
        """Build a rounded box with the given axes (3, 3), one per row."""
        frame = np.concatenate([[origin], axes])
        motion = self.motion
        if motion is None:
            return ConvexObstacle(low, high, radius, lambda time: frame)

        @lru_cache(maxsize=2)  # a step's end is the start of the next one
        def move_frame(time: float) -> FloatArray:
            o, *ends = motion.transform_points(np.concatenate([frame[:1], frame[:1] + axes]), time)
            return np.concatenate([[o], np.array(ends) - o])

        return ConvexObstacle(low, high, radius, move_frame)


class PlaneObstacle(_MovingObstacle):
    """An infinite plane, solid below."""

    kind: Literal["plane"] = "plane"
    point: Vector3 = (0.0, 0.0, 0.0)
    """Any point of the plane [m]."""
    normal: Vector3 = (0.0, 1.0, 0.0)
    """Outward normal, of any length but zero."""

    @model_validator(mode="after")
    def _check_normal(self) -> PlaneObstacle:
        if not any(self.normal):
            raise ValueError("the normal should have a direction; it is zero")
        return self

    def build_obstacle(self) -> ConvexObstacle:
        """Return the obstacle in the solvers' form."""
        low, high = np.full(3, -np.inf), np.array([np.inf, 0.0, np.inf])
        return self._build_rounded_box(self.point, _orthonormal_axes(self.normal), low, high, 0.0)


class SphereObstacle(_MovingObstacle):
    """A ball."""

    kind: Literal["sphere"] = "sphere"
    center: Vector3 = (0.0, 0.0, 0.0)
    """Centre [m]."""
    radius: ObstacleLength
    """Radius [m]."""

    def build_obstacle(self) -> ConvexObstacle:
        """Return the obstacle in the solvers' form."""
        return self._build_rounded_box(self.center, np.eye(3), np.zeros(3), np.zeros(3), self.radius)


class CapsuleObstacle(_MovingObstacle):
    """All points within a radius of a segment."""

    kind: Literal["capsule"] = "capsule"
    end_points: tuple[Vector3, Vector3]
    """Two distinct ends of the segment [m]."""
    radius: ObstacleLength
    """Radius [m]."""

    @model_validator(mode="after")
    def _check_ends(self) -> CapsuleObstacle:
        if self.end_points[0] == self.end_points[1]:
            raise ValueError("the ends should lie apart; use a sphere")
        return self

    def build_obstacle(self) -> ConvexObstacle:
        """Return the obstacle in the solvers' form."""
        first, last = self.end_points
        x, y, z = np.array(last) - first
        high = np.array([0.0, np.linalg.norm([x, y, z]), 0.0])
        return self._build_rounded_box(first, _orthonormal_axes((x, y, z)), np.zeros(3), high, self.radius)


class BoxObstacle(_MovingObstacle):
    """An axis-parallel box; a motion with one key frame rotates it."""

    kind: Literal["box"] = "box"
    low: Vector3
    """The corner with the smallest coordinates [m]."""
    high: Vector3
    """The corner with the largest coordinates [m]."""

    @model_validator(mode="after")
    def _check_corners(self) -> BoxObstacle:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError("each coordinate of `high` should lie above that of `low`")
        return self

    def build_obstacle(self) -> ConvexObstacle:
        """Return the obstacle in the solvers' form."""
        return self._build_rounded_box((0.0, 0.0, 0.0), np.eye(3), np.array(self.low), np.array(self.high), 0.0)


AnyObstacle = Annotated[PlaneObstacle | SphereObstacle | CapsuleObstacle | BoxObstacle, Field(discriminator="kind")]


def _orthonormal_axes(direction: Vector3) -> FloatArray:
    """Build right-handed orthonormal axes (3, 3), the second along a direction."""
    y = np.array(direction) / np.linalg.norm(direction)
    x = np.cross(y, np.eye(3)[np.abs(y).argmin()])
    x /= np.linalg.norm(x)
    return np.array([x, y, np.cross(x, y)], np.float64)

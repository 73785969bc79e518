"""How a simulation starts where it does not start at rest: other positions, and a spin.

A start is a map of the rest positions (n, 3) [m]; `c` is their mean. The velocity of a vertex at p is that of the scene
and spin x (p - c'), c' the mean of the positions at the start.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, model_validator

from harness.base.errors import InputError, Mistake
from harness.base.model import Many, Model, Vector
from solvers.problem import Positions

_AXES = {"x": 0, "y": 1, "z": 2}
Axis = Literal["x", "y", "z"]


class Rest(Model):
    """The rest shape, which may spin."""

    kind: Literal["rest"] = "rest"
    spin: Vector = (0.0, 0.0, 0.0)
    """Angular velocity about the mean of the positions [rad/s]."""

    def positions(self, rest: Positions) -> Positions:
        """The positions at the start (n, 3) [m] from those at rest; raises InputError for what the mesh lacks."""
        return rest

    def velocity(self, p: Positions) -> Positions:
        """The velocity (n, 3) [m/s] of the spin at positions p (n, 3) [m]."""
        return np.cross(self.spin, p - p.mean(axis=0))


class Collapsed(Rest):
    """All vertices in one point, the mean of the rest positions."""

    kind: Literal["collapsed"] = "collapsed"  # pyright: ignore[reportIncompatibleVariableOverride]

    def positions(self, rest: Positions) -> Positions:
        """See Rest."""
        return np.tile(rest.mean(axis=0), (len(rest), 1))


class Flattened(Rest):
    """Flattened to a plane or, along two axes, to a line."""

    kind: Literal["flattened"] = "flattened"  # pyright: ignore[reportIncompatibleVariableOverride]
    along: Many[Axis]
    """The coordinates that all vertices have in common."""

    def positions(self, rest: Positions) -> Positions:
        """See Rest."""
        p, columns = rest.copy(), [_AXES[axis] for axis in self.along]
        p[:, columns] = rest[:, columns].mean(axis=0)
        return p


class Scaled(Rest):
    """c + factors (p - c): smaller, larger, mirrored where a factor is negative."""

    kind: Literal["scaled"] = "scaled"  # pyright: ignore[reportIncompatibleVariableOverride]
    factors: Vector
    """Along x, y and z."""

    def positions(self, rest: Positions) -> Positions:
        """See Rest."""
        c = rest.mean(axis=0)
        return c + np.array(self.factors) * (rest - c)


class Random(Rest):
    """Each vertex anywhere in a cube about c, uniformly (as Chen et al. 2024 start vertex block descent)."""

    kind: Literal["random"] = "random"  # pyright: ignore[reportIncompatibleVariableOverride]
    side: PositiveFloat
    """The side of the cube [m]."""
    seed: NonNegativeInt = 0

    def positions(self, rest: Positions) -> Positions:
        """See Rest."""
        shift = np.random.default_rng(self.seed).uniform(-0.5, 0.5, rest.shape)
        return rest.mean(axis=0) + self.side * shift


class Perturbed(Rest):
    """Each coordinate moved by a normal random number."""

    kind: Literal["perturbed"] = "perturbed"  # pyright: ignore[reportIncompatibleVariableOverride]
    deviation: PositiveFloat
    """Its standard deviation [m]."""
    seed: NonNegativeInt = 0

    def positions(self, rest: Positions) -> Positions:
        """See Rest."""
        return rest + self.deviation * np.random.default_rng(self.seed).normal(size=rest.shape)


class Merged(Rest):
    """Some vertices in the place of another."""

    kind: Literal["merged"] = "merged"  # pyright: ignore[reportIncompatibleVariableOverride]
    vertices: tuple[NonNegativeInt, ...] = Field(min_length=2)
    """The vertex that stays, and those that are put on it."""

    @model_validator(mode="after")
    def _differ(self) -> Merged:
        if len(set(self.vertices)) < len(self.vertices):
            raise ValueError("names a vertex twice")
        return self

    def positions(self, rest: Positions) -> Positions:
        """See Rest."""
        if max(self.vertices) >= len(rest):
            problem = f"came {max(self.vertices)}; the mesh has the vertices 0 to {len(rest) - 1}"
            raise InputError(Mistake(problem, key="start.vertices"))
        p = rest.copy()
        p[list(self.vertices[1:])] = rest[self.vertices[0]]
        return p


AnyStart = Annotated[Rest | Collapsed | Flattened | Scaled | Random | Perturbed | Merged, Field(discriminator="kind")]
"""A start as a scene declares it; its `kind` says which."""

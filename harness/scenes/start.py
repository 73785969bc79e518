"""Initial states that differ from the rest state: other positions, and a spin.

A start maps the rest positions (n, 3) [m] to initial positions; `c` is their mean. The velocity of a vertex at p is
that of the scene plus spin x (p - c'), where c' is the mean of the initial positions.
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
    """The rest shape, optionally with a spin."""

    kind: Literal["rest"] = "rest"
    spin: Vector = (0.0, 0.0, 0.0)
    """Angular velocity about the mean position [rad/s]."""

    def positions(self, rest: Positions) -> Positions:
        """Return the initial positions (n, 3) [m]; raise InputError if the mesh lacks a named vertex."""
        return rest

    def velocity(self, p: Positions) -> Positions:
        """Return the velocity of the spin (n, 3) [m/s] at positions p (n, 3) [m]."""
        return np.cross(self.spin, p - p.mean(axis=0))


class Collapsed(Rest):
    """All vertices at one point, the mean of the rest positions."""

    kind: Literal["collapsed"] = "collapsed"  # pyright: ignore[reportIncompatibleVariableOverride]

    def positions(self, rest: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        return np.tile(rest.mean(axis=0), (len(rest), 1))


class Flattened(Rest):
    """Flattened to a plane or, with two axes, to a line."""

    kind: Literal["flattened"] = "flattened"  # pyright: ignore[reportIncompatibleVariableOverride]
    along: Many[Axis]
    """Coordinates that are set to their mean for all vertices."""

    def positions(self, rest: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        p, columns = rest.copy(), [_AXES[axis] for axis in self.along]
        p[:, columns] = rest[:, columns].mean(axis=0)
        return p


class Scaled(Rest):
    """c + factors (p - c): shrunk, enlarged, or mirrored for a negative factor."""

    kind: Literal["scaled"] = "scaled"  # pyright: ignore[reportIncompatibleVariableOverride]
    factors: Vector
    """Factors along x, y and z."""

    def positions(self, rest: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        c = rest.mean(axis=0)
        return c + np.array(self.factors) * (rest - c)


class Random(Rest):
    """Vertices at uniformly random points of a cube about c.

    Chen et al. 2024 use this start for vertex block descent.
    """

    kind: Literal["random"] = "random"  # pyright: ignore[reportIncompatibleVariableOverride]
    side: PositiveFloat
    """Side of the cube [m]."""
    seed: NonNegativeInt = 0

    def positions(self, rest: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        shift = np.random.default_rng(self.seed).uniform(-0.5, 0.5, rest.shape)
        return rest.mean(axis=0) + self.side * shift


class Perturbed(Rest):
    """Each coordinate perturbed by a normal random number."""

    kind: Literal["perturbed"] = "perturbed"  # pyright: ignore[reportIncompatibleVariableOverride]
    deviation: PositiveFloat
    """Standard deviation [m]."""
    seed: NonNegativeInt = 0

    def positions(self, rest: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        return rest + self.deviation * np.random.default_rng(self.seed).normal(size=rest.shape)


class Merged(Rest):
    """Some vertices moved to the position of another."""

    kind: Literal["merged"] = "merged"  # pyright: ignore[reportIncompatibleVariableOverride]
    vertices: tuple[NonNegativeInt, ...] = Field(min_length=2)
    """The vertex that stays, followed by those that are moved to it."""

    @model_validator(mode="after")
    def _differ(self) -> Merged:
        if len(set(self.vertices)) < len(self.vertices):
            raise ValueError("names a vertex twice")
        return self

    def positions(self, rest: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        if max(self.vertices) >= len(rest):
            problem = f"came {max(self.vertices)}; the mesh has the vertices 0 to {len(rest) - 1}"
            raise InputError(Mistake(problem, key="start.vertices"))
        p = rest.copy()
        p[list(self.vertices[1:])] = rest[self.vertices[0]]
        return p


AnyStart = Annotated[Rest | Collapsed | Flattened | Scaled | Random | Perturbed | Merged, Field(discriminator="kind")]
"""A start as declared by a scene; `kind` selects its type."""

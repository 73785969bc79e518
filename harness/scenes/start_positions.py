"""Initial states that differ from the rest state: other positions, and a spin.

A start maps the rest positions (n, 3) [m] to initial positions; `c` is their mean. The velocity of a vertex at p is
that of the scene plus spin x (p - c'), where c' is the mean of the initial positions.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, model_validator
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.schema.base_model import ConfigModel, OneOrMany, Vector3
from springbench.solvers.model.step_problem import Positions

_AXES = {"x": 0, "y": 1, "z": 2}
AxisName = Literal["x", "y", "z"]


class RestStart(ConfigModel):
    """The rest shape, optionally with a spin."""

    kind: Literal["rest"] = "rest"
    angular_velocity: Vector3 = (0.0, 0.0, 0.0)
    """Angular velocity about the mean position [rad/s]."""

    def compute_positions(self, rest_positions: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m].

        Raises:
            InputError: if the mesh lacks a named vertex.
        """
        return rest_positions

    def compute_spin_velocity(self, p: Positions) -> Positions:
        """Return the velocity of the spin (n, 3) [m/s] at positions p (n, 3) [m]."""
        return np.cross(self.angular_velocity, p - p.mean(axis=0))


class CollapsedStart(RestStart):
    """All vertices at one point, the mean of the rest positions."""

    kind: Literal["collapsed"] = "collapsed"  # pyright: ignore[reportIncompatibleVariableOverride]

    def compute_positions(self, rest_positions: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        return np.tile(rest_positions.mean(axis=0), (len(rest_positions), 1))


class FlattenedStart(RestStart):
    """Flattened to a plane or, with two axes, to a line."""

    kind: Literal["flattened"] = "flattened"  # pyright: ignore[reportIncompatibleVariableOverride]
    axes: OneOrMany[AxisName]
    """Coordinates that are set to their mean for all vertices."""

    def compute_positions(self, rest_positions: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        p, columns = rest_positions.copy(), [_AXES[axis] for axis in self.axes]
        p[:, columns] = rest_positions[:, columns].mean(axis=0)
        return p


class ScaledStart(RestStart):
    """c + factors (p - c): shrunk, enlarged, or mirrored for a negative factor."""

    kind: Literal["scaled"] = "scaled"  # pyright: ignore[reportIncompatibleVariableOverride]
    factors: Vector3
    """Factors along x, y and z."""

    def compute_positions(self, rest_positions: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        c = rest_positions.mean(axis=0)
        return c + np.array(self.factors) * (rest_positions - c)


class RandomStart(RestStart):
    """Vertices at uniformly random points of a cube about c.

    Chen et al. 2024 use this start for vertex block descent.
    """

    kind: Literal["random"] = "random"  # pyright: ignore[reportIncompatibleVariableOverride]
    side_length: PositiveFloat
    """Side of the cube [m]."""
    seed: NonNegativeInt = 0

    def compute_positions(self, rest_positions: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        shift = np.random.default_rng(self.seed).uniform(-0.5, 0.5, rest_positions.shape)
        return rest_positions.mean(axis=0) + self.side_length * shift


class PerturbedStart(RestStart):
    """Each coordinate perturbed by a normal random number."""

    kind: Literal["perturbed"] = "perturbed"  # pyright: ignore[reportIncompatibleVariableOverride]
    standard_deviation: PositiveFloat
    """Standard deviation [m]."""
    seed: NonNegativeInt = 0

    def compute_positions(self, rest_positions: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        return rest_positions + self.standard_deviation * np.random.default_rng(self.seed).normal(
            size=rest_positions.shape
        )


class MergedStart(RestStart):
    """Some vertices moved to the position of another."""

    kind: Literal["merged"] = "merged"  # pyright: ignore[reportIncompatibleVariableOverride]
    vertices: tuple[NonNegativeInt, ...] = Field(min_length=2)
    """The vertex that stays, followed by those that are moved to it."""

    @model_validator(mode="after")
    def _check_vertices(self) -> MergedStart:
        if len(set(self.vertices)) < len(self.vertices):
            raise ValueError("names a vertex twice")
        return self

    def compute_positions(self, rest_positions: Positions) -> Positions:
        """Return the initial positions (n, 3) [m] from the rest positions (n, 3) [m]."""
        if max(self.vertices) >= len(rest_positions):
            problem = f"got {max(self.vertices)}; the mesh has the vertices 0 to {len(rest_positions) - 1}"
            raise InputError(InputMistake(problem, key="start.vertices"))
        p = rest_positions.copy()
        p[list(self.vertices[1:])] = rest_positions[self.vertices[0]]
        return p


AnyStart = Annotated[
    RestStart | CollapsedStart | FlattenedStart | ScaledStart | RandomStart | PerturbedStart | MergedStart,
    Field(discriminator="kind"),
]
"""A start as declared by a scene; `kind` selects its type."""

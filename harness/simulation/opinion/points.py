"""Sample points of the comparison: random motions and solutions around a scene's start and its rest shape.

They deviate by 1e-3 to 0.5 of the mesh spacing, and move by as much in a step. Where there are obstacles the mesh is
moved to one, so that contact occurs. No step starts with surfaces closer than their minimum distance, since this is
invalid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.scenes.bind import Scene
from harness.simulation.opinion.contact import nearest, radius
from harness.simulation.opinion.declared import Array, Declared
from harness.simulation.opinion.derivatives import wide
from harness.simulation.opinion.motion import place
from harness.simulation.opinion.self_contact import gathered
from harness.simulation.opinion.surface_contact import against, met
from harness.simulation.step import State, start

POINTS = 20
FRACTIONS = (1e-3, 1e-2, 0.1, 0.5)
"""Deviations relative to the mesh spacing."""


@dataclass(frozen=True, eq=False)
class SamplePoint:
    """A sample point of the comparison.

    Attributes:
      state: state that a step starts from.
      shift: displacement (n, 3) [m] of its solution from the position extrapolated with the velocity.
      direction: direction of derivatives (n, 3).
    """

    state: State
    shift: Array
    direction: Array


def points(scene: Scene, declared: Declared, frames: int) -> Iterator[SamplePoint]:
    """Sample the points of a scene, with a fixed seed.

    Steps are any of the scene's frames, and every fifth is the first.

    Args:
      scene: scene that is stepped.
      declared: its declaration.
      frames: number of frames.
    """
    rng, rest = np.random.default_rng(0), scene.mesh.rest
    begun = start(scene).now
    touching = [(effect, one) for effect in declared.of_kind("contact") for one in effect.obstacles]
    apart = declared.of_kind("self-contact")
    beside = [(effect, one) for effect in declared.of_kind("surface-contact") for one in against(effect, declared)]
    # Where there are obstacles, the displacement by forces in a step is limited
    # (`margin` of `solvers.contact.energy`).
    limit = 0.05 * scene.mesh.size if touching else np.inf
    for k in range(POINTS):
        index = 0 if k % 5 == 0 else int(rng.integers(1, max(2, frames)))
        of = scene.at(index)
        dt, some = of.system.time_step, FRACTIONS[k % len(FRACTIONS)] * scene.mesh.spacing
        p = (begun.positions if k // len(FRACTIONS) % 2 == 0 else rest) + some * rng.normal(size=rest.shape)
        if apart:
            p = gathered(apart[0], declared, p)
        v = begun.velocity + some / dt * rng.normal(size=rest.shape)
        if touching:
            effect, one = touching[k % len(touching)]
            p = _brought(effect, one, p, scene.time(index), rng)
        if beside:  # where the obstacle is at the step's start; of four points, it takes the mesh along at two
            times = scene.time(index), scene.time(index) + dt
            p, end = met(beside, k, p, scene.mesh.spacing, times, rng)
            v = v + (k // 2 % 2) * (end - p) / dt
        before = p - dt * v + some * rng.normal(size=rest.shape), v + some / dt * rng.normal(size=rest.shape)
        shift = some * rng.normal(size=rest.shape)
        far = np.linalg.norm(shift, axis=1).max()
        shift *= min(1.0, limit / far) if far else 1.0
        yield SamplePoint(
            State(type(begun)(p, v), type(begun)(*before) if index else None, index, led(k, some / dt**2, rest)),
            shift,
            rng.normal(size=rest.shape),
        )


def led(k: int, size: float, rest: Array) -> Array:
    """Return the random acceleration (n, 3) [m/s^2] of point k.

    Args:
      k: index of the point, used as seed.
      size: standard deviation [m/s^2].
      rest: rest positions (n, 3) [m].
    """
    return size * np.random.default_rng(k).normal(size=rest.shape)


def _brought(effect: Any, one: Any, p: Array, time: float, rng: np.random.Generator) -> Array:
    """Translate positions (n, 3) [m] so that a random vertex is within the contact thickness."""
    at = place(one.motion, time)
    which = int(rng.integers(len(p)))
    far, _, out = nearest(one, at.back(wide(p[which : which + 1])))
    wanted = radius(one) + effect.thickness * rng.uniform()
    return p + np.asarray((wanted - far[0]) * (out @ at.turn.T)[0], float)

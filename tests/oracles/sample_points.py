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
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, build_initial_state

from tests.oracles.complex_step import to_extended
from tests.oracles.half_space_terms import find_nearest, obstacle_radius
from tests.oracles.key_frame_motion import place_at
from tests.oracles.obstacle_terms import build_obstacle_pairs, sample_contact_positions
from tests.oracles.scene_declaration import Array, SceneDeclaration
from tests.oracles.self_contact_terms import contract_to_contact

NUM_POINTS = 20
SPACING_FRACTIONS = (1e-3, 1e-2, 0.1, 0.5)
"""Deviations relative to the mesh spacing."""


@dataclass(frozen=True, eq=False)
class SamplePoint:
    """A sample point of the comparison.

    Attributes:
      state: state that a step starts from.
      shift: displacement (n, 3) [m] of its solution from the position extrapolated with the velocity.
      direction: direction of derivatives (n, 3).
    """

    state: MotionState
    shift: Array
    direction: Array


def sample_points(scene: Scene, declared: SceneDeclaration, frames: int) -> Iterator[SamplePoint]:
    """Sample the points of a scene, with a fixed seed.

    Steps are any of the scene's frames, and every fifth is the first.

    Args:
      scene: scene that is stepped.
      declared: its declaration.
      frames: number of frames.
    """
    rng, rest = np.random.default_rng(0), scene.mesh.rest_positions
    start_motion = build_initial_state(scene).motion
    half_space_obstacles = [(effect, one) for effect in declared.select_effects("contact") for one in effect.obstacles]
    self_contacts = declared.select_effects("self-contact")
    surface_obstacles = [
        (effect, one)
        for effect in declared.select_effects("surface-contact")
        for one in build_obstacle_pairs(effect, declared)
    ]
    # Where there are obstacles, the displacement by forces in a step is limited
    # (`margin` of `springbench.solvers.contact.half_space.half_space_potential`).
    limit = 0.05 * scene.mesh.bounding_box_diagonal if half_space_obstacles else np.inf
    for k in range(NUM_POINTS):
        index = 0 if k % 5 == 0 else int(rng.integers(1, max(2, frames)))
        of = scene.find_step_scene(index)
        dt, size = of.system.time_step, SPACING_FRACTIONS[k % len(SPACING_FRACTIONS)] * scene.mesh.spacing
        p = start_motion.positions if k // len(SPACING_FRACTIONS) % 2 == 0 else rest
        p = p + size * rng.normal(size=rest.shape)
        if self_contacts:
            p = contract_to_contact(self_contacts[0], declared, p)
        v = start_motion.velocity + size / dt * rng.normal(size=rest.shape)
        if half_space_obstacles:
            effect, one = half_space_obstacles[k % len(half_space_obstacles)]
            p = _move_to_obstacle(effect, one, p, scene.compute_time(index), rng)
        if surface_obstacles:  # as they are at the step's start; at two of four points the mesh moves along with one
            times = scene.compute_time(index), scene.compute_time(index) + dt
            p, end = sample_contact_positions(surface_obstacles, k, p, scene.mesh.spacing, times, rng)
            v = v + (k // 2 % 2) * (end - p) / dt
        before = p - dt * v + size * rng.normal(size=rest.shape), v + size / dt * rng.normal(size=rest.shape)
        shift = size * rng.normal(size=rest.shape)
        far = np.linalg.norm(shift, axis=1).max()
        shift *= min(1.0, limit / far) if far else 1.0
        yield SamplePoint(
            MotionState(
                type(start_motion)(p, v),
                type(start_motion)(*before) if index else None,
                index,
                random_acceleration(k, size / dt**2, rest),
            ),
            shift,
            rng.normal(size=rest.shape),
        )


def random_acceleration(k: int, size: float, rest: Array) -> Array:
    """Return the random acceleration (n, 3) [m/s^2] of point k.

    Args:
      k: index of the point, used as seed.
      size: standard deviation [m/s^2].
      rest: rest positions (n, 3) [m].
    """
    return size * np.random.default_rng(k).normal(size=rest.shape)


def _move_to_obstacle(effect: Any, one: Any, p: Array, time: float, rng: np.random.Generator) -> Array:
    """Translate positions (n, 3) [m] so that a random vertex is within the contact thickness."""
    at = place_at(one.motion, time)
    which = int(rng.integers(len(p)))
    far, _, out = find_nearest(one, at.inverse_transform(to_extended(p[which : which + 1])))
    distance = obstacle_radius(one) + effect.min_distance * rng.uniform()
    return p + np.asarray((distance - far[0]) * (out @ at.rotation.T)[0], float)

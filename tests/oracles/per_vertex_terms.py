"""Reference terms per vertex: attachments, drag, Rayleigh damping, velocity decay, pins.

attachments   k/2 |x_i - q_i(t)|^2, the stiffness shared equally
air drag      c rate/2 |x_i - o_i|^2, of which the gradient is c v_i; quadratic: m dv/dt = -c |v| v, solved exactly
              over a step, v <- v / (1 + dt c |v| / m)
ether drag    v <- exp(-c dt) v                                           Liu et al. 2013, section 5
Rayleigh      C = a M + b K: a m_i as drag, b k as dashpots along springs, b times the matrix of bending
pins          w/2 |x_i - q_i(t)|^2, or exactly, at the rest position moved by key frames
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.oracles.complex_step import ExtendedArray, ValueFunction, to_extended
from tests.oracles.edge_terms import build_edge_damping, compute_reference_stiffness, select_finite
from tests.oracles.key_frame_motion import place_at, velocity_at
from tests.oracles.scene_declaration import (
    Array,
    BeginFunction,
    EffectTerms,
    PinnedVertex,
    SceneDeclaration,
    StepMoment,
)
from tests.oracles.surface_terms import build_bending_damping
from tests.oracles.vertex_selection import select_vertices


def build_attachments_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build springs of zero length to points."""
    vertices = select_vertices(declared, effect)
    k = np.longdouble(effect.stiffness) / len(vertices)
    given = (
        declared.rest[vertices]
        if effect.anchors is None
        else np.broadcast_to(to_extended(effect.anchors), (len(vertices), 3))
    )

    def begin(moment: StepMoment) -> ValueFunction:
        q = place_at(effect.motion, moment.stage_time).transform(given)
        return lambda x: k / 2 * ((x[vertices] - q) ** 2).sum(axis=1)

    resists = np.zeros(len(declared.mass))
    resists[vertices] = float(k)
    return EffectTerms(begin, resists, coordinate_scale=float(np.abs(given).max()) + _motion_extent(effect.motion))


def _motion_extent(motion: Any) -> float:
    """Return the largest translation [m] of key frames, without rotations."""
    return max((float(np.abs(key.offset).max()) for key in motion.key_frames), default=0.0) if motion else 0.0


def build_air_drag_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build drag in still air, as an energy or as a velocity filter."""
    c = effect.coefficient * declared.mesh.mass_fractions
    if effect.drag_law == "linear":
        return EffectTerms(_build_drag(c), c / declared.time_step)
    dt, mass = declared.time_step, declared.mass

    def force(p: Array, v: Array, t: float) -> tuple[Array, float]:
        speed = np.sqrt((v**2).sum(axis=1))
        drag = np.minimum(c * speed, mass / dt)
        # The accuracy of a speed is the round-off of positions, times the rate.
        return -drag[:, None] * v, float((drag + c * speed).max()) * (
            float(speed.max()) + declared.mesh.bounding_box_diagonal / dt
        )

    if declared.has_stages:
        return EffectTerms(evaluate_force=force)

    def scale_velocity(v: Array) -> Array:
        speed = np.sqrt((v**2).sum(axis=1))
        drag = dt * c * speed
        return np.array([u * m / (m + d) if d > 0 else u for u, m, d in zip(v, mass, drag, strict=True)])

    return EffectTerms(filter_velocity=scale_velocity)


def _build_drag(c: Array) -> BeginFunction:
    def begin(moment: StepMoment) -> ValueFunction:
        return lambda x: to_extended(c) * moment.velocity_rate / 2 * ((x - moment.velocity_origin) ** 2).sum(axis=1)

    return begin


def build_ether_drag_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build decay of all velocities, or drag proportional to mass."""
    if declared.has_stages:
        c = effect.decay_rate * declared.mass
        return EffectTerms(_build_drag(c), c / declared.time_step)
    return EffectTerms(filter_velocity=lambda v: math.exp(-effect.decay_rate * declared.time_step) * v)


def build_rayleigh_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build damping proportional to the masses and to the stiffness of springs and bending."""
    b, parts = effect.stiffness_coefficient, [_build_drag(effect.mass_coefficient * declared.mass)]
    if b:
        parts += [
            build_edge_damping(declared, b * select_finite(compute_reference_stiffness(s, declared)))
            for s in declared.select_effects("springs")
        ]
        parts += [build_bending_damping(one, b, declared) for one in declared.select_effects("bending")]

    def begin(moment: StepMoment) -> ValueFunction:
        value_functions = [part(moment) for part in parts]

        def values(x: ExtendedArray) -> ExtendedArray:
            return np.concatenate([values(x) for values in value_functions])

        return values

    return EffectTerms(begin, effect.mass_coefficient * declared.mass / declared.time_step)


def build_pins_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build pinned vertices."""
    weight = math.inf if effect.weight == "exact" else float(effect.weight)
    pinned = {i: build_pin(weight, effect.motion, declared.rest[i]) for i in select_vertices(declared, effect)}
    return EffectTerms(pinned_vertices=pinned, coordinate_scale=_motion_extent(effect.motion))


def build_pin(weight: float, motion: Any, q: ExtendedArray) -> PinnedVertex:
    """Build a pin.

    Args:
      weight: penalty weight [N/m], infinite for an exact pin.
      motion: key frames, None for none.
      q: declared point (3,) [m].
    """

    def place_target(time: float) -> ExtendedArray:
        return place_at(motion, time).transform(q[None])[0]

    def moving(time: float) -> ExtendedArray:
        return velocity_at(motion, q, time)

    return PinnedVertex(weight, place_target, moving)

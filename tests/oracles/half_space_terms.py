"""Reference terms of contact with Coulomb friction.

Formulas: `springbench.solvers.contact.half_space.half_space_potential`,
`springbench.solvers.contact.half_space.separating_planes`.

    k_i/2 min(0, n.x_i - d)^2 + F_i h(|u_i|),   u_i = (I - nn')(x_i - a_i),   h(u) = u^2/(2 slip), beyond it u - slip/2

    k_i = 4 Q_ii max(1, speed dt / tolerance)     slip = creep (time of x - start)     F_i = mu k_i depth at x itself

The half-space n.x >= d is tangent to the obstacle offset by R. The point of tangency is where Newton's method for f = R
ends, with f the distance to the obstacle along the vertex's displacement in one step, both relative to the obstacle. In
this implementation obstacles are defined by the points of space with which they were declared, transformed by their
motion.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.oracles.complex_step import ExtendedArray, ValueFunction, row_norms, to_extended
from tests.oracles.key_frame_motion import place_at
from tests.oracles.scene_declaration import (
    Array,
    BeginFunction,
    EffectTerms,
    SceneDeclaration,
    StepMoment,
)

_MAX_NEWTON_ITERATIONS = 40
_CONTACT_RTOL = 1e-6
"""Relative to R: distance within which a point is on the surface."""


def build_contact_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build contact with every obstacle, with stiffness from the diagonal of Q."""
    depth = effect.min_distance / 10 if effect.penetration_tolerance is None else effect.penetration_tolerance

    def needs(resists: Array) -> BeginFunction:
        k = 4 * to_extended(resists) * max(1.0, effect.max_speed * declared.time_step / depth)

        def begin(moment: StepMoment) -> ValueFunction:
            parts = [_build_obstacle_energy(effect, one, k, moment) for one in effect.obstacles]
            return lambda x: np.concatenate([values(x) for values in parts])

        return begin

    return EffectTerms(
        build_from_diagonal=needs, min_length=depth, coordinate_scale=max(map(_obstacle_scale, effect.obstacles))
    )


def _build_obstacle_energy(effect: Any, one: Any, k: ExtendedArray, moment: StepMoment) -> ValueFunction:
    R, slip = obstacle_radius(one) + effect.min_distance, float(effect.eps_v) * (moment.stage_time - moment.time)
    start_placement, end_placement = (place_at(one.motion, moment.time + dt) for dt in (0.0, moment.time_step))
    a, b = (
        start_placement.inverse_transform(moment.p),
        end_placement.inverse_transform(moment.p + moment.time_step * moment.v),
    )
    touched, out = _locate_half_space(one, a, b, R)
    n = out @ end_placement.rotation.T
    d = (n * end_placement.transform(touched + R * out)).sum(axis=1)
    carried = end_placement.transform(a)
    # The half-space is that of the step's end; where x is at an earlier time, it is interpolated from the start.
    w, started = moment.stage_fraction, (n * moment.p).sum(axis=1)
    offset, anchor = started + w * (d - started), moment.p + w * (carried - moment.p)
    depth = w * (d - (n * carried).sum(axis=1))
    if moment.normal_force_positions is not None:
        depth = offset - (n * moment.normal_force_positions).sum(axis=1)
    friction_limit = effect.friction * k * np.maximum(0, depth)
    frictional = friction_limit > 0

    def values(x: ExtendedArray) -> ExtendedArray:
        gap = (n * x).sum(axis=1) - offset
        pressed = k / 2 * np.where(gap.real < 0, gap, 0) ** 2
        away, normal = (x - anchor)[frictional], n[frictional]
        across = away - (away * normal).sum(axis=1)[:, None] * normal
        square = (across**2).sum(axis=1)
        sticks = square.real <= slip**2
        slipped = np.where(sticks, square / (2 * slip), np.sqrt(np.where(sticks, 1, square)) - slip / 2)
        return np.concatenate([pressed, friction_limit[frictional] * slipped])

    return values


def _locate_half_space(one: Any, a: ExtendedArray, b: ExtendedArray, R: float) -> tuple[ExtendedArray, ExtendedArray]:
    """Find the nearest points of the obstacle and the normals there, (n, 3) each.

    They are those where Newton's method ends on the segments from a to b (n, 3).
    """
    begin, end = to_extended(np.zeros(len(a))), to_extended(np.full(len(a), np.inf))
    far, touched, out = find_nearest(one, a)
    slope = (out * (b - a)).sum(axis=1)
    for _ in range(_MAX_NEWTON_ITERATIONS):
        left = np.flatnonzero((far > (1 + _CONTACT_RTOL) * R) & (slope < 0))
        s = begin[left] - (far[left] - R) / slope[left]
        left, s = left[s < 1], s[s < 1]
        if not len(left):
            break
        s = np.where(s >= end[left], (begin[left] + end[left]) / 2, s)
        there, at, normal = find_nearest(one, a[left] + s[:, None] * (b - a)[left])
        steep = (normal * (b - a)[left]).sum(axis=1)
        falls = steep < 0
        on = left[falls]
        begin[on], far[on], slope[on], touched[on], out[on] = (x[falls] for x in (s, there, steep, at, normal))
        end[left[~falls]] = s[~falls]  # past the nearest point of the segment: it misses the obstacle
    return touched, out


def obstacle_radius(one: Any) -> float:
    """Return the radius [m] around the shape whose distance `find_nearest` returns."""
    return one.radius if one.kind in ("sphere", "capsule") else 0.0


def find_nearest(one: Any, x: ExtendedArray) -> tuple[ExtendedArray, ExtendedArray, ExtendedArray]:
    """Find the nearest points of an obstacle as declared, excluding its radius.

    Args:
      one: declared obstacle.
      x: points (m, 3) [m].

    Returns: distances (m,) [m], negative inside; nearest points of the surface and the normals there, (m, 3) each.
    """
    if one.kind == "plane":
        n = to_extended(one.normal)
        out = np.tile(n / np.sqrt(n @ n), (len(x), 1))
        far = ((x - to_extended(one.point)) * out).sum(axis=1)
        return far, x - far[:, None] * out, out
    if one.kind == "sphere":
        touched = np.tile(to_extended(one.center), (len(x), 1))
    elif one.kind == "capsule":
        first, last = to_extended(one.end_points)
        axis = last - first
        part = np.clip((x - first) @ axis / (axis @ axis), 0, 1)
        touched = first + part[:, None] * axis
    else:
        return _find_nearest_box(to_extended(one.low), to_extended(one.high), x)
    far = row_norms(x - touched)
    return far, touched, (x - touched) / far[:, None]


def _find_nearest_box(
    low: ExtendedArray, high: ExtendedArray, x: ExtendedArray
) -> tuple[ExtendedArray, ExtendedArray, ExtendedArray]:
    touched = np.clip(x, low, high)
    far, out = row_norms(x - touched), x - touched
    for k, point in enumerate(x):
        if far[k] > 0:
            out[k] /= far[k]
            continue
        faces = np.stack([high - point, point - low], axis=1).ravel()  # +x, -x, +y, ...
        face = int(faces.argmin())
        out[k], far[k] = 0, -faces[face]
        out[k, face // 2] = 1 - 2 * (face % 2)
        touched[k, face // 2] = (high, low)[face % 2][face // 2]
    return far, touched, out


def _obstacle_scale(one: Any) -> float:
    """Return the largest declared coordinate [m] of an obstacle; of planes, that of their point."""
    sizes = [np.abs(getattr(one, name)).max() for name in _SIZE_FIELDS[one.kind]]
    moves = [np.abs(key.offset).max() for key in one.motion.key_frames] if one.motion else [0.0]
    return float(max(sizes) + max(moves))


_SIZE_FIELDS = {
    "plane": ("point",),
    "sphere": ("center", "radius"),
    "capsule": ("end_points", "radius"),
    "box": ("low", "high"),
}

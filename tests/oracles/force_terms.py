"""Reference terms of external forces: weight, constant forces, and wind.

gravity          m g                          constant force   the same force on every vertex
wind             the field on every vertex, or distributed like the mass, or on triangles (Keckeisen et al. 2004)

    f = rho/2 A |u| (n.u) (C_D u/|u| + C_L (n - (n.u) u/|u|^2)),   at most m |u| / dt

with u the air's velocity relative to the triangle and n its normal on the side where n.u >= 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tests.oracles.scene_declaration import Array, EffectTerms, SceneDeclaration
from tests.oracles.surface_terms import compute_triangle_areas

FieldFunction = Callable[[Array, float], Array]


def build_gravity_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build the weight."""
    weight = declared.mass[:, None] * np.array(effect.acceleration)
    return EffectTerms(evaluate_force=lambda p, v, t: (weight, float(np.abs(weight).max())))


def build_constant_force_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build the same force on every vertex."""
    force = np.ones((len(declared.mass), 1)) * np.array(effect.force)
    return EffectTerms(evaluate_force=lambda p, v, t: (force, float(np.abs(force).max())))


def build_wind_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build the wind field on vertices or triangles."""
    field, phase = _FIELDS[effect.field](effect, declared)

    def on_vertices(p: Array, v: Array, t: float) -> tuple[Array, float]:
        share = np.ones(len(p)) if effect.acts_on == "vertex" else declared.mesh.mass_fractions
        force = share[:, None] * field(p, t)
        return force, float(share.max() * np.abs(_max_field(effect)).max() * (1.0 + phase(p, t)))

    def on_triangles(p: Array, v: Array, t: float) -> tuple[Array, float]:
        triangles, areas = declared.mesh.triangles, compute_triangle_areas(p, declared.mesh.triangles)
        at_rest = compute_triangle_areas(declared.mesh.rest_positions, triangles)
        around = np.zeros(len(p))
        for triangle, area in zip(triangles, at_rest, strict=True):
            around[triangle] += area
        total, size = np.zeros_like(p), 0.0
        middles = field(p[triangles].mean(axis=1), t) * np.ones((len(triangles), 1))
        for triangle, area, rested, air in zip(triangles, areas, at_rest, middles, strict=True):
            a, b, c = p[triangle]
            u = air - v[triangle].sum(axis=0) / 3
            speed = np.sqrt(u @ u)
            if area == 0 or speed == 0:
                continue
            n = np.cross(b - a, c - a) / (2 * area)
            n = n if n @ u >= 0 else -n
            lift = n - (n @ u) * u / speed**2
            f = (
                effect.air_density
                / 2
                * area
                * speed
                * (n @ u)
                * (effect.drag_coefficient * u / speed + effect.lift_coefficient * lift)
            )
            most = sum(rested * declared.mass[i] / around[i] for i in triangle) * speed / declared.time_step
            magnitude = np.sqrt(f @ f)
            f = f * (most / magnitude) if magnitude > most else f
            total[triangle] += f / 3
            size += min(magnitude, most) * (1 + (np.abs(air).max() + np.abs(v[triangle]).max()) / speed)
        return total, size * (1.0 + phase(p, t))

    return EffectTerms(evaluate_force=on_triangles if effect.acts_on == "triangle" else on_vertices)


def _mean_field(effect: Any) -> Array:
    return effect.strength * np.array(effect.velocity if effect.acts_on == "triangle" else effect.force)


def _max_field(effect: Any) -> Array:
    """Return the approximate maximum of the field."""
    return effect.strength * np.array([6.0, 2.0, 1.0]) if effect.field == "assignment" else 3.0 * _mean_field(effect)


def _constant_field(effect: Any, declared: SceneDeclaration) -> tuple[FieldFunction, Callable[[Array, float], float]]:
    return lambda x, t: np.ones((len(x), 1)) * _mean_field(effect), lambda x, t: 0.0


def _assignment_field(effect: Any, declared: SceneDeclaration) -> tuple[FieldFunction, Callable[[Array, float], float]]:
    low, high = declared.mesh.rest_positions.min(axis=0), declared.mesh.rest_positions.max(axis=0)
    diagonal = float(np.sqrt(((high - low) ** 2).sum())) or 1.0

    def field(x: Array, t: float) -> Array:
        blown = [
            (3 + 1.5 * (1 + np.cos(5 * phi)), 1 + np.cos(0.3 + phi), np.sin(phi)) for phi in x[:, 0] / diagonal + t
        ]
        return effect.strength * np.array(blown)

    return field, lambda x, t: 5 * (float(np.abs(x).max()) / diagonal + abs(t))


def _gust_field(effect: Any, declared: SceneDeclaration) -> tuple[FieldFunction, Callable[[Array, float], float]]:
    """Build a field of sixteen waves with random frequencies and phases.

    The logarithms of the frequencies are uniform between a quarter of and four times the central frequency. The random
    numbers are drawn in this order from NumPy's generator with the given seed.
    """
    mean, waves = _mean_field(effect), 16
    speed = float(np.sqrt((mean**2).sum()))
    if not speed:
        return _constant_field(effect, declared)
    draws = np.random.default_rng(effect.seed)
    octaves = draws.uniform(np.log(0.25), np.log(4), waves)
    phases = draws.uniform(0, 2 * np.pi, (waves, 3))
    extents = declared.mesh.rest_positions.max(axis=0) - declared.mesh.rest_positions.min(axis=0)
    size = float(np.sqrt((extents**2).sum())) or 1.0
    slow = mean / speed**2 if effect.acts_on == "triangle" else mean / (speed * size)

    def field(x: Array, t: float) -> Array:
        blown = np.ones((len(x), 1)) * mean
        for octave, shift in zip(octaves, phases, strict=True):
            w = 2 * np.pi * effect.frequency * np.exp(octave)
            blown += (
                effect.turbulence_intensity * speed * np.sqrt(2 / waves) * np.cos(w * (t - (x @ slow)[:, None]) + shift)
            )
        return blown

    fastest = 8 * np.pi * effect.frequency
    return (
        field,
        lambda x, t: (1 + effect.turbulence_intensity) * (1 + fastest * (abs(t) + float(np.abs(x @ slow).max()))),
    )


_FIELDS: dict[str, Callable[..., tuple[FieldFunction, Callable[[Array, float], float]]]] = {
    "assignment": _assignment_field,
    "constant": _constant_field,
    "gusts": _gust_field,
}

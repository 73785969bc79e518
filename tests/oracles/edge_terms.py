"""Reference terms of springs, strain limits, sewing and dashpots, and their stiffness rules.

    springs         k/2 (|x_i - x_j| - r)^2                                     Liu et al. 2013, eq. 7
    strain limits   k/2 (|x_i - x_j| - t)^2, t the nearest allowed length       Bouaziz et al. 2014, section 5.1
    sewing          k/2 max(0, |x_i - x_j| - l(t))^2, l linear in time from the rest length to the gap
    dashpots        c rate/2 (n.(x_i - x_j) - n.(o_i - o_j))^2, of which the gradient is the force -c n n'(v_i - v_j)

with n the direction of the edge at the start of the step, and o the origin in the velocity of x.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from springbench.harness.scenes.mesh.mesh import Mesh

from tests.oracles.area_stiffness import compute_area_scale
from tests.oracles.complex_step import ExtendedArray, ValueFunction, row_norms, to_extended
from tests.oracles.scene_declaration import (
    Array,
    BeginFunction,
    EffectTerms,
    SceneDeclaration,
    StepMoment,
    sum_edge_weights,
)
from tests.oracles.vertex_selection import select_vertices


def compute_edge_stiffness(mesh: Mesh, effect: Any, stretch: Any, shear: Any, bend: float) -> Array:
    """Compute the stiffness (m,) [N/m] of each spring by the effect's rule.

    The rules are those of `springbench.harness.scenes.spring_stiffness`.

    Args:
      mesh: mesh of the scene.
      effect: effect that states the rule.
      stretch: constant of stretch springs, a number or that of a woven cloth.
      shear: constant of shear springs, a number or that of a woven cloth.
      bend: constant of bend springs.
    """
    k, h = np.zeros(len(mesh.springs)), mesh.spacing
    by_area = compute_area_scale(mesh) if effect.scaling_rule == "area" and mesh.dimension > 1 else k
    for family, given in {"stretch": stretch, "shear": shear, "bend": bend}.items():
        for e in mesh.spring_families[family]:
            constant = given if isinstance(given, float) else _woven_stiffness(mesh, given, *mesh.springs[e].tolist())
            if effect.scaling_rule == "fixed":
                k[e] = constant
            elif effect.scaling_rule == "liu2013":
                k[e] = constant * (mesh.resolution - 1) / (effect.reference_size - 1)
            elif effect.scaling_rule == "area" and mesh.dimension > 1:
                k[e] = constant * by_area[e]
            elif family == "bend":
                k[e] = 16 * constant / h**2
            elif mesh.dimension == 1:
                i, j = mesh.springs[e]
                own, distance = mesh.spring_properties, np.linalg.norm(mesh.rest_positions[i] - mesh.rest_positions[j])
                k[e] = constant / (distance if own is None else own.rest_length[e])
            else:
                k[e] = constant * {2: 1.0, 3: h}[mesh.dimension]
    if effect.scaling_rule == "continuum" and bend:
        _subtract_skip_springs(mesh, k)
    return k


def _woven_stiffness(mesh: Mesh, weave: Any, i: int, j: int) -> float:
    """Return the constant of a woven cloth's spring from its angle to the warp."""
    normal = np.zeros(3)
    for a, b, c in mesh.triangles:
        area = np.cross(
            mesh.rest_positions[b] - mesh.rest_positions[a], mesh.rest_positions[c] - mesh.rest_positions[a]
        )
        normal += sum(k in (i, j) for k in (a, b, c)) * area
    edge, warp = mesh.rest_positions[j] - mesh.rest_positions[i], np.array(weave.direction)
    across = np.cross(normal, warp)
    angle = np.arctan2(edge @ across * np.linalg.norm(normal), edge @ np.cross(across, normal))
    straight = np.cos(2 * angle) ** 2
    return float((weave.warp if np.cos(2 * angle) >= 0 else weave.weft) * straight + weave.bias * (1 - straight))


def _subtract_skip_springs(mesh: Mesh, k: Array) -> None:
    """Subtract twice the stiffness of every skip-one spring from the springs along the same line."""
    joined: dict[int, dict[int, int]] = {}
    for e in mesh.spring_families["stretch"].tolist():
        i, j = mesh.springs[e].tolist()
        joined.setdefault(i, {})[j] = joined.setdefault(j, {})[i] = e
    bends = mesh.spring_families["bend"].tolist()
    most = max((k[e] for e in bends), default=0.0)
    for a, b in mesh.springs[bends].tolist():
        for middle in joined.get(a, {}).keys() & joined.get(b, {}).keys():
            k[joined[a][middle]] -= 2 * most
            k[joined[b][middle]] -= 2 * most


def build_springs_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build springs along all edges that have stiffness."""
    k = compute_reference_stiffness(effect, declared)
    exact, k = _select_exact_lengths(declared, k, 1.0, 1.0), select_finite(k)
    edges, n, own = declared.mesh.springs, len(declared.mass), declared.mesh.spring_properties
    r = _rest_lengths(declared)
    only_pulls = np.zeros(len(edges), np.bool_) if own is None else own.only_pulls

    def begin(moment: StepMoment) -> ValueFunction:
        def value(x: ExtendedArray) -> ExtendedArray:
            excess = _edge_lengths(x, edges) - r
            return to_extended(k) / 2 * np.where(only_pulls & (np.real(excess) < 0.0), 0.0, excess) ** 2

        return value

    return EffectTerms(begin, sum_edge_weights(edges, k, n), exact_lengths=exact)


def compute_reference_stiffness(effect: Any, declared: SceneDeclaration) -> Array:
    """Compute the stiffness (m,) [N/m] of an effect `springs`."""
    along = 0.0 if effect.stretch is None else effect.stretch
    if effect.youngs_modulus is not None:
        along = effect.youngs_modulus * (1.0 if effect.thickness is None else effect.thickness)
    given = along, along if effect.shear is None else effect.shear
    stretch, shear = (np.inf if x == "exact" else x for x in given)
    k = compute_edge_stiffness(declared.mesh, effect, stretch, shear, effect.bend)
    own = declared.mesh.spring_properties
    return k if own is None else np.where(np.isnan(own.stiffness), k, own.stiffness)


def select_finite(k: Array) -> Array:
    """Return the stiffnesses (m,) [N/m] with those of exact lengths set to zero."""
    return np.where(np.isinf(k), 0.0, k)


def _select_exact_lengths(
    declared: SceneDeclaration, k: Array, low: float, high: float
) -> dict[tuple[int, int], tuple[float, float]]:
    """Return the edges with infinite stiffness (m,), with their allowed lengths [m].

    These are `low` and `high` times the rest length.
    """
    edges, r = declared.mesh.springs, _rest_lengths(declared)
    return {(*edges[e].tolist(),): (low * float(r[e]), high * float(r[e])) for e in np.flatnonzero(np.isinf(k))}


def build_strain_limits_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build edges that resist strains beyond their limits."""
    given = np.inf if effect.stiffness == "exact" else effect.stiffness
    k = compute_edge_stiffness(declared.mesh, effect, given, given, 0.0)
    exact, k = _select_exact_lengths(declared, k, effect.min_stretch, effect.max_stretch), select_finite(k)
    edges, r = declared.mesh.springs, _rest_lengths(declared)
    low, high = effect.min_stretch * r, effect.max_stretch * r

    def values(x: ExtendedArray) -> ExtendedArray:
        l = _edge_lengths(x, edges)
        allowed = np.where(np.real(l) < low, low, np.where(np.real(l) > high, high, l))
        return to_extended(k) / 2 * (l - allowed) ** 2

    return EffectTerms(lambda moment: values, sum_edge_weights(edges, k, len(declared.mass)), exact_lengths=exact)


def build_sewing_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build threads between the vertices that are nearest at rest."""
    rest, rows = (
        declared.mesh.rest_positions,
        (select_vertices(declared, effect.first_row), select_vertices(declared, effect.second_row)),
    )
    pairs = {(i, min(rows[1], key=lambda j: float(np.linalg.norm(rest[i] - rest[j])))) for i in rows[0]}
    pairs |= {(min(rows[0], key=lambda i: float(np.linalg.norm(rest[i] - rest[j]))), j) for j in rows[1]}
    edges = np.array(sorted(pairs), np.int64)
    r, k = _edge_lengths(declared.rest, edges), np.full(len(edges), effect.stiffness / len(edges))

    def begin(moment: StepMoment) -> ValueFunction:
        since, whole = moment.stage_time - effect.start_time, effect.end_time - effect.start_time
        done = (1.0 if since >= 0 else 0.0) if whole == 0 else min(max(since / whole, 0.0), 1.0)
        longest = np.where(r < effect.final_length, r, r + done * (effect.final_length - r))

        def values(x: ExtendedArray) -> ExtendedArray:
            l = _edge_lengths(x, edges)
            return to_extended(k) / 2 * np.where(np.real(l) > longest, l - longest, 0 * l) ** 2

        return values

    return EffectTerms(begin, sum_edge_weights(edges, k, len(declared.mass)))


def build_dashpots_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build damping along the edges."""
    shear = effect.stretch if effect.shear is None else effect.shear
    c = compute_edge_stiffness(declared.mesh, effect, effect.stretch, shear, 0.0)
    resists = sum_edge_weights(declared.mesh.springs, c / declared.time_step, len(declared.mass))
    return EffectTerms(build_edge_damping(declared, c), resists)


def build_edge_damping(declared: SceneDeclaration, c: Array) -> BeginFunction:
    """Build the energy of dashpots with coefficients c (m,) [N s/m]."""
    i, j = declared.mesh.springs.T
    at_rest = declared.rest[i] - declared.rest[j]

    def begin(moment: StepMoment) -> ValueFunction:
        v = moment.lagged_positions[i] - moment.lagged_positions[j]
        n = np.array([_unit_direction(u, r) for u, r in zip(v, at_rest, strict=True)], np.longdouble).reshape(-1, 3)
        o = moment.velocity_origin[i] - moment.velocity_origin[j]
        return lambda x: to_extended(c) * moment.velocity_rate / 2 * (n * (x[i] - x[j] - o)).sum(axis=1) ** 2

    return begin


def _unit_direction(v: ExtendedArray, otherwise: ExtendedArray) -> ExtendedArray:
    """Return the direction of v, or the direction at rest, or the first unit vector."""
    for u in (v, otherwise):
        if u.any():
            return u / np.sqrt(u @ u)
    return to_extended([1.0, 0.0, 0.0])


def _rest_lengths(declared: SceneDeclaration) -> ExtendedArray:
    """Return the rest lengths (m,) [m]: those that the mesh states, else the distances of the ends."""
    own = declared.mesh.spring_properties
    return _edge_lengths(declared.rest, declared.mesh.springs) if own is None else to_extended(own.rest_length)


def _edge_lengths(x: ExtendedArray, edges: Any) -> ExtendedArray:
    i, j = edges.T
    return row_norms(x[i] - x[j])

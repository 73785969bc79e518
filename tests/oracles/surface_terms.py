"""Reference terms of bending and gas, from the triangles.

bending   B/2 |K x|^2 / (A0 + A1) over each pair of triangles that share an edge x0 x1 and have opposite vertices x2,
x3,
          with K = (c03 + c04, c01 + c02, -c01 - c03, -c02 - c04), the cotangents c of the angles at the edge and the
          areas A at rest (Bergou et al. 2006, with 3/(A0 + A1) divided by 2 and by 3 as derived in
          `springbench.solvers.model.energies.bending_energy`: a cylinder of curvature k stores B/2 k^2 per unit of
          area).
          Rectangles count as cut by either diagonal, half each.
gas       -p0 V0 ln(V/V0), V = sum of a.(b x c)/6 over outward triangles
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tests.oracles.complex_step import ExtendedArray, ValueFunction, to_extended
from tests.oracles.scene_declaration import Array, EffectTerms, SceneDeclaration, StepMoment

Triangle = frozenset[int]
_RECTANGLE_RTOL = 1e-6
"""Relative tolerance, with respect to a diagonal, within which a quadrangle is a rectangle."""


def build_bending_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build the quadratic bending energy of the mesh's triangles."""
    corners, K, weight = build_stencils(compute_flexural_rigidity(effect, declared), declared)
    share = np.asarray(weight[:, None] * K**2, float)
    resists = np.asarray(np.bincount(corners.ravel(), share.ravel(), len(declared.mass)), float)
    return EffectTerms(lambda moment: _bending_energy(corners, K, weight, 0.0), resists)


def compute_flexural_rigidity(effect: Any, declared: SceneDeclaration) -> float:
    """Compute the flexural rigidity [N m] of an effect `bending`: weight per area times bending length cubed."""
    given = effect.bending_length if effect.stiffness is None else effect.stiffness
    value = float(given if isinstance(given, float) else np.sqrt(given.warp * given.weft))
    if effect.stiffness is not None:
        return value
    rest = declared.mesh.rest_positions
    area = sum(
        float(np.linalg.norm(np.cross(rest[b] - rest[a], rest[c] - rest[a]))) / 2 for a, b, c in declared.mesh.triangles
    )
    return 9.81 * float(declared.mass.sum()) / area * value**3


def build_bending_damping(effect: Any, b: float, declared: SceneDeclaration) -> Any:
    """Build damping by the bending matrix.

    Args:
      effect: bending effect.
      b: factor on the matrix [s].
      declared: declaration of the scene.

    Returns: builder of the energy of a step.
    """
    corners, K, weight = build_stencils(compute_flexural_rigidity(effect, declared), declared)

    def begin(moment: StepMoment) -> ValueFunction:
        return _bending_energy(corners, K, b * moment.velocity_rate * weight, moment.velocity_origin)

    return begin


def _bending_energy(corners: Any, K: ExtendedArray, weight: ExtendedArray, origin: Any) -> ValueFunction:
    def values(x: ExtendedArray) -> ExtendedArray:
        bent = (K[:, :, None] * (x - origin)[corners]).sum(axis=1)
        return weight / 2 * (bent**2).sum(axis=1)

    return values


def build_stencils(B: float, declared: SceneDeclaration) -> tuple[Any, ExtendedArray, ExtendedArray]:
    """Build the stencils of all hinges for a rigidity B.

    Returns: corners (h, 4), coefficients K (h, 4) and weights (h,).
    """
    rest, surface = declared.rest, [frozenset(t) for t in declared.mesh.triangles.tolist()]
    pairs = list(_find_hinges(surface))
    rectangles, share = [pair for pair in pairs if _is_rectangle(rest[list(pair)])], B
    if rectangles:
        cut = {frozenset(pair[:2]) | {tip} for pair in rectangles for tip in pair[2:]}
        other = [frozenset(pair[2:]) | {end} for pair in rectangles for end in pair[:2]]
        pairs += _find_hinges([triangle for triangle in surface if triangle not in cut] + other)
        share = B / 2
    made = [_compute_stencil(rest[list(pair)]) for pair in pairs]
    K, weight = [K for K, _ in made], [share / area for _, area in made]
    return np.array(pairs, int).reshape(-1, 4), to_extended(K).reshape(-1, 4), to_extended(weight)


def _find_hinges(surface: Sequence[Triangle]) -> Iterator[tuple[int, int, int, int]]:
    """Find the edges that two triangles share, and the two opposite vertices."""
    tips: dict[Triangle, list[int]] = {}
    for triangle in surface:
        for tip in triangle:
            tips.setdefault(triangle - {tip}, []).append(tip)
    for edge, across in tips.items():
        if len(across) == 2:
            i, j = sorted(edge)
            yield i, j, across[0], across[1]


def _is_rectangle(x: ExtendedArray) -> bool:
    """Return whether the diagonals of x (4, 3) are equally long and bisect each other."""
    one, two, offset = x[0] - x[1], x[2] - x[3], x[0] + x[1] - x[2] - x[3]
    a, b, c = (np.sqrt(v @ v) for v in (one, two, offset))
    return bool(max(abs(a - b), c) <= _RECTANGLE_RTOL * a)


def _compute_stencil(x: ExtendedArray) -> tuple[list[Any], Any]:
    """Compute K and A0 + A1 of the corners x (4, 3)."""
    edge = x[1] - x[0]

    def cotangent(u: ExtendedArray, v: ExtendedArray) -> Any:
        w = np.cross(u, v)
        return (u @ v) / np.sqrt(w @ w)

    c01, c02 = (cotangent(edge, tip - x[0]) for tip in x[2:])
    c03, c04 = (cotangent(-edge, tip - x[1]) for tip in x[2:])
    normals = [np.cross(edge, tip - x[0]) for tip in x[2:]]
    return [c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], sum(np.sqrt(w @ w) for w in normals) / 2


def build_gas_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build isothermal gas in the closed mesh."""
    a, b, c = declared.mesh.triangles.T
    about = declared.rest.mean(axis=0)

    def volume(x: ExtendedArray) -> Any:
        y = x - about
        return (y[a] * _cross_product(y[b], y[c])).sum() / 6

    at_rest = volume(declared.rest)  # negative where the triangles face inwards

    def values(x: ExtendedArray) -> ExtendedArray:
        part = volume(x) / at_rest
        if part.real <= 0:
            return to_extended([np.inf])
        much = effect.pressure * abs(at_rest)
        return np.array([-much * (1 + np.log(part)), part * 0 + much])  # the logarithm's round-off is that of one

    return EffectTerms(lambda moment: values)


def _cross_product(u: ExtendedArray, v: ExtendedArray) -> ExtendedArray:
    (x, y, z), (a, b, c) = u.T, v.T
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=1)


def compute_triangle_areas(x: Array, triangles: Any) -> Array:
    """Compute the areas (f,) [m^2] of triangles at x (n, 3) [m]."""
    a, b, c = (x[corner] for corner in triangles.T)
    return 0.5 * np.sqrt((_cross_product(b - a, c - a) ** 2).sum(axis=1))

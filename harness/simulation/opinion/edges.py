"""Springs, strain limits and dashpots once more, and the rules by which their stiffness follows the mesh.

    springs         k/2 (|x_i - x_j| - r)^2                                     Liu et al. 2013, eq. 7
    strain limits   k/2 (|x_i - x_j| - t)^2, t the allowed length nearest       Bouaziz et al. 2014, section 5.1
    dashpots        c rate/2 (n.(x_i - x_j) - n.(o_i - o_j))^2, of which the gradient is the force -c n n'(v_i - v_j)

with n the direction of the edge where the step starts, and o the origin from which the velocity of x is told.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.scenes.mesh.base import Mesh
from harness.simulation.opinion.declared import Array, Begin, Declared, Moment, Opinion, counts
from harness.simulation.opinion.derivatives import Values, Wide, length, wide


def stiffness(mesh: Mesh, effect: Any, stretch: float, shear: float, bend: float) -> Array:
    """The stiffness (m,) [N/m] of each of a mesh's springs, by the effect's rule (see `harness.scenes.material`)."""
    k, h = np.zeros(len(mesh.springs)), mesh.spacing
    for family, constant in {"stretch": stretch, "shear": shear, "bend": bend}.items():
        for e in mesh.families[family]:
            if effect.rule == "fixed":
                k[e] = constant
            elif effect.rule == "liu2013":
                k[e] = constant * (mesh.resolution - 1) / (effect.reference - 1)
            elif family == "bend":
                k[e] = 16 * constant / h**2
            elif mesh.dimension == 1:
                i, j = mesh.springs[e]
                k[e] = constant / np.linalg.norm(mesh.rest[i] - mesh.rest[j])
            else:
                k[e] = constant * {2: 1.0, 3: h}[mesh.dimension]
    if effect.rule == "continuum" and bend:
        _relieve(mesh, k)
    return k


def _relieve(mesh: Mesh, k: Array) -> None:
    """Take from each spring along a line twice the stiffness of every skip-one spring above it."""
    joined: dict[int, dict[int, int]] = {}
    for e in mesh.families["stretch"].tolist():
        i, j = mesh.springs[e].tolist()
        joined.setdefault(i, {})[j] = joined.setdefault(j, {})[i] = e
    bends = mesh.families["bend"].tolist()
    most = max((k[e] for e in bends), default=0.0)
    for a, b in mesh.springs[bends].tolist():
        for middle in joined.get(a, {}).keys() & joined.get(b, {}).keys():
            k[joined[a][middle]] -= 2 * most
            k[joined[b][middle]] -= 2 * most


def springs(effect: Any, declared: Declared) -> Opinion:
    """Springs along all edges that have stiffness."""
    k = of_springs(effect, declared)
    edges, n = declared.mesh.springs, len(declared.mass)
    r = _lengths(declared.rest, edges)

    def begin(moment: Moment) -> Values:
        return lambda x: wide(k) / 2 * (_lengths(x, edges) - r) ** 2

    return Opinion(begin, counts(edges, k, n))


def of_springs(effect: Any, declared: Declared) -> Array:
    """The stiffness (m,) [N/m] of an effect `springs`."""
    shear = effect.stretch if effect.shear is None else effect.shear
    return stiffness(declared.mesh, effect, effect.stretch, shear, effect.bend)


def strain_limits(effect: Any, declared: Declared) -> Opinion:
    """Edges that resist beyond their limits."""
    k = stiffness(declared.mesh, effect, effect.stiffness, effect.stiffness, 0.0)
    edges, r = declared.mesh.springs, _lengths(declared.rest, declared.mesh.springs)
    low, high = effect.shortest * r, effect.longest * r

    def values(x: Wide) -> Wide:
        l = _lengths(x, edges)
        allowed = np.where(np.real(l) < low, low, np.where(np.real(l) > high, high, l))
        return wide(k) / 2 * (l - allowed) ** 2

    return Opinion(lambda moment: values, counts(edges, k, len(declared.mass)))


def dashpots(effect: Any, declared: Declared) -> Opinion:
    """Damping along the edges."""
    shear = effect.stretch if effect.shear is None else effect.shear
    c = stiffness(declared.mesh, effect, effect.stretch, shear, 0.0)
    resists = counts(declared.mesh.springs, c / declared.time_step, len(declared.mass))
    return Opinion(along_edges(declared, c), resists)


def along_edges(declared: Declared, c: Array) -> Begin:
    """The energy of dashpots with coefficients c (m,) [N s/m]."""
    i, j = declared.mesh.springs.T
    at_rest = declared.rest[i] - declared.rest[j]

    def begin(moment: Moment) -> Values:
        v = moment.expected[i] - moment.expected[j]
        n = np.array([_unit(u, r) for u, r in zip(v, at_rest, strict=True)], np.longdouble).reshape(-1, 3)
        o = moment.origin[i] - moment.origin[j]
        return lambda x: wide(c) * moment.rate / 2 * (n * (x[i] - x[j] - o)).sum(axis=1) ** 2

    return begin


def _unit(v: Wide, otherwise: Wide) -> Wide:
    """The direction of v, else that at rest, else the first coordinate's."""
    for u in (v, otherwise):
        if u.any():
            return u / np.sqrt(u @ u)
    return wide([1.0, 0.0, 0.0])


def _lengths(x: Wide, edges: Any) -> Wide:
    i, j = edges.T
    return length(x[i] - x[j])

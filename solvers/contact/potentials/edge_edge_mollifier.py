"""Mollifier of the edge-edge energy, which removes the kink of the distance of parallel edges.

The factor is, with e = 1e-3 |u|^2 |v|^2 at rest (Li et al. 2020, "Incremental potential contact"),

    m(c) = (2 - c/e) c/e  for c < e, else 1;     c = |u x v|^2
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from springbench.solvers.contact.potentials.hessian_blocks import row_offset
from springbench.solvers.jit.kernel_compilation import jit_inner

MOLLIFIER_THRESHOLD_SCALE = 1e-3
"""Threshold of |u x v|^2 relative to |u|^2 |v|^2 at rest, below which edges are nearly parallel (Li et al. 2020)."""

_MIN_MOLLIFIER_VALUE = 1e-200
"""Values of m up to this are not divided by."""


class EdgeCrossProduct(NamedTuple):
    """Two edges: u, v, |u|^2, u v, |v|^2 and c = |u x v|^2."""

    u: tuple[float, float, float]
    v: tuple[float, float, float]
    uu: float
    uv: float
    vv: float
    c: float


@jit_inner
def compute_edge_cross_product(p, x):
    """Return the cross product data of two edges.

    Args:
        p: positions (n, 3) [m].
        x: vertices of both edges (4,).
    """
    a, b, c, d = x[0], x[1], x[2], x[3]
    u0, u1, u2 = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    v0, v1, v2 = p[d, 0] - p[c, 0], p[d, 1] - p[c, 1], p[d, 2] - p[c, 2]
    w0, w1, w2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    uu, uv, vv = u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2
    return EdgeCrossProduct((u0, u1, u2), (v0, v1, v2), uu, uv, vv, w0 * w0 + w1 * w1 + w2 * w2)


@jit_inner
def edge_edge_mollifier(c, e):
    """Return m and its first two derivatives with respect to c.

    Args:
        c: |u x v|^2 [m^4].
        e: threshold of c [m^4], above 0.
    """
    if not c < e:
        return 1.0, 0.0, 0.0
    return (2.0 - c / e) * c / e, 2.0 * (1.0 - c / e) / e, -2.0 / (e * e)


@jit_inner
def compute_mollifier_hessian_weights(edges, factor, energy, negative_fraction, dc):
    """Return the mollifier's Hessian weights, and write c' to dc (12,).

    The rotation of the edges is excluded; `add_edge_rotation_hessian` adds its Hessian.

    Args:
        edges: cross product data of both edges.
        factor: m, m' and m''.
        energy: f, f' and f''.
        negative_fraction: included fraction of the negative curvature: of f m'' and, with a = grad f, b = grad m, of
            a b' + b a' <= s a a' + b b'/s
        dc: output (12,).

    Returns:
        x, y and s of x (g c' + c' g) + y c' c' + s g g.
    """
    u, v, _, _, _, _ = edges
    m, m1, m2 = factor
    f, f1, f2 = energy
    for a in range(3):
        # As 2 v x (u x v) and 2 u x (v x u): the numerator of the division by m must vanish as the square root of m.
        i, j = (a + 1) % 3, (a + 2) % 3
        wi, wj = u[j] * v[a] - u[a] * v[j], u[a] * v[i] - u[i] * v[a]
        bu, bv = 2.0 * (v[i] * wj - v[j] * wi), 2.0 * (u[j] * wi - u[i] * wj)
        dc[a], dc[3 + a], dc[6 + a], dc[9 + a] = -bu, bu, -bv, bv
    mixed, bent = negative_fraction * f1 * m1, negative_fraction * f * m2
    share, rest = 0.0, 1.0 - negative_fraction
    if m > _MIN_MOLLIFIER_VALUE and rest > 0.0 and f1 != 0.0:
        share = m * f2 / (f1 * f1)
        bent += rest * m1 * m1 / share
        share *= rest * f1 * f1
    return mixed, bent, share


@jit_inner
def add_edge_rotation_hessian(edges, weight, negative_fraction, H):
    """Add the Hessian of the rotation of edges to packed rows H (`contact.potentials.hessian_blocks`).

    Args:
        edges: cross product data of both edges.
        weight: 2 f m'.
        negative_fraction: included fraction of the negative curvature, which is bounded by
            4 w (du x dv) <= 2 |w| (|du|^2 |v|/|u| + |dv|^2 |u|/|v|),     w = u x v.
        H: packed block, updated.
    """
    u, v, _, uv, _, _ = edges
    for a in range(3):
        for b in range(3):
            same = 1.0 if a == b else 0.0
            huu, hvv = compute_edge_rotation_entries(edges, weight, negative_fraction, a, b)
            hvu = weight * ((1.0 + negative_fraction) * u[b] * v[a] - uv * same - negative_fraction * v[b] * u[a])
            # By edges, in the blocks of their ends.
            for i, j, h in ((0, 0, huu), (1, 0, -huu), (1, 1, huu), (2, 2, hvv), (3, 2, -hvv), (3, 3, hvv)):
                H[row_offset(i, a) + 3 * j + b] += h
            for i, j, h in ((2, 0, hvu), (2, 1, -hvu), (3, 0, -hvu), (3, 1, hvu)):
                H[row_offset(i, a) + 3 * j + b] += h


@jit_inner
def compute_edge_rotation_entries(edges, weight, negative_fraction, a, b):
    """Return entry (a, b) of the diagonal blocks of both edges' ends.

    Args:
        edges: cross product data of both edges.
        weight: 2 f m'.
        negative_fraction: included fraction of the negative curvature.
        a, b: coordinates of the row and of the column.

    Returns:
        The entry for the ends of the first edge, and that for the ends of the second one [N/m].
    """
    u, v, uu, _, vv, c = edges
    w, rest, same = np.sqrt(c), 1.0 - negative_fraction, 1.0 if a == b else 0.0
    more_u, more_v = rest * w * np.sqrt(vv / uu), rest * w * np.sqrt(uu / vv)
    return weight * ((vv + more_u) * same - v[a] * v[b]), weight * ((uu + more_v) * same - u[a] * u[b])

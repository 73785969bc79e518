"""Barrier potential of collisions: zero beyond the activation distance, infinite where a gap closes.

    E(p) = sum over pairs of m k r^2 b((d - t)/r),     b(x) = -(1 - x)^2 ln x  for 0 < x < 1

d is the distance of a point and a triangle or of two edges, t the minimum distance, r the activation distance `dhat`,
and k a stiffness [N/m]. Sources: Li et al. 2020, "Incremental potential contact", where b is a function of d^2; the
offset t is that of Li, Kaufman and Jiang 2021, "Codimensional incremental potential contact". m is 1 except for nearly
parallel edges (`contact.potentials.edge_edge_mollifier`). The sum is over collisions, each of which represents all
pairs that share its closest points (`contact.collisions`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.collisions import Candidates
from springbench.solvers.contact.geometry.distance import compute_pair_distance
from springbench.solvers.contact.potentials.edge_edge_mollifier import compute_edge_cross_product, edge_edge_mollifier
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel

FloatArray = NDArray[np.float64]


@jit_inner
def barrier_derivatives(x):
    """Return b and its first two derivatives, for 0 < x < 1."""
    y, log = 1.0 - x, np.log(x)
    return -y * y * log, y * (2.0 * log - y / x), 4.0 * y / x + y * y / (x * x) - 2.0 * log


@jit_inner
def clamped_distance(gap):
    """Return the relative gap at which forces are evaluated.

    A closed gap counts as 1e-6, so that forces remain finite; below 1e-154 b'' overflows.
    """
    return max(gap, 1e-100) if gap > 0.0 else 1e-6


@jit_inner
def compute_distance_and_gap(collisions, k):
    """Return the distance d [m] of a collision, and its relative gap (d - t)/r.

    Args:
        collisions: active collisions.
        k: index of the collision; t and r are scaled by its `distance_scale`.
    """
    z0, z1, z2 = collisions.distance_vector[k, 0], collisions.distance_vector[k, 1], collisions.distance_vector[k, 2]
    d = np.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    return d, (d / collisions.distance_scale[k] - collisions.min_distance) / collisions.dhat


def compute_distances(candidates: Candidates, p: FloatArray) -> FloatArray:
    """Return the unscaled distance [m] of each candidate pair, (k,).

    Args:
        candidates: candidate pairs.
        p: positions [m], (n, 3) or padded (n, 4).
    """
    out = np.empty(len(candidates.vertices))
    _write_distances(candidates.vertices, candidates.num_point_triangle, p, out)
    return out


@jit_kernel
def _write_distances(vertices, points, p, out):
    for e in range(len(vertices)):
        out[e] = compute_pair_distance(p, vertices[e], e >= points)


@jit_kernel
def energy_and_gradient(collisions, p, out):
    """Compute the barrier energy and add its gradient.

    Args:
        collisions: active collisions.
        p: positions (n, 3) [m].
        out: gradient (n, 3) [N], updated; closed gaps exert the force of a gap of 1e-6 activation distances.

    Returns:
        Energy [J]; infinite where a gap is closed.
    """
    total = 0.0
    for k in range(len(collisions.vertices)):
        x, c, z = collisions.vertices[k], collisions.coefficients[k], collisions.distance_vector[k]
        d, gap = compute_distance_and_gap(collisions, k)
        b, first, _ = barrier_derivatives(clamped_distance(gap))
        r, m = collisions.distance_scale[k] * collisions.dhat, 1.0
        f, f1 = collisions.stiffness[k] * r * r * b, collisions.stiffness[k] * r * first
        if collisions.mollifier_threshold[k] > 0.0:
            both = compute_edge_cross_product(p, x)
            m, m1, _ = edge_edge_mollifier(both.c, collisions.mollifier_threshold[k])
            if m1 != 0.0:
                (u0, u1, u2), (v0, v1, v2), uu, uv, vv, _ = both
                w = 2.0 * f * m1
                a0, a1, a2 = w * (vv * u0 - uv * v0), w * (vv * u1 - uv * v1), w * (vv * u2 - uv * v2)
                b0, b1, b2 = w * (uu * v0 - uv * u0), w * (uu * v1 - uv * u1), w * (uu * v2 - uv * u2)
                _add_scaled_row(out, x[0], -1.0, a0, a1, a2)
                _add_scaled_row(out, x[1], 1.0, a0, a1, a2)
                _add_scaled_row(out, x[2], -1.0, b0, b1, b2)
                _add_scaled_row(out, x[3], 1.0, b0, b1, b2)
        total += m * f if gap > 0.0 else np.inf
        w = m * f1 / max(d, 1e-300)
        for i in range(min(collisions.kind[k], 4)):
            _add_scaled_row(out, x[i], w * c[i], z[0], z[1], z[2])
    return total


@jit_inner
def _add_scaled_row(out, i, c, g0, g1, g2):
    out[i, 0] += c * g0
    out[i, 1] += c * g1
    out[i, 2] += c * g2


@jit_kernel
def compute_normal_forces(collisions, out):
    """Compute the normal forces -f' of collisions.

    Args:
        collisions: active collisions.
        out: output (a,) [N].
    """
    for k in range(len(collisions.vertices)):
        gap, m = compute_distance_and_gap(collisions, k)[1], 1.0
        if collisions.mollifier_threshold[k] > 0.0:
            m = edge_edge_mollifier(collisions.cross_squarednorm[k], collisions.mollifier_threshold[k])[0]
        r = collisions.distance_scale[k] * collisions.dhat
        out[k] = -m * collisions.stiffness[k] * r * barrier_derivatives(clamped_distance(gap))[1]

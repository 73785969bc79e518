"""Barrier potential of collisions: zero beyond the activation distance, infinite where a gap closes.

    E(p) = sum over pairs of m k r^2 b((d - t)/r),     b(x) = -(1 - x)^2 ln x  for 0 < x < 1

d is the distance of a point and a triangle or of two edges, t the minimum distance, r the activation distance `dhat`,
and k a stiffness [N/m]. Sources: Li et al. 2020, "Incremental potential contact", where b is a function of d^2; the
offset t is that of Li, Kaufman and Jiang 2021, "Codimensional incremental potential contact". m is 1 except for nearly
parallel edges (`contact.potentials.mollifier`). The sum is over collisions, each of which represents all
pairs that share its closest points (`contact.contacts`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.closest import distance
from solvers.contact.contacts import Pairs
from solvers.contact.mollifier import crossed, mollifier

Array = NDArray[np.float64]


@inner
def law(x):
    """Return b and its first two derivatives, for 0 < x < 1."""
    y, log = 1.0 - x, np.log(x)
    return -y * y * log, y * (2.0 * log - y / x), 4.0 * y / x + y * y / (x * x) - 2.0 * log


@inner
def pushing(gap):
    """Return the relative gap at which forces are evaluated.

    A closed gap counts as 1e-6, so that forces remain finite; below 1e-154 b'' overflows.
    """
    return max(gap, 1e-100) if gap > 0.0 else 1e-6


@inner
def length(contacts, k):
    """Return the distance d [m] of a collision, and the relative gap (d - t)/r."""
    z0, z1, z2 = contacts.between[k, 0], contacts.between[k, 1], contacts.between[k, 2]
    d = np.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    return d, (d / contacts.scale[k] - contacts.thickness) / contacts.reach


def distances(pairs: Pairs, p: Array) -> Array:
    """Return the distance [m] of each candidate pair at p (n, 3) [m]."""
    out = np.empty(len(pairs.vertices))
    _distances(pairs.vertices, pairs.points, p, out)
    return out


@kernel
def _distances(vertices, points, p, out):
    for e in range(len(vertices)):
        out[e] = distance(p, vertices[e], e >= points)


@kernel
def press(contacts, p, out):
    """Compute the barrier energy and add its gradient.

    Args:
        contacts: active collisions.
        p: positions (n, 3) [m].
        out: gradient (n, 3) [N], updated; closed gaps exert the force of a millionth of the activation distance.

    Returns:
        Energy [J]; infinite where a gap is closed.
    """
    total = 0.0
    for k in range(len(contacts.vertices)):
        x, c, z = contacts.vertices[k], contacts.weights[k], contacts.between[k]
        d, gap = length(contacts, k)
        b, first, _ = law(pushing(gap))
        r, m = contacts.scale[k] * contacts.reach, 1.0
        f, f1 = contacts.stiffness[k] * r * r * b, contacts.stiffness[k] * r * first
        if contacts.parallel[k] > 0.0:
            both = crossed(p, x)
            m, m1, _ = mollifier(both.c, contacts.parallel[k])
            if m1 != 0.0:
                (u0, u1, u2), (v0, v1, v2), uu, uv, vv, _ = both
                w = 2.0 * f * m1
                a0, a1, a2 = w * (vv * u0 - uv * v0), w * (vv * u1 - uv * v1), w * (vv * u2 - uv * v2)
                b0, b1, b2 = w * (uu * v0 - uv * u0), w * (uu * v1 - uv * u1), w * (uu * v2 - uv * u2)
                _add(out, x[0], -1.0, a0, a1, a2)
                _add(out, x[1], 1.0, a0, a1, a2)
                _add(out, x[2], -1.0, b0, b1, b2)
                _add(out, x[3], 1.0, b0, b1, b2)
        total += m * f if gap > 0.0 else np.inf
        w = m * f1 / max(d, 1e-300)
        for i in range(min(contacts.kind[k], 4)):
            _add(out, x[i], w * c[i], z[0], z[1], z[2])
    return total


@inner
def _add(out, i, c, g0, g1, g2):
    out[i, 0] += c * g0
    out[i, 1] += c * g1
    out[i, 2] += c * g2


@kernel
def forces(contacts, out):
    """Write the normal forces -f' [N] of collisions to `out` (a,)."""
    for k in range(len(contacts.vertices)):
        gap, m = length(contacts, k)[1], 1.0
        if contacts.parallel[k] > 0.0:
            m = mollifier(contacts.crossed[k], contacts.parallel[k])[0]
        r = contacts.scale[k] * contacts.reach
        out[k] = -m * contacts.stiffness[k] * r * law(pushing(gap))[1]

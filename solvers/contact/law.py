"""Element energy of one vertex at z in contact with one half-space (see `half_space_potential`).

    phi(z) = k/2 min(0, n.z - d)^2 + F h(|u|),   u = (I - nn')(z - a),   h(u) = u^2/(2 s), or u - s/2 beyond

Parameters: n (3), d, a (3), k, F, s, the smoothing length.
"""

from __future__ import annotations

import numpy as np

from solvers.compiling import inner
from solvers.energies.elements import Law, line


@inner
def _depth(numbers, e, z0, z1, z2):
    """Return the penetration min(0, n.z - d)."""
    return min(0.0, numbers[e, 0] * z0 + numbers[e, 1] * z1 + numbers[e, 2] * z2 - numbers[e, 3])


@inner
def _slipped(numbers, e, z0, z1, z2):
    """Return the tangential displacement u."""
    n0, n1, n2 = numbers[e, 0], numbers[e, 1], numbers[e, 2]
    u0, u1, u2 = z0 - numbers[e, 4], z1 - numbers[e, 5], z2 - numbers[e, 6]
    along = n0 * u0 + n1 * u1 + n2 * u2
    return u0 - along * n0, u1 - along * n1, u2 - along * n2


@inner
def _rounded(length, slip):
    """Return h of a length."""
    return 0.5 * length * length / slip if length <= slip else length - 0.5 * slip


@inner
def _value(numbers, e, z0, z1, z2):
    depth = _depth(numbers, e, z0, z1, z2)
    total = 0.5 * numbers[e, 7] * depth * depth
    if numbers[e, 8] > 0.0:
        u0, u1, u2 = _slipped(numbers, e, z0, z1, z2)
        total += numbers[e, 8] * _rounded(np.sqrt(u0 * u0 + u1 * u1 + u2 * u2), numbers[e, 9])
    return total


@inner
def _gradient(numbers, e, z0, z1, z2):
    force = numbers[e, 7] * _depth(numbers, e, z0, z1, z2)
    g0, g1, g2 = force * numbers[e, 0], force * numbers[e, 1], force * numbers[e, 2]
    if numbers[e, 8] > 0.0:
        u0, u1, u2 = _slipped(numbers, e, z0, z1, z2)
        weight = numbers[e, 8] / max(numbers[e, 9], np.sqrt(u0 * u0 + u1 * u1 + u2 * u2))
        g0, g1, g2 = g0 + weight * u0, g1 + weight * u1, g2 + weight * u2
    return g0, g1, g2


@inner
def _curvature(numbers, e, z0, z1, z2):
    n0, n1, n2 = numbers[e, 0], numbers[e, 1], numbers[e, 2]
    pressed = numbers[e, 7] if _depth(numbers, e, z0, z1, z2) < 0.0 else 0.0
    if not numbers[e, 8] > 0.0:
        return line(pressed, 0.0, n0, n1, n2)
    u0, u1, u2 = _slipped(numbers, e, z0, z1, z2)
    length = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    weight = numbers[e, 8] / max(numbers[e, 9], length)
    xx, xy, xz, yy, yz, zz = line(pressed, weight, n0, n1, n2)
    if length <= numbers[e, 9]:
        return xx, xy, xz, yy, yz, zz
    u0, u1, u2 = u0 / length, u1 / length, u2 / length  # what slips resists no more along its way
    return (
        xx - weight * u0 * u0, xy - weight * u0 * u1, xz - weight * u0 * u2,
        yy - weight * u1 * u1, yz - weight * u1 * u2, zz - weight * u2 * u2,
    )  # fmt: skip


@inner
def _rise(numbers, e, z0, z1, z2, s0, s1, s2):
    t0, t1, t2 = z0 + s0, z1 + s1, z2 + s2
    before, after = _depth(numbers, e, z0, z1, z2), _depth(numbers, e, t0, t1, t2)
    deeper = after - before
    if before < 0.0 and after < 0.0:
        deeper = numbers[e, 0] * s0 + numbers[e, 1] * s1 + numbers[e, 2] * s2
    total = 0.5 * numbers[e, 7] * deeper * (before + after)
    if numbers[e, 8] > 0.0:
        grip, slip = numbers[e, 8], numbers[e, 9]
        u0, u1, u2 = _slipped(numbers, e, z0, z1, z2)
        w0, w1, w2 = _slipped(numbers, e, t0, t1, t2)
        one, other = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2), np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
        along = numbers[e, 0] * s0 + numbers[e, 1] * s1 + numbers[e, 2] * s2
        v0, v1, v2 = s0 - along * numbers[e, 0], s1 - along * numbers[e, 1], s2 - along * numbers[e, 2]
        both = v0 * (u0 + w0) + v1 * (u1 + w1) + v2 * (u2 + w2)
        if one <= slip and other <= slip:
            total += 0.5 * grip * both / slip
        elif one > slip and other > slip:
            total += grip * both / (one + other)
        else:
            total += grip * (_rounded(other, slip) - _rounded(one, slip))
    return total


LAW = Law.of(_value, _gradient, _curvature, _rise)

"""Element energy of one vertex at z in contact with one half-space (`half_space_potential`).

    phi(z) = k/2 min(0, n.z - d)^2 + F h(|u|),   u = (I - nn')(z - a)

`springbench.solvers.contact.potentials.friction_law` defines h. Parameters: n (3), d, a (3), k, F and the smoothing
length of h.
"""

from __future__ import annotations

import numpy as np
from springbench.solvers.contact.potentials.friction_law import (
    friction_energy_change,
    friction_stiffness,
    project_tangentially,
    smoothed_length,
)
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.model.energies.element_energies import ElementLaw, axial_hessian


@jit_inner
def _penetration_depth(parameters, e, z0, z1, z2):
    """Return the penetration min(0, n.z - d)."""
    return min(0.0, parameters[e, 0] * z0 + parameters[e, 1] * z1 + parameters[e, 2] * z2 - parameters[e, 3])


@jit_inner
def _tangential_displacement(parameters, e, z0, z1, z2):
    """Return the tangential displacement u."""
    return project_tangentially(
        z0 - parameters[e, 4], z1 - parameters[e, 5], z2 - parameters[e, 6],
        parameters[e, 0], parameters[e, 1], parameters[e, 2],
    )  # fmt: skip


@jit_inner
def _value(parameters, e, z0, z1, z2):
    depth = _penetration_depth(parameters, e, z0, z1, z2)
    total = 0.5 * parameters[e, 7] * depth * depth
    if parameters[e, 8] > 0.0:
        u0, u1, u2 = _tangential_displacement(parameters, e, z0, z1, z2)
        total += parameters[e, 8] * smoothed_length(np.sqrt(u0 * u0 + u1 * u1 + u2 * u2), parameters[e, 9])
    return total


@jit_inner
def _gradient(parameters, e, z0, z1, z2):
    force = parameters[e, 7] * _penetration_depth(parameters, e, z0, z1, z2)
    g0, g1, g2 = force * parameters[e, 0], force * parameters[e, 1], force * parameters[e, 2]
    if parameters[e, 8] > 0.0:
        u0, u1, u2 = _tangential_displacement(parameters, e, z0, z1, z2)
        weight = friction_stiffness(parameters[e, 8], np.sqrt(u0 * u0 + u1 * u1 + u2 * u2), parameters[e, 9])
        g0, g1, g2 = g0 + weight * u0, g1 + weight * u1, g2 + weight * u2
    return g0, g1, g2


@jit_inner
def _hessian(parameters, e, z0, z1, z2):
    n0, n1, n2 = parameters[e, 0], parameters[e, 1], parameters[e, 2]
    pressed = parameters[e, 7] if _penetration_depth(parameters, e, z0, z1, z2) < 0.0 else 0.0
    if not parameters[e, 8] > 0.0:
        return axial_hessian(pressed, 0.0, n0, n1, n2)
    u0, u1, u2 = _tangential_displacement(parameters, e, z0, z1, z2)
    length = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    weight = friction_stiffness(parameters[e, 8], length, parameters[e, 9])
    xx, xy, xz, yy, yz, zz = axial_hessian(pressed, weight, n0, n1, n2)
    if length <= parameters[e, 9]:
        return xx, xy, xz, yy, yz, zz
    u0, u1, u2 = u0 / length, u1 / length, u2 / length  # sliding friction has no stiffness along its direction
    return (
        xx - weight * u0 * u0, xy - weight * u0 * u1, xz - weight * u0 * u2,
        yy - weight * u1 * u1, yz - weight * u1 * u2, zz - weight * u2 * u2,
    )  # fmt: skip


@jit_inner
def _energy_change(parameters, e, z0, z1, z2, s0, s1, s2):
    t0, t1, t2 = z0 + s0, z1 + s1, z2 + s2
    before, after = _penetration_depth(parameters, e, z0, z1, z2), _penetration_depth(parameters, e, t0, t1, t2)
    deeper = after - before
    if before < 0.0 and after < 0.0:
        deeper = parameters[e, 0] * s0 + parameters[e, 1] * s1 + parameters[e, 2] * s2
    total = 0.5 * parameters[e, 7] * deeper * (before + after)
    if parameters[e, 8] > 0.0:
        u0, u1, u2 = _tangential_displacement(parameters, e, z0, z1, z2)
        w0, w1, w2 = _tangential_displacement(parameters, e, t0, t1, t2)
        one, other = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2), np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
        v0, v1, v2 = project_tangentially(s0, s1, s2, parameters[e, 0], parameters[e, 1], parameters[e, 2])
        both = v0 * (u0 + w0) + v1 * (u1 + w1) + v2 * (u2 + w2)
        total += friction_energy_change(parameters[e, 8], one, other, both, parameters[e, 9])
    return total


HALF_SPACE_LAW = ElementLaw.from_functions(_value, _gradient, _hessian, _energy_change)

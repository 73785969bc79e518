"""Regularised Coulomb friction: the potential F h(|u|) of a tangential displacement u.

    h(u) = u^2/(2 s)  for u <= s,   u - s/2  beyond;     h'(u)/u = 1/max(s, u)

F is the friction limit. h is the length, with its kink smoothed at displacements up to the smoothing length s: Huber's
function (Huber 1964, "Robust estimation of a location parameter"), whose force grows linearly up to the limit. All
contact has this law.

These functions are for single contacts in kernels, also on devices; `evaluate_friction` is for arrays.
"""

from __future__ import annotations

from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel


@jit_inner
def project_tangentially(u0, u1, u2, n0, n1, n2):
    """Return the part of a vector perpendicular to a normal.

    Args:
        u0, u1, u2: the vector.
        n0, n1, n2: unit normal n.
    """
    along = n0 * u0 + n1 * u1 + n2 * u2
    return u0 - along * n0, u1 - along * n1, u2 - along * n2


@jit_inner
def smoothed_length(length, smoothing_length):
    """Return h [m] of a length.

    Args:
        length: length of the tangential displacement [m].
        smoothing_length: s [m].
    """
    return 0.5 * length * length / smoothing_length if length <= smoothing_length else length - 0.5 * smoothing_length


@jit_inner
def friction_stiffness(friction_limit, length, smoothing_length):
    """Return F h'(u)/u [N/m], the force per displacement.

    It is largest where the contact sticks.

    Args:
        friction_limit: F [N].
        length: length u of the tangential displacement [m].
        smoothing_length: s [m].
    """
    return friction_limit / max(smoothing_length, length)


@jit_inner
def friction_energy_change(friction_limit, before, after, change_of_square, smoothing_length):
    """Return the change of the potential [J] without cancellation.

    Args:
        friction_limit: F [N].
        before, after: lengths of the tangential displacement [m].
        change_of_square: after^2 - before^2 [m^2], from the displacements' difference and sum.
        smoothing_length: s [m].
    """
    if before <= smoothing_length and after <= smoothing_length:
        return 0.5 * friction_limit * change_of_square / smoothing_length
    if before > smoothing_length and after > smoothing_length:
        return friction_limit * change_of_square / (before + after)
    return friction_limit * (smoothed_length(after, smoothing_length) - smoothed_length(before, smoothing_length))


@jit_inner
def friction_proximal_factor(friction_limit, stiffness, length, smoothing_length):
    """Return x/v for the minimiser x of F h(|x|) + stiffness/2 |x - v|^2.

    Args:
        friction_limit: F [N].
        stiffness: weight of the distance from v [N/m].
        length: |v| [m].
        smoothing_length: s [m].
    """
    if length <= smoothing_length + friction_limit / stiffness:
        return stiffness / (stiffness + friction_limit / smoothing_length)
    return 1.0 - friction_limit / (stiffness * length)


@jit_kernel
def evaluate_friction(friction_limit, lengths, smoothing_length, smoothed, stiffness):
    """Compute h and F h'(u)/u of several contacts.

    Args:
        friction_limit: F (k,) [N].
        lengths: lengths u of the tangential displacements (k,) [m].
        smoothing_length: s of all contacts [m].
        smoothed: output h (k,) [m].
        stiffness: output F h'(u)/u (k,) [N/m].
    """
    for k in range(len(lengths)):
        smoothed[k] = smoothed_length(lengths[k], smoothing_length)
        stiffness[k] = friction_stiffness(friction_limit[k], lengths[k], smoothing_length)

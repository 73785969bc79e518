"""The law of one spring: its direction, its transverse stiffness and its change of energy.

    E = k/2 (l - r)^2,   grad E = k (l - r) n,   H = k nn' + t/l (I - nn'),   t = k (l - r)

`springbench.solvers.model.energies.spring_energy` is the interpreted form. This is the form of compiled edges and of
devices in float64, with `springbench.solvers.model.energies.element_energies.axial_hessian` for H.

Packets of eight springs (`springbench.solvers.simd`) and their scalar fallbacks compute k r/l - k in place of t/l.
Packets get 1/l from an estimate and its correction. Devices in float32 compute the difference from a reference, which
has no rounding error of float64 positions. Last bits differ between these forms.

The packet codes of k r/l - k for the local step and for the objective round differently, too. One code for both takes
as long (13.0 and 13.4 ms of processor time for 100 local-global iterations of a cloth of 48 x 48), but changes
positions by 4e-16 m. They therefore remain separate.
"""

from __future__ import annotations

import numpy as np
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH


@jit_inner
def unit_direction(v0, v1, v2, rest_direction, spring):
    """Return the unit vector of v and the length of v [m].

    Args:
        v0, v1, v2: vector of the spring, from its other end [m].
        rest_direction: unit directions of the rest shape (m, 3), for zero length.
        spring: index of the spring; ~index at its second end, which reverses the direction.
    """
    length = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    if length > ZERO_LENGTH:
        return v0 / length, v1 / length, v2 / length, length
    if spring < 0:
        return -rest_direction[~spring, 0], -rest_direction[~spring, 1], -rest_direction[~spring, 2], 0.0
    return rest_direction[spring, 0], rest_direction[spring, 1], rest_direction[spring, 2], 0.0


@jit_inner
def transverse_stiffness(stiffness, rest_length, tension, length):
    """Return a spring's transverse stiffness [N/m], at most k.

    Args:
        stiffness: k [N/m].
        rest_length: rest length r [m].
        tension: tension [N], which may be predicted.
        length: length [m]; the result is 0 at zero length unless r is 0.
    """
    if rest_length == 0.0:
        return stiffness
    if length <= 0.0:
        return 0.0
    return min(tension / length, stiffness)


@jit_inner
def spring_energy_change(stiffness, rest_length, i, j, p, q):
    """Return the change [J] of a spring's energy from p to q without cancellation.

    Args:
        stiffness: stiffness k [N/m].
        rest_length: rest length r [m].
        i, j: rows of its ends.
        p, q: positions, rows of at least three [m].
    """
    before = after = change = 0.0
    for c in range(3):
        v = p[i, c] - p[j, c]
        s = (q[i, c] - p[i, c]) - (q[j, c] - p[j, c])
        before += v * v
        after += (v + s) * (v + s)
        change += s * (2.0 * v + s)
    both = np.sqrt(before) + np.sqrt(after)
    if both > ZERO_LENGTH:
        return stiffness * (change / both) * (0.5 * both - rest_length)
    return 0.0

"""The local step of ADMM (`local_global.admm`).

It computes z and u of each edge, and their part of the right-hand side.
"""

from __future__ import annotations

import numpy as np
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH


@jit_kernel
def run_admm_local_step(edges, stiffness, low, high, rest_direction, weight, p, constant, u, out):
    """Write constant + W A'K (z - u) [N] to `out` and update u.

    Args:
        edges: (m, 2).
        stiffness: (m,) [N/m].
        low, high: minimum and maximum lengths [m] without energy (m,).
        rest_direction: direction at zero length (m, 3).
        weight: W.
        p: positions (n, 3) [m].
        constant: constant part (n, 3) [N].
        u: scaled dual variables (m, 3) [m].
        out: output (n, 3) [N].
    """
    # z - u = (2 d + (W - 1) v)/(1 + W), with v = A p + u and d the nearest vector without energy
    share, multiplier_share = 1.0 / (1.0 + weight), weight * (weight - 1.0) / (1.0 + weight)
    for i in range(len(p)):
        for c in range(3):
            out[i, c] = constant[i, c]
    for e in range(len(edges)):
        i, j, k = edges[e, 0], edges[e, 1], stiffness[e]
        v0, v1, v2 = p[i, 0] - p[j, 0] + u[e, 0], p[i, 1] - p[j, 1] + u[e, 1], p[i, 2] - p[j, 2] + u[e, 2]
        length = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        d0, d1, d2 = rest_direction[e, 0], rest_direction[e, 1], rest_direction[e, 2]
        if length > ZERO_LENGTH:
            d0, d1, d2 = v0 / length, v1 / length, v2 / length
        t = min(max(length, low[e]), high[e])
        d0, d1, d2 = t * d0, t * d1, t * d2
        u[e, 0], u[e, 1], u[e, 2] = share * (v0 - d0), share * (v1 - d1), share * (v2 - d2)
        f0, f1, f2 = 2.0 * weight * share * d0, 2.0 * weight * share * d1, 2.0 * weight * share * d2
        f0, f1, f2 = (
            k * (f0 + multiplier_share * v0),
            k * (f1 + multiplier_share * v1),
            k * (f2 + multiplier_share * v2),
        )
        out[i, 0] += f0
        out[i, 1] += f1
        out[i, 2] += f2
        out[j, 0] -= f0
        out[j, 1] -= f1
        out[j, 2] -= f2

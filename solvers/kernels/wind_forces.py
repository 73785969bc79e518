"""Kernels of wind: gusts as a sum of waves, and drag and lift on triangles.

Formulas: `springbench.harness.scenes.effects.wind_effect`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_kernel

_BLOCK_POINTS = 256
"""Points whose waves are evaluated together: with 16 waves they fill 96 KiB, which stay in the second-level cache."""


@jit_kernel
def compute_triangle_centres(p, triangles, out):
    """Write the centres of triangles.

    Args:
        p: positions (n, 3) [m].
        triangles: vertex indices (f, 3).
        out: output (f, 3) [m].
    """
    for e in range(len(triangles)):
        a, b, c = triangles[e, 0], triangles[e, 1], triangles[e, 2]
        for k in range(3):
            out[e, k] = (p[a, k] + p[b, k] + p[c, k]) / 3.0


def evaluate_gusts(
    late: NDArray[np.float64],
    angular_frequency: NDArray[np.float64],
    phase: NDArray[np.float64],
    mean: NDArray[np.float64],
    amplitude: float,
) -> NDArray[np.float64]:
    """Return mean + amplitude * sum_w cos(angular_frequency_w late + phase_w), (k, 3).

    NumPy evaluates the cosines, by vector instructions where it has them.

    Args:
        late: time at which the air was at the origin [s], (k,).
        angular_frequency: of each wave [1/s], (w,).
        phase: of each wave and component (w, 3).
        mean: mean field (3,).
        amplitude: of each wave.
    """
    out, waves = np.empty((len(late), 3)), np.empty((_BLOCK_POINTS, len(phase), 3))
    for first in range(0, len(late), _BLOCK_POINTS):
        block = waves[: len(late) - first]
        _compute_wave_phases(late[first : first + _BLOCK_POINTS], angular_frequency, phase, block)
        np.cos(block, out=block)
        _sum_waves(block, mean, amplitude, out[first : first + _BLOCK_POINTS])
    return out


@jit_kernel
def _compute_wave_phases(late, angular_frequency, phase, out):
    for i in range(len(out)):
        for w in range(len(phase)):
            for k in range(3):
                out[i, w, k] = angular_frequency[w] * late[i] + phase[w, k]


@jit_kernel
def _sum_waves(waves, mean, amplitude, out):
    for i in range(len(out)):
        for k in range(3):
            total = 0.0
            for w in range(waves.shape[1]):
                total += waves[i, w, k]
            out[i, k] = mean[k] + amplitude * total


@jit_kernel
def compute_triangle_wind(p, v, triangles, air, limit, coefficients, forces, out):
    """Write the drag and lift of triangles, a third at each vertex.

    Args:
        p: positions (n, 3) [m].
        v: velocities (n, 3) [m/s].
        triangles: vertex indices (f, 3).
        air: velocity of the air at each triangle (f, 3) [m/s].
        limit: largest force of each triangle over the relative speed [kg/s], (f,).
        coefficients: half of the air density [kg/m^3], C_D and C_L, (3,).
        forces: scratch (f, 3).
        out: forces on vertices (n, 3) [N], overwritten.
    """
    out[:] = 0.0
    for e in range(len(triangles)):
        a, b, c = triangles[e, 0], triangles[e, 1], triangles[e, 2]
        x0, x1, x2 = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
        y0, y1, y2 = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
        n0, n1, n2 = 0.5 * (x1 * y2 - x2 * y1), 0.5 * (x2 * y0 - x0 * y2), 0.5 * (x0 * y1 - x1 * y0)
        u0 = air[e, 0] - (v[a, 0] + v[b, 0] + v[c, 0]) / 3.0
        u1 = air[e, 1] - (v[a, 1] + v[b, 1] + v[c, 1]) / 3.0
        u2 = air[e, 2] - (v[a, 2] + v[b, 2] + v[c, 2]) / 3.0
        speed, size = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2), np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        facing = n0 * u0 + n2 * u2 + n1 * u1  # the area that faces the air, times the speed
        if speed > 0.0:
            u0, u1, u2 = u0 / speed, u1 / speed, u2 / speed
        else:
            u0, u1, u2 = 0.0, 0.0, 0.0
        if size > 0.0:
            n0, n1, n2 = n0 / size, n1 / size, n2 / size
        else:
            n0, n1, n2 = 0.0, 0.0, 0.0
        if facing < 0.0:
            n0, n1, n2 = -n0, -n1, -n2
        elif facing == 0.0:
            n0, n1, n2 = 0.0, 0.0, 0.0
        along = n0 * u0 + n2 * u2 + n1 * u1
        pressure, drag, lift = coefficients[0] * (abs(facing) * speed), coefficients[1], coefficients[2]
        f0 = pressure * (drag * u0 + lift * (n0 - along * u0))
        f1 = pressure * (drag * u1 + lift * (n1 - along * u1))
        f2 = pressure * (drag * u2 + lift * (n2 - along * u2))
        most, expected = limit[e] * speed, np.sqrt(f0 * f0 + f1 * f1 + f2 * f2)
        share = most / expected if expected > most else 1.0
        forces[e, 0], forces[e, 1], forces[e, 2] = f0 * share / 3.0, f1 * share / 3.0, f2 * share / 3.0
    for corner in range(3):
        for e in range(len(triangles)):
            for k in range(3):
                out[triangles[e, corner], k] += forces[e, k]

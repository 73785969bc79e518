"""Strain colours and vertex normals of a recorded mesh, fast enough for every frame.

The strain of a spring is length / rest length - 1. A vertex shows the incident strain of largest magnitude, with its
sign, so that a single overstretched spring is visible. Normals are area-weighted. Both are rounded: the recording's
compression then finds equal neighbours, and the rounding is too fine to be visible.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from springbench.harness.recording.camera_framing import find_framed_vertices
from springbench.harness.recording.recorder_interface import RecordingInfo
from springbench.harness.recording.strain_scale import DEFAULT_STRAIN_RANGE, compute_strain_colours, round_scale_end
from springbench.harness.scenes.spring_strains import compute_strains
from springbench.solvers.jit.kernel_compilation import cached_njit
from springbench.solvers.model.step_problem import Positions

RealArray = NDArray[np.float64]

NORMAL_STEPS = 32


def compute_strain_range(
    rest_positions: Positions,
    positions: Iterable[Positions],
    springs: NDArray[np.int64],
    rest_lengths: NDArray[np.float64],
) -> float:
    """Return the end of a scale that shows the strains at the given positions.

    A spring to a vertex that the camera does not frame is left out: it would leave all others grey.

    Args:
        rest_positions: rest positions (n, 3) [m].
        positions: vertex positions, each (n, 3) [m].
        springs: vertex pairs (m, 2).
        rest_lengths: rest lengths (m,) [m].

    Returns:
        The range of `round_scale_end` over all strains; DEFAULT_STRAIN_RANGE without springs.
    """
    found = list[RealArray]()
    for p in positions if len(rest_lengths) else ():
        with np.errstate(over="ignore", invalid="ignore"):
            moved = np.linalg.norm(p - rest_positions, axis=1)
        near = find_framed_vertices(rest_positions, moved) if np.isfinite(moved).all() else np.full(len(p), True)
        framed = near[springs].all(axis=1)
        found.append(compute_strains(p, springs[framed], rest_lengths[framed])[1][near])
    return round_scale_end(np.concatenate(found)) if found else DEFAULT_STRAIN_RANGE


class StrainShading:
    """Strains, colours and normals of one run's mesh."""

    def __init__(self, info: RecordingInfo) -> None:
        self._range, self._triangles = info.strain_range, info.mesh.triangles
        self._springs, self._rest_lengths = info.springs, info.rest_lengths

    def compute_strains(self, p: Positions) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the strains of springs (m,) and of vertices (n,).

        The strain of a vertex is the one of largest magnitude among its springs. It is 0 where a rest length is 0 or a
        vertex has no spring.
        """
        return compute_strains(p, self._springs, self._rest_lengths)

    def compute_colours(self, strain: NDArray[np.float64]) -> NDArray[np.uint32]:
        """Return the colour of each strain as 0xRRGGBBAA, shape (len(strain),)."""
        return compute_strain_colours(strain, self._range)

    def compute_normals(self, p: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the unit vertex normals (n, 3), rounded to 1/32; zero where undefined."""
        normals = np.zeros(p.shape)  # areas of tiny or huge triangles leave the range of single precision
        _normals_kernel(p.astype(np.float64), self._triangles, normals)
        return normals.astype(np.float32)


# Positions are passed as writable copies: a read-only array is another type to Numba and causes another compilation.
# The kernel releases the interpreter lock, so that a concurrent solver need not wait.
@cached_njit(error_model="numpy", nogil=True)
def _normals_kernel(p: RealArray, triangles: NDArray[np.int64], out: RealArray) -> None:
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
        for v in (i, j, k):
            out[v, 0] += ay * bz - az * by
            out[v, 1] += az * bx - ax * bz
            out[v, 2] += ax * by - ay * bx
    for v in range(len(out)):
        length = math.sqrt(out[v, 0] ** 2 + out[v, 1] ** 2 + out[v, 2] ** 2)
        for c in range(3):
            unit = out[v, c] / length
            out[v, c] = round(unit * NORMAL_STEPS) / NORMAL_STEPS if math.isfinite(unit) else 0.0

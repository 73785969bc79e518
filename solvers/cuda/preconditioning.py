"""The preconditioner on a device that `solvers.core.preconditioning` calls block-jacobi: z_i = (H_ii, clamped)^-1 r_i.

Blocks are inverted where the Hessian is linearised, at each point.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from solvers.cuda import sums
from solvers.cuda.network import Edges
from solvers.cuda.run import Stream
from solvers.cuda.target import cuda


@cache
def kernels(real: type[np.float32] | type[np.float64]) -> Any:
    """The kernel that applies blocks in `real`; it does nothing where now[0] is not 0, and keeps the first stage of
    r'z."""

    @cuda.jit
    def jacobi(blocks, r, z, which, partials, now):
        """Write z (f, 3), by the blocks' inverses (6, f)."""
        if now[0] != 0.0:
            return
        total, i = 0.0, cuda.grid(1)
        while i < z.shape[0]:
            r0, r1, r2 = r[i, 0], r[i, 1], r[i, 2]
            z0 = blocks[0, i] * r0 + blocks[1, i] * r1 + blocks[2, i] * r2
            z1 = blocks[1, i] * r0 + blocks[3, i] * r1 + blocks[4, i] * r2
            z2 = blocks[2, i] * r0 + blocks[4, i] * r1 + blocks[5, i] * r2
            z[i, 0], z[i, 1], z[i, 2] = z0, z1, z2
            total += np.float64(r0) * np.float64(z0) + np.float64(r1) * np.float64(z1) + np.float64(r2) * np.float64(z2)
            i += cuda.gridsize(1)
        sums.keep(total, which, partials)

    return jacobi


class Jacobi:
    """The blocks' inverses of one solve. r (f, 3): what `apply` is applied to; blocks (6, f)."""

    def __init__(self, stream: Stream, rows: int, real: type[np.float32] | type[np.float64]) -> None:
        self._stream, self._kernel = stream, kernels(real)
        self.r, self.blocks = stream.zeros((rows, 3), real), stream.zeros((6, rows), real)

    def linearised(self, edges: Edges, p: Any) -> None:
        """What else is needed where the Hessian is linearised, at rows p (n, 3) [m]: nothing."""

    def apply(self, z: Any, which: int, partials: Any, now: Any) -> None:
        """Write z (f, 3), and keep the first stage of r'z."""
        launch = sums.blocks(len(z)), sums.THREADS, self._stream.queue
        self._kernel[launch](self.blocks, self.r, z, which, partials, now)

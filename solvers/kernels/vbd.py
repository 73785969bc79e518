"""Compiled vertex block descent: colour by colour, in packets of eight vertices, all others at rest."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.kernels.accelerate_springs import Shares
from solvers.kernels.accelerate_springs import descend as objective
from solvers.kernels.half_spaces import moving, pressed
from solvers.kernels.springs import Bundles, add_short
from solvers.vectors.springs import LANES
from solvers.vectors.vbd import descend


class Blocks(NamedTuple):
    """The packets of the free vertices and their majorants.

    Vectors have rows of four numbers, the unknowns first.

    Attributes:
        bundles: packets of the free vertices, by colour.
        shares: weights of the objective.
        unknowns: number of free vertices.
        majorant: of each lane, stiffness of inertia, pins and springs [N/m]; 1 for padding.
    """

    bundles: Bundles
    shares: Shares
    unknowns: int
    majorant: NDArray[np.float64]


class SweepScratch(NamedTuple):
    """The arrays that the iterations of a step overwrite, except the positions.

    Attributes:
        before, older: previous positions.
        out: scratch.
        near: scratch for the springs of one packet.
        sums: scratch of nine numbers per vertex of a packet.
        omega: Chebyshev factor (1,), 0 at the start of a step.
        level: the objective (1,), nan if it is unknown.
    """

    before: NDArray[np.float64]
    older: NDArray[np.float64]
    out: NDArray[np.float64]
    near: NDArray[np.float64]
    sums: NDArray[np.float64]
    omega: NDArray[np.float64]
    level: NDArray[np.float64]


@inner
def _felt(beside, i, p, gradient, block):
    return gradient, block


@inner
def _risen(beside, i, p, d):
    return 0.0


_move = moving(_felt, _risen)


@inner
def _sweep(blocks, spaces, beside, right, p, work):
    """Move every vertex once to a lower energy."""
    own = blocks.bundles.own
    for b in range(len(blocks.bundles.start) - 1):
        if spaces is not None:  # noqa: SIM102 Numba leaves a branch out for None alone
            if spaces.near[b]:
                _move(blocks.bundles, spaces, beside, b, blocks.unknowns, p, right, blocks.majorant)
                continue
        short = descend(blocks.bundles, b, p, right, blocks.majorant, work.near)
        if short:
            # Step with the majorant's block, because a spring of zero length has no Hessian.
            forces(blocks.bundles, b, p, right, work.out)
            for lane in range(LANES):
                i = own[LANES * b + lane]
                for k in range(i, i + 3):
                    p[k] += work.out[k] / blocks.majorant[LANES * b + lane]


@inner
def forces(bundles, b, p, right, out):
    """Write minus the gradient of a packet with a spring of zero length to the rows of `out`."""
    for lane in range(LANES):
        for k in range(4):
            out[bundles.own[LANES * b + lane] + k] = 0.0
    add_short(bundles, b, p, right, out, True)


@inner
def _copy(p, out):
    for k in range(len(p)):
        out[k] = p[k]


@inner
def _level(blocks, spaces, beside, p, right, out):
    return objective(blocks.bundles, blocks.shares, p, right, out) + pressed(spaces, p)


def over(sweep: Any, level: Any) -> Any:
    """Build the iteration from a sweep and the objective."""

    @kernel
    def iterate(blocks, spaces, beside, right, radius, work, p, iterations):
        """Run n sweeps over all vertices from p, which is overwritten with the result.

        An extrapolation that increases the objective above that before the sweep is rejected and restarts.

        Args:
            blocks: packets of the vertices.
            spaces: half-spaces of the vertices, or None.
            beside: other element energies, or None.
            right: see `Bundles.right`.
            radius: spectral radius of Chebyshev's extrapolation, 0 for none.
            work: scratch memory.
            p: positions in rows of four [m].
            iterations: number of sweeps.
        """
        omega, known, older = work.omega, work.level, work.older
        for _ in range(iterations):
            w = (
                4.0 / (4.0 - radius**2 * omega[0])
                if omega[0] > 1.0
                else 2.0 / (2.0 - radius**2)
                if omega[0] == 1.0
                else 1.0
            )
            if w > 1.0 and np.isnan(known[0]):
                known[0] = level(blocks, spaces, beside, p, right, work.out)
            _copy(p, work.before)
            sweep(blocks, spaces, beside, right, p, work)
            if radius == 0.0:
                continue
            omega[0] = w
            if w > 1.0:
                for k in range(4 * blocks.unknowns):
                    older[k] += w * (p[k] - older[k])
                new = level(blocks, spaces, beside, older, right, work.out)
                if new <= known[0]:
                    _copy(older, p)
                    known[0] = new
                else:
                    omega[0], known[0] = 0.0, np.nan
            _copy(work.before, older)

    return iterate


iterate = over(_sweep, _level)

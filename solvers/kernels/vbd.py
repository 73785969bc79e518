"""Vertex block descent, compiled: colour by colour, eight vertices at a time, all others at rest."""

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
    """bundles: of the free vertices, by colour; shares: of the objective; unknowns: how many vertices are free;
    majorant [N/m]: of each lane what holds its vertex, and the stiffness of its springs (1 where no vertex is).

    Vectors have rows of four numbers, the unknowns first."""

    bundles: Bundles
    shares: Shares
    unknowns: int
    majorant: NDArray[np.float64]


class SweepScratch(NamedTuple):
    """What a step's iterations write to, beside the positions: before and older, positions; out: scratch; near: scratch
    of the springs of one bundle; sums: scratch of nine numbers a vertex of one; omega (1,): Chebyshev's factor, 0 where
    a step begins; level (1,): the objective, nan where it is not known."""

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
            # A spring without length has no Hessian: the majorant's step takes it apart.
            forces(blocks.bundles, b, p, right, work.out)
            for lane in range(LANES):
                i = own[LANES * b + lane]
                for k in range(i, i + 3):
                    p[k] += work.out[k] / blocks.majorant[LANES * b + lane]


@inner
def forces(bundles, b, p, right, out):
    """Write minus the gradient of a bundle in which a spring has no length to the rows of `out`."""
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
    """The iteration over a sweep and the objective."""

    @kernel
    def iterate(blocks, spaces, beside, right, radius, work, p, iterations):
        """That many sweeps over all vertices from p, which takes the result.

        spaces: half-spaces that vertices are kept in, or None; beside: what else acts on them, or None; right: see
        `Bundles.right`; radius: of Chebyshev's extrapolation, 0 for none. An extrapolation that raises the objective
        above that before the sweep is not taken, and they begin again.
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

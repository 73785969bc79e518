"""Compiled vertex block descent with element energies in addition to springs: strain limits, dashpots, custom ones.

Springs are processed in packets of eight vertices, as they are alone. The contributions of elements to gradients,
blocks and energy changes are computed vertex by vertex in between.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from solvers.compiling import inner_closure
from solvers.kernels.accelerate_springs import descend as objective
from solvers.kernels.half_spaces import moving, pressed
from solvers.kernels.stencils import Kind, Vertices
from solvers.kernels.vbd import forces, over
from solvers.vectors.springs import LANES
from solvers.vectors.vbd import model, step

_INFINITE = float("inf")
_D, _RISE = 3, 6
"""Positions of steps and energy changes among a packet's sums."""


@cache
def iterating(*kinds: Kind) -> Any:
    """Build the kernel `vbd_sweeps.iterate` for elements of these kinds."""
    total, felt, risen = Vertices.of(list(kinds))
    move = moving(felt, risen)

    @inner_closure
    def without_length(blocks, beside, right, b, p, work):
        """Step with the majorant's block, because a spring of zero length has no Hessian."""
        forces(blocks.bundles, b, p, right, work.out)
        for lane in range(LANES):
            i = blocks.bundles.own[LANES * b + lane]
            if i // 4 >= blocks.unknowns:
                continue
            none = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            gradient, _ = felt(beside, i // 4, p, *none)
            for c in range(3):
                p[i + c] += (work.out[i + c] - gradient[c]) / blocks.majorant[LANES * b + lane]

    @inner_closure
    def sweep(blocks, spaces, beside, right, p, work):
        """Move every vertex once to a lower energy."""
        bundles, sums = blocks.bundles, work.sums
        for b in range(len(bundles.start) - 1):
            if spaces is not None:  # noqa: SIM102 Numba leaves a branch out for None alone
                if spaces.near[b]:
                    move(bundles, spaces, beside, b, blocks.unknowns, p, right, blocks.majorant)
                    continue
            if model(bundles, b, p, right, work.near, sums):
                without_length(blocks, beside, right, b, p, work)
                continue
            for lane in range(LANES):
                i = bundles.own[LANES * b + lane] // 4
                if i < blocks.unknowns:
                    force = -sums[lane], -sums[LANES + lane], -sums[2 * LANES + lane]
                    block = (
                        sums[3 * LANES + lane], sums[4 * LANES + lane], sums[5 * LANES + lane],
                        sums[6 * LANES + lane], sums[7 * LANES + lane], sums[8 * LANES + lane],
                    )  # fmt: skip
                    gradient, block = felt(beside, i, p, force, block)
                    for c in range(3):
                        sums[LANES * c + lane] = -gradient[c]
                    for k in range(6):
                        sums[LANES * (3 + k) + lane] = block[k]
            step(bundles, b, p, right, work.near, sums)
            for lane in range(LANES):
                i = bundles.own[LANES * b + lane] // 4
                if i >= blocks.unknowns:
                    continue
                d = sums[LANES * _D + lane], sums[LANES * (_D + 1) + lane], sums[LANES * (_D + 2) + lane]
                rise, most = sums[LANES * _RISE + lane], blocks.majorant[LANES * b + lane]
                if not (rise < _INFINITE and rise + risen(beside, i, p, d) <= 0.0):
                    d = sums[lane] / most, sums[LANES + lane] / most, sums[2 * LANES + lane] / most
                p[4 * i], p[4 * i + 1], p[4 * i + 2] = p[4 * i] + d[0], p[4 * i + 1] + d[1], p[4 * i + 2] + d[2]

    @inner_closure
    def level(blocks, spaces, beside, p, right, out):
        return objective(blocks.bundles, blocks.shares, p, right, out) + pressed(spaces, p) + total(beside, p)

    return over(sweep, level)

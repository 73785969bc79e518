"""Compiled vertex block descent with element energies in addition to springs: augmented Lagrangians, custom ones.

Springs are processed in packets of eight vertices, as they are alone. The contributions of elements to gradients,
blocks and energy changes are computed vertex by vertex in between.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from springbench.solvers.contact.half_space.half_space_steps import build_vertex_move, half_space_energy
from springbench.solvers.jit.kernel_compilation import jit_closure
from springbench.solvers.kernels.spring_objective import value_and_descent as objective
from springbench.solvers.methods.vertex_block.incident_elements import ElementKind, VertexFunctions
from springbench.solvers.methods.vertex_block.vbd_packets import vbd_model_step, vbd_vertex_model
from springbench.solvers.methods.vertex_block.vbd_sweeps import build_iteration, write_degenerate_descent
from springbench.solvers.simd.spring_packets import LANES

_INFINITE = float("inf")
_STEP_SLOT, _CHANGE_SLOT = 3, 6
"""Positions of steps and energy changes among a packet's sums."""


@cache
def build_element_iteration(*kinds: ElementKind) -> Any:
    """Build the kernel `vbd_sweeps.run_iterations` for elements of these kinds."""
    total, felt, risen = VertexFunctions.from_kinds(list(kinds))
    move = build_vertex_move(felt, risen)

    @jit_closure
    def without_length(blocks, elements, right, b, p, work):
        """Step with the majorant's block, because a spring of zero length has no Hessian."""
        write_degenerate_descent(blocks.spring_packets, b, p, right, work.descent_scratch)
        for lane in range(LANES):
            i = blocks.spring_packets.row_offset[LANES * b + lane]
            if i // 4 >= blocks.num_free:
                continue
            none = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            gradient, _ = felt(elements, i // 4, p, *none)
            for c in range(3):
                p[i + c] += (work.descent_scratch[i + c] - gradient[c]) / blocks.majorant[LANES * b + lane]

    @jit_closure
    def sweep(blocks, spaces, elements, right, p, work):
        """Move every vertex once to a lower energy."""
        packets, sums = blocks.spring_packets, work.packet_sums
        for b in range(len(packets.packet_start) - 1):
            if spaces is not None:  # noqa: SIM102 Numba leaves a branch out for None alone
                if spaces.has_half_space[b]:
                    move(packets, spaces, elements, b, blocks.num_free, p, right, blocks.majorant)
                    continue
            if vbd_vertex_model(packets, b, p, right, work.spring_scratch, sums):
                without_length(blocks, elements, right, b, p, work)
                continue
            for lane in range(LANES):
                i = packets.row_offset[LANES * b + lane] // 4
                if i < blocks.num_free:
                    force = -sums[lane], -sums[LANES + lane], -sums[2 * LANES + lane]
                    block = (
                        sums[3 * LANES + lane], sums[4 * LANES + lane], sums[5 * LANES + lane],
                        sums[6 * LANES + lane], sums[7 * LANES + lane], sums[8 * LANES + lane],
                    )  # fmt: skip
                    gradient, block = felt(elements, i, p, force, block)
                    for c in range(3):
                        sums[LANES * c + lane] = -gradient[c]
                    for k in range(6):
                        sums[LANES * (3 + k) + lane] = block[k]
            vbd_model_step(packets, b, p, right, work.spring_scratch, sums)
            for lane in range(LANES):
                i = packets.row_offset[LANES * b + lane] // 4
                if i >= blocks.num_free:
                    continue
                d = (
                    sums[LANES * _STEP_SLOT + lane],
                    sums[LANES * (_STEP_SLOT + 1) + lane],
                    sums[LANES * (_STEP_SLOT + 2) + lane],
                )
                rise, most = sums[LANES * _CHANGE_SLOT + lane], blocks.majorant[LANES * b + lane]
                if not (rise < _INFINITE and rise + risen(elements, i, p, d) <= 0.0):
                    d = sums[lane] / most, sums[LANES + lane] / most, sums[2 * LANES + lane] / most
                p[4 * i], p[4 * i + 1], p[4 * i + 2] = p[4 * i] + d[0], p[4 * i + 1] + d[1], p[4 * i + 2] + d[2]

    @jit_closure
    def level(blocks, spaces, elements, p, right, out):
        return (
            objective(blocks.spring_packets, blocks.objective_weights, p, right, out)
            + half_space_energy(spaces, p)
            + total(elements, p)
        )

    return build_iteration(sweep, level)

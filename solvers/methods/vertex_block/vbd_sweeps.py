"""Compiled vertex block descent: colour by colour, in packets of eight vertices."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.half_space_steps import build_vertex_move, half_space_energy
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.padding_coordinate import PADDING_COORDINATE
from springbench.solvers.kernels.spring_local_step import SpringPackets, add_degenerate_packet
from springbench.solvers.kernels.spring_objective import ObjectiveWeights
from springbench.solvers.kernels.spring_objective import value_and_descent as objective
from springbench.solvers.kernels.step_setup import write_positions, write_right_hand_side
from springbench.solvers.methods.vertex_block.vbd_packets import vbd_newton_step
from springbench.solvers.simd.dot_products import ordered_dot
from springbench.solvers.simd.spring_packets import LANES


class ColourPackets(NamedTuple):
    """The packets of the free vertices and their majorants.

    Vectors have rows of four numbers, the unknowns first.

    Attributes:
        spring_packets: packets of the free vertices, by colour.
        objective_weights: weights of the objective.
        num_free: number of free vertices.
        majorant: of each lane, stiffness of inertia, pins and springs [N/m]; 1 for padding.
    """

    spring_packets: SpringPackets
    objective_weights: ObjectiveWeights
    num_free: int
    majorant: NDArray[np.float64]


class SweepScratch(NamedTuple):
    """The arrays that the iterations of a step overwrite, except the positions.

    Attributes:
        previous_positions, older_positions: previous positions.
        descent_scratch: scratch.
        spring_scratch: scratch for the springs of one packet.
        packet_sums: scratch of nine numbers per vertex of a packet.
        omega: Chebyshev factor (1,), or number of sweeps since a restart; 0 at the start of a step.
        objective_value: the objective (1,), nan if it is unknown.
    """

    previous_positions: NDArray[np.float64]
    older_positions: NDArray[np.float64]
    descent_scratch: NDArray[np.float64]
    spring_scratch: NDArray[np.float64]
    packet_sums: NDArray[np.float64]
    omega: NDArray[np.float64]
    objective_value: NDArray[np.float64]


@jit_kernel
def start_sweeps(vertex_rows, target, force, pin_targets, guess, right, work, p):
    """Write the right-hand side and initial positions of a step; reset the scratch memory.

    Args:
        vertex_rows: rows of the vertices.
        target, force: inertial target [m] and external force [N] (n, 3).
        pin_targets: targets of the pins (q, 3) [m].
        guess: initial guess (n, 3) [m].
        right: output, constant right-hand side [N] by packets, with anchor stiffnesses [N/m].
        work: scratch memory.
        p: output, positions in rows of four [m]; two padding rows are last.
    """
    write_right_hand_side(vertex_rows, target, force, pin_targets, right)
    p[:] = 0.0
    write_positions(vertex_rows, guess, pin_targets, p)
    p[len(p) - 4] = PADDING_COORDINATE
    work.spring_scratch[:], work.packet_sums[:], work.descent_scratch[:] = 0.0, 0.0, 0.0
    restart_sweeps(work, p)


@jit_inner
def restart_sweeps(work, p):
    """Forget earlier sweeps.

    Args:
        work: scratch memory.
        p: positions in rows of four [m].
    """
    work.omega[0], work.objective_value[0] = 0.0, np.nan
    for k in range(len(p)):
        work.previous_positions[k] = work.older_positions[k] = p[k]


@jit_inner
def _no_contribution(elements, i, p, gradient, block):
    return gradient, block


@jit_inner
def _no_energy_change(elements, i, p, d):
    return 0.0


_move_vertices = build_vertex_move(_no_contribution, _no_energy_change)


@jit_inner
def _sweep_vertices(blocks, spaces, elements, right, p, work):
    """Move every vertex once to a lower energy."""
    own = blocks.spring_packets.row_offset
    for b in range(len(blocks.spring_packets.packet_start) - 1):
        if spaces is not None:  # noqa: SIM102 Numba leaves a branch out for None alone
            if spaces.has_half_space[b]:
                _move_vertices(blocks.spring_packets, spaces, elements, b, blocks.num_free, p, right, blocks.majorant)
                continue
        short = vbd_newton_step(blocks.spring_packets, b, p, right, blocks.majorant, work.spring_scratch)
        if short:
            # Step with the majorant's block, because a spring of zero length has no Hessian.
            write_degenerate_descent(blocks.spring_packets, b, p, right, work.descent_scratch)
            for lane in range(LANES):
                i = own[LANES * b + lane]
                for k in range(i, i + 3):
                    p[k] += work.descent_scratch[k] / blocks.majorant[LANES * b + lane]


@jit_inner
def write_degenerate_descent(packets, b, p, right, out):
    """Write minus the gradient of a packet with a spring of zero length to `out`.

    Args:
        packets: packets of the springs.
        b: index of the packet.
        p: positions in rows of four [m].
        right: constant right-hand side [N] by packets, with anchor stiffnesses [N/m].
        out: output, in rows of four [N]; the rows of other packets do not change.
    """
    for lane in range(LANES):
        for k in range(4):
            out[packets.row_offset[LANES * b + lane] + k] = 0.0
    add_degenerate_packet(packets, b, p, right, out, True)


@jit_inner
def _copy_positions(p, out):
    for k in range(len(p)):
        out[k] = p[k]


@jit_inner
def _evaluate_objective(blocks, spaces, elements, p, right, out):
    return objective(blocks.spring_packets, blocks.objective_weights, p, right, out) + half_space_energy(spaces, p)


@jit_inner
def _chebyshev_weight(omega, radius):
    """Return the Chebyshev factor after omega."""
    if omega > 1.0:
        return 4.0 / (4.0 - radius**2 * omega)
    return 2.0 / (2.0 - radius**2) if omega == 1.0 else 1.0


@jit_inner
def run_unchecked_sweeps(blocks, right, work, p, num_sweeps):
    """Run sweeps with Nesterov's extrapolation, without the objective.

        x_(k+1) = S(y_k),   y_(k+1) = x_(k+1) + j/(j + 1) (x_(k+1) - x_k)      S a sweep, j the number since a restart

    The factor j/(j + 1) grows faster than Nesterov's (j - 1)/(j + 2), as restarts are frequent. The extrapolation
    restarts where a sweep turns against the last movement (O'Donoghue and Candes 2015, "Adaptive restart for
    accelerated gradient schemes": the gradient scheme). This costs a dot product instead of an evaluation of the
    objective, and the objective may increase.

    Args:
        blocks: packets of the vertices.
        right: constant right-hand side [N] by packets, with anchor stiffnesses [N/m].
        work: scratch memory; `older_positions` are those after the last sweep, x.
        p: extrapolated positions y in rows of four [m], updated.
        num_sweeps: number of sweeps.
    """
    count, previous, older = work.omega, work.previous_positions, work.older_positions
    step, size = work.descent_scratch, 4 * blocks.num_free
    for _ in range(num_sweeps):
        _copy_positions(p, previous)
        _sweep_vertices(blocks, None, None, right, p, work)
        for k in range(size):
            step[k], older[k] = p[k] - previous[k], p[k] - older[k]
        count[0] = count[0] + 1.0 if ordered_dot(step, older, size) >= 0.0 else 0.0
        momentum = count[0] / (count[0] + 1.0)
        for k in range(size):
            x, movement = p[k], older[k]
            p[k], older[k] = x + momentum * movement, x


def build_iteration(sweep: Any, level: Any) -> Any:
    """Build the iteration from a sweep and the objective.

    Args:
        sweep: compiled function (blocks, spaces, elements, right, p, work) that updates p by a sweep.
        level: compiled function (blocks, spaces, elements, p, right, out) that returns the objective [J] at p; `out` is
            scratch.

    Returns:
        The kernel of the iteration.
    """

    @jit_kernel
    def iterate(blocks, spaces, elements, right, radius, work, p, iterations):
        """Run n sweeps over all vertices from p, which is overwritten with the result.

        An extrapolation that increases the objective above that before the sweep is rejected and restarts.

        Args:
            blocks: packets of the vertices.
            spaces: half-spaces of the vertices, or None.
            elements: other element energies, or None.
            right: constant right-hand side [N] by packets, with anchor stiffnesses [N/m].
            radius: spectral radius of Chebyshev's extrapolation, 0 for none.
            work: scratch memory.
            p: positions in rows of four [m].
            iterations: number of sweeps.
        """
        omega, known, older = work.omega, work.objective_value, work.older_positions
        for _ in range(iterations):
            w = _chebyshev_weight(omega[0], radius)
            if w > 1.0 and np.isnan(known[0]):
                known[0] = level(blocks, spaces, elements, p, right, work.descent_scratch)
            _copy_positions(p, work.previous_positions)
            sweep(blocks, spaces, elements, right, p, work)
            if radius == 0.0:
                continue
            omega[0] = w
            if w > 1.0:
                for k in range(4 * blocks.num_free):
                    older[k] += w * (p[k] - older[k])
                new = level(blocks, spaces, elements, older, right, work.descent_scratch)
                if new <= known[0]:
                    _copy_positions(older, p)
                    known[0] = new
                else:
                    omega[0], known[0] = 0.0, np.nan
            _copy_positions(work.previous_positions, older)

    return iterate


run_iterations = build_iteration(_sweep_vertices, _evaluate_objective)

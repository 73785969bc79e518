"""Vertex block descent on a device: Newton steps of vertices, and Chebyshev's extrapolation.

A colour is one launch, a vertex one thread: no two vertices of a colour are neighbours, so a thread writes one row that
no other thread reads in this launch. Sums are computed per block, in block order, and then by one block in a tree, so
they are bitwise reproducible. The extrapolation is decided on the device, in `control`, without synchronisation:

    OMEGA of the last iteration, OBJECTIVE there (nan if unknown), EXTRAPOLATION: weight of this iteration's,
    IS_ACCEPTED: whether it was accepted, IS_REQUESTED: whether the objective before it is needed
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import float64
from springbench.solvers.cuda import device_springs
from springbench.solvers.cuda.cuda_device import is_simulated
from springbench.solvers.cuda.cuda_target import cuda
from springbench.solvers.kernels.spring_local_step import ZERO_LENGTH_SQUARED
from springbench.solvers.simd.spring_packets import LANES

OMEGA, OBJECTIVE, EXTRAPOLATION, IS_ACCEPTED, IS_REQUESTED = range(5)
NUM_CONTROLS = 5
_PIVOT_ROUNDOFF = {np.float32: 1e-6, np.float64: 1e-14}
"""Pivots up to this fraction of the diagonal's sum are round-off, with about ten springs per vertex."""

VBD_THREADS_PER_BLOCK = 8 if is_simulated() else 128
"""Threads per block, one for each vertex; the simulator starts a CPU thread for each."""


def count_vbd_blocks(num_threads: int) -> int:
    """Return the number of blocks for a number of threads, at least one."""
    return int(max(1, -(-num_threads // VBD_THREADS_PER_BLOCK)))


class VbdKernels(NamedTuple):
    """Device functions and kernels in one floating-point type."""

    gather_force_and_block: Any
    vertex_energy_change: Any
    sweep_colour: Any
    extrapolate_iterate: Any
    sum_objective: Any
    decide_extrapolation: Any
    finish_extrapolation: Any
    rebase_reference: Any


@cache
def build_vbd_kernels(real: Any) -> VbdKernels:
    """Build the kernels of one type."""
    zero, half, one = real(0.0), real(0.5), real(1.0)
    least = real(_PIVOT_ROUNDOFF[real])
    change, unit_exact = (
        device_springs.build_spring_kernels(real).force_change,
        device_springs.build_spring_kernels(np.float64).spring_direction,
    )
    tiny = ZERO_LENGTH_SQUARED

    @cuda.jit(device=True)
    def gather_force_and_block(
        t, first, last, u0, u1, u2, neighbour, kind, weights, spring, direction, arrows, far, anchor_stiffness,
        force, u,
    ):  # fmt: skip
        """Return the force [N] on a lane's vertex, and its block [N/m].

        The vertex has the displacement u0, u1, u2. The block is stored as its upper triangle. Also return whether a
        spring has zero length; such a spring does not contribute to the block.
        """
        lane, h = t % LANES, anchor_stiffness[t]
        f0, f1, f2 = force[0, t] - h * u0, force[1, t] - h * u1, force[2, t] - h * u2
        b00, b01, b02, b11, b12, b22 = h, zero, zero, h, zero, h
        lengthless = False
        for entry in range(first, last):
            e = LANES * entry + lane
            j = neighbour[e]
            if j == far:
                continue
            d0, d1, d2 = arrows[0, e], arrows[1, e], arrows[2, e]
            w0, w1, w2 = u0 - u[j, 0], u1 - u[j, 1], u2 - u[j, 2]
            pull, k = weights[kind[entry] + lane], weights[kind[entry] + LANES + lane]
            c0, c1, c2, length, without = change(d0, d1, d2, w0, w1, w2, pull, k, spring[e], direction)
            f0, f1, f2 = f0 + c0, f1 + c1, f2 + c2
            if without:
                lengthless = True
                continue
            inward = pull / length
            tension = inward - k
            # A spring with negative k belongs to a form, has no rest length and is never compressed.
            lateral = zero if tension > zero and inward > zero else -tension
            axial = (k - lateral) / (length * length)
            v0, v1, v2 = d0 + w0, d1 + w1, d2 + w2
            a0, a1 = axial * v0, axial * v1
            b00, b01, b02 = b00 + a0 * v0 + lateral, b01 + a0 * v1, b02 + a0 * v2
            b11, b12, b22 = b11 + a1 * v1 + lateral, b12 + a1 * v2, b22 + axial * v2 * v2 + lateral
        return f0, f1, f2, b00, b01, b02, b11, b12, b22, lengthless

    @cuda.jit(device=True)
    def lane_energy_change(
        t, first, last, u0, u1, u2, x0, x1, x2, f0, f1, f2, neighbour, kind, weights, arrows, far, anchor_stiffness, u,
    ):  # fmt: skip
        """Return the energy change [J] of a step x0, x1, x2 of a lane's vertex.

        The force before the step is f0, f1, f2. All springs must have nonzero length.
        """
        lane = t % LANES
        moved = x0 * x0 + x1 * x1 + x2 * x2
        rise = half * anchor_stiffness[t] * moved - (f0 * x0 + f1 * x1 + f2 * x2)
        for entry in range(first, last):
            e = LANES * entry + lane
            j = neighbour[e]
            if j == far:
                continue
            pull, k = weights[kind[entry] + lane], weights[kind[entry] + LANES + lane]
            v0 = arrows[0, e] + (u0 - u[j, 0])
            v1 = arrows[1, e] + (u1 - u[j, 1])
            v2 = arrows[2, e] + (u2 - u[j, 2])
            was = real(math.sqrt(v0 * v0 + v1 * v1 + v2 * v2))
            m0, m1, m2 = v0 + x0, v1 + x1, v2 + x2
            both = was + real(math.sqrt(m0 * m0 + m1 * m1 + m2 * m2))
            longer = ((v0 + m0) * x0 + (v1 + m1) * x1 + (v2 + m2) * x2) / both
            along = (v0 * x0 + v1 * x1 + v2 * x2) / was
            rise += half * k * moved - pull * (moved - along * longer) / both
        return rise

    @cuda.jit(device=True)
    def vertex_energy_change(d, lane):
        """Return the energy change in float64 for a step d.

        `lane` has the lane's index, its displacement and force, and the arrays.
        """
        t, first, last, at, pull, neighbour, kind, weights, arrows, far, anchor_stiffness, u = lane
        return float64(
            lane_energy_change(
                t, first, last, at[0], at[1], at[2], real(d[0]), real(d[1]), real(d[2]), pull[0], pull[1], pull[2],
                neighbour, kind, weights, arrows, far, anchor_stiffness, u,
            )
        )  # fmt: skip

    @cuda.jit
    def sweep_colour(
        begin, end, own, start, neighbour, kind, weights, spring, direction, arrows,
        padding_row, far, anchor_stiffness, majorant, force, u, before,
    ):  # fmt: skip
        """Move the vertices of a colour, each to a lower energy.

        Args:
            begin, end: range of lanes of the colour.
            own: row of each lane (lanes,), `padding_row` for none.
            start: first entry of each packet of lanes (packets + 1,).
            neighbour: row at the other end of each entry and lane, `far` for none.
            kind: offset of each entry's parameters in `weights`.
            weights: pull and stiffness of each lane of a parameter set [N/m].
            spring: spring of each entry and lane.
            direction: unit vectors for springs of zero length (m, 3).
            arrows: (3, entries), spring vectors at the reference [m].
            padding_row: row of lanes without a vertex.
            far: row of the other end of padding springs.
            anchor_stiffness, majorant: (lanes,) [N/m], anchor stiffness and majorant.
            force: (3, lanes) [N], negative gradient at the reference.
            u: displacements from the reference [m], updated.
            before: receives the displacements before the sweep.
        """
        t = begin + cuda.grid(1)
        if t >= end or own[t] == padding_row:
            return
        i, b = own[t], t // LANES
        first, last = start[b], start[b + 1]
        u0, u1, u2 = u[i, 0], u[i, 1], u[i, 2]
        before[i, 0], before[i, 1], before[i, 2] = u0, u1, u2
        f0, f1, f2, b00, b01, b02, b11, b12, b22, lengthless = gather_force_and_block(
            t,
            first,
            last,
            u0,
            u1,
            u2,
            neighbour,
            kind,
            weights,
            spring,
            direction,
            arrows,
            far,
            anchor_stiffness,
            force,
            u,
        )
        scale = one / majorant[t]
        s0, s1, s2 = scale * f0, scale * f1, scale * f2
        l1, l2 = b01 / b00, b02 / b00
        second = b11 - l1 * b01
        below = b12 - l2 * b01
        l3 = below / second
        third = b22 - l2 * b02 - l3 * below
        bound = least * (b00 + b11 + b22)
        # A spring of zero length has no Hessian: the step of the majorant separates its ends.
        if not lengthless and b00 > bound and second > bound and third > bound:
            y1 = f1 - l1 * f0
            x2 = (f2 - l2 * f0 - l3 * y1) / third
            x1 = y1 / second - l3 * x2
            x0 = f0 / b00 - l1 * x1 - l2 * x2
            rise = lane_energy_change(
                t,
                first,
                last,
                u0,
                u1,
                u2,
                x0,
                x1,
                x2,
                f0,
                f1,
                f2,
                neighbour,
                kind,
                weights,
                arrows,
                far,
                anchor_stiffness,
                u,
            )
            if rise <= zero:
                s0, s1, s2 = x0, x1, x2
        u[i, 0], u[i, 1], u[i, 2] = u0 + s0, u1 + s1, u2 + s2

    @cuda.jit
    def extrapolate_iterate(u, older, control):
        """Extrapolate `older`, the iterate before the last one, to w (u - older) + older."""
        i = cuda.grid(1)
        w = real(control[EXTRAPOLATION])
        if i < len(u) and w > one:
            for c in range(3):
                older[i, c] += w * (u[i, c] - older[i, c])

    @cuda.jit
    def sum_objective(
        own, start, neighbour, kind, weights, spring, direction, arrows,
        padding_row, far, free, anchor_stiffness, force, u, condition, control, sums,
    ):  # fmt: skip
        """Write the change of the objective from the reference to u [J].

        `sums` receives the sum of each thread block. It is evaluated in float64, from the stored u and spring vectors,
        so that decisions do not depend on round-off.

        Args:
            own: row of each lane (lanes,), `padding_row` for none.
            start: first entry of each packet of lanes (packets + 1,).
            neighbour: row at the other end of each entry and lane, `far` for none.
            kind: offset of each entry's parameters in `weights`.
            weights: pull and stiffness of each lane of a parameter set [N/m].
            spring: spring of each entry and lane.
            direction: unit vectors for springs of zero length (m, 3).
            arrows: (3, entries), spring vectors at the reference [m].
            padding_row: row of lanes without a vertex.
            far: row of the other end of padding springs.
            free: number of rows, from the first one, that may move.
            anchor_stiffness: (lanes,) [N/m].
            force: (3, lanes) [N], negative gradient at the reference.
            u: displacements from the reference [m].
            condition: index in `control`; the kernel runs if IS_REQUESTED is positive, or EXTRAPOLATION above one.
            control: scalars of the iteration.
            sums: receives the sum of each block [J].
        """
        shared_sums = cuda.shared.array(VBD_THREADS_PER_BLOCK, float64)
        t, inside = cuda.grid(1), cuda.threadIdx.x
        if condition == IS_REQUESTED and not control[IS_REQUESTED] > 0.0:
            return
        if condition == EXTRAPOLATION and not control[EXTRAPOLATION] > 1.0:
            return
        total = float64(0.0)
        if t < len(own) and own[t] != padding_row:
            i, b, lane = own[t], t // LANES, t % LANES
            u0, u1, u2 = float64(u[i, 0]), float64(u[i, 1]), float64(u[i, 2])
            energy = 0.5 * anchor_stiffness[t] * (u0 * u0 + u1 * u1 + u2 * u2)
            energy -= force[0, t] * u0 + force[1, t] * u1 + force[2, t] * u2
            for entry in range(start[b], start[b + 1]):
                e = LANES * entry + lane
                j = neighbour[e]
                if j == far:
                    continue
                d0, d1, d2 = float64(arrows[0, e]), float64(arrows[1, e]), float64(arrows[2, e])
                w0, w1, w2 = u0 - u[j, 0], u1 - u[j, 1], u2 - u[j, 2]
                pull, k = weights[kind[entry] + lane], weights[kind[entry] + LANES + lane]
                v0, v1, v2 = d0 + w0, d1 + w1, d2 + w2
                begin, end = d0 * d0 + d1 * d1 + d2 * d2, v0 * v0 + v1 * v1 + v2 * v2
                was, length, moved = math.sqrt(begin), math.sqrt(end), w0 * w0 + w1 * w1 + w2 * w2
                a0, a1, a2 = unit_exact(d0, d1, d2, begin, spring[e], direction)
                along = a0 * w0 + a1 * w1 + a2 * w2
                if begin <= tiny or end <= tiny:
                    turned = length - was - along
                else:
                    longer = ((d0 + v0) * w0 + (d1 + v1) * w1 + (d2 + v2) * w2) / (was + length)
                    turned = (moved - along * longer) / (was + length)
                share = 0.5 if j < free else 1.0  # the other end adds the other half, if there is one
                energy += share * (0.5 * k * moved - pull * turned)
            total = energy
        shared_sums[inside] = total
        cuda.syncthreads()
        span = VBD_THREADS_PER_BLOCK // 2
        while span > 0:
            if inside < span:
                shared_sums[inside] += shared_sums[inside + span]
            cuda.syncthreads()
            span //= 2
        if inside == 0:
            sums[cuda.blockIdx.x] = shared_sums[0]

    @cuda.jit
    def decide_extrapolation(radius, at_before, at_new, control):
        """Decide in one block whether an extrapolation is accepted, and compute the next weight.

        Args:
            radius: rho.
            at_before, at_new: sums of the objective, if requested.
            control: scalars of the iteration, updated.
        """
        shared_sums = cuda.shared.array((2, VBD_THREADS_PER_BLOCK), float64)
        inside = cuda.threadIdx.x
        before, new = float64(0.0), float64(0.0)
        w = control[EXTRAPOLATION]
        if w > 1.0:
            for k in range(inside, len(at_new), VBD_THREADS_PER_BLOCK):
                new += at_new[k]
            if control[IS_REQUESTED] > 0.0:
                for k in range(inside, len(at_before), VBD_THREADS_PER_BLOCK):
                    before += at_before[k]
        shared_sums[0, inside], shared_sums[1, inside] = before, new
        cuda.syncthreads()
        span = VBD_THREADS_PER_BLOCK // 2
        while span > 0:
            if inside < span:
                shared_sums[0, inside] += shared_sums[0, inside + span]
                shared_sums[1, inside] += shared_sums[1, inside + span]
            cuda.syncthreads()
            span //= 2
        if inside == 0:
            omega, known, taken = w, control[OBJECTIVE], 0.0
            if w > 1.0:
                if control[IS_REQUESTED] > 0.0:
                    known = shared_sums[0, 0]
                if shared_sums[1, 0] <= known:
                    known, taken = shared_sums[1, 0], 1.0
                else:
                    omega, known = 0.0, math.nan
            following = 1.0
            if omega > 1.0:
                following = 4.0 / (4.0 - radius * radius * omega)
            elif omega == 1.0:
                following = 2.0 / (2.0 - radius * radius)
            control[OMEGA], control[OBJECTIVE], control[EXTRAPOLATION], control[IS_ACCEPTED] = (
                omega,
                known,
                following,
                taken,
            )
            control[IS_REQUESTED] = 1.0 if following > 1.0 and math.isnan(known) else 0.0

    @cuda.jit
    def finish_extrapolation(u, before, older, control):
        """Apply the extrapolation if accepted; store where the iteration started."""
        i = cuda.grid(1)
        taken = control[IS_ACCEPTED] > 0.0
        if i < len(u):
            for c in range(3):
                if taken:
                    u[i, c] = older[i, c]
                older[i, c] = before[i, c]

    @cuda.jit
    def rebase_reference(x, u, older, control):
        """Add the displacement to the reference.

        The objective there is 0 by definition, if it was known.
        """
        i = cuda.grid(1)
        if i == 0 and not math.isnan(control[OBJECTIVE]):
            control[OBJECTIVE] = 0.0
        if i < len(x):
            for c in range(3):
                x[i, c] += float64(u[i, c])
                older[i, c] -= u[i, c]
                u[i, c] = zero

    return VbdKernels(
        gather_force_and_block,
        vertex_energy_change,
        sweep_colour,
        extrapolate_iterate,
        sum_objective,
        decide_extrapolation,
        finish_extrapolation,
        rebase_reference,
    )

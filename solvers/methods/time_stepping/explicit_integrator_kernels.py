"""Compiled explicit integration of frames: splitting methods, and Runge-Kutta methods with adaptive step size.

    p' = v,    v' = M^-1 (f - grad E(p)) - c v

Inside a frame, positions, velocities and accelerations are in rows of four. External forces and the targets of the pins
are the same in all frames of a call.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.spring_local_step import SpringPackets, add_descent
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.model.integrators.step_size_controller import (
    StepSizeController,
    choose_next_step_size,
    compute_rejection_factor,
)
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.simd.spring_packets import LANES, RHS_STRIDE

MIN_STEP_FRACTION = 1e-10
"""Smallest step size relative to the frame; below it the integration is abandoned."""

FloatArray = NDArray[np.float64]


class UniformPinMotion(NamedTuple):
    """The uniform motion of the pins in a frame.

    Attributes:
        vertices: pinned vertices (q,).
        start, end: scratch: their positions (q, 3) [m].
    """

    vertices: NDArray[np.int64]
    start: Positions
    end: Positions


class FrameForces(NamedTuple):
    """The forces of a system, and the motion of its pins.

    Attributes:
        spring_packets: packets of the springs at unpinned vertices.
        right_hand_side: scratch: constant force [N], in the layout of `SpringPackets.build_right_hand_side`.
        form_force: force of the quadratic form at the origin (n, 3) [N].
        form_pairs, form_weight, form_vertex_weight: quadratic form as in `QuadraticForm`, (k, 2), (k,) and (n,), or
            empty.
        inverse_mass: 1/m [1/kg] in rows of four, 0 for pinned vertices.
        drag_rate: c [1/s] in rows of four.
        pins: motion of the pins.
    """

    spring_packets: SpringPackets
    right_hand_side: FloatArray
    form_force: FloatArray
    form_pairs: NDArray[np.int64]
    form_weight: FloatArray
    form_vertex_weight: FloatArray
    inverse_mass: FloatArray
    drag_rate: FloatArray
    pins: UniformPinMotion


class FrameStart(NamedTuple):
    """The start of the first frame, and what is constant in all frames.

    Attributes:
        positions: positions (n, 3) [m].
        velocity: velocities (n, 3) [m/s].
        external_force: external force (n, 3) [N].
        pin_targets: positions of the pins at the end of each frame (q, 3) [m].
    """

    positions: Positions
    velocity: Positions
    external_force: Positions
    pin_targets: Positions


class FrameMotions(NamedTuple):
    """The motion at the end of each frame.

    Attributes:
        positions: positions (k, n, 3) [m].
        velocities: velocities (k, n, 3) [m/s].
    """

    positions: Positions
    velocities: Positions


class MotionRows(NamedTuple):
    """Scratch of a motion, in rows of four.

    Attributes:
        p: positions [m]; its last row, of padding springs, is not overwritten.
        v: velocities [m/s].
        force: forces [N].
    """

    p: FloatArray
    v: FloatArray
    force: FloatArray


@jit_inner
def _start_motion(row_offset, right, form_force, pins, start, rows):
    """Write the start of the first frame and the constant force to the scratch.

    Args:
        row_offset: offsets of the packets' vertices.
        right: right-hand side of the packets, overwritten except for padding lanes.
        form_force: force of the quadratic form at the origin (n, 3) [N].
        pins: motion of the pins, of which the end is overwritten.
        start: start of the first frame.
        rows: motion, overwritten.
    """
    n = len(form_force)
    for i in range(n):
        for c in range(3):
            rows.p[4 * i + c], rows.v[4 * i + c] = start.positions[i, c], start.velocity[i, c]
        rows.p[4 * i + 3] = rows.v[4 * i + 3] = 0.0
    for k in range(len(rows.force)):
        rows.force[k] = 0.0
    for lane in range(len(row_offset)):
        i, at = row_offset[lane] // 4, RHS_STRIDE * (lane // LANES) + lane % LANES
        if i < n:
            for c in range(3):
                right[at + LANES * c] = start.external_force[i, c] + form_force[i, c]
    for q in range(len(pins.vertices)):
        for c in range(3):
            pins.end[q, c] = start.pin_targets[q, c]


@jit_inner
def _start_frame(pins, rows):
    """Start the motion of the pins at their positions.

    Args:
        pins: motion of the pins, of which the start is overwritten.
        rows: motion at the start of the frame; the velocities of the pins are set to zero.
    """
    for q in range(len(pins.vertices)):
        i = 4 * pins.vertices[q]
        for c in range(3):
            pins.start[q, c], rows.v[i + c] = rows.p[i + c], 0.0


@jit_inner
def _end_frame(pins, frame_length, rows, p, v):
    """Write the motion at the end of a frame.

    Args:
        pins: motion of the pins.
        frame_length: length of the frame [s].
        rows: motion at the end of the frame.
        p: output: positions (n, 3) [m].
        v: output: velocities (n, 3) [m/s], with those of the pins.
    """
    for i in range(len(p)):
        for c in range(3):
            p[i, c], v[i, c] = rows.p[4 * i + c], rows.v[4 * i + c]
    for q in range(len(pins.vertices)):
        for c in range(3):
            v[pins.vertices[q], c] = (pins.end[q, c] - pins.start[q, c]) / frame_length


@jit_inner
def add_forces(forces, p, out):
    """Add all forces except drag [N] at p to `out`.

    Args:
        forces: forces of the system.
        p: positions [m] in rows of four.
        out: forces [N] in rows of four, updated.
    """
    add_descent(
        forces.spring_packets, 0, len(forces.spring_packets.packet_start) - 1, p, forces.right_hand_side, out, 0
    )
    for i in range(len(forces.form_vertex_weight)):
        for k in range(4 * i, 4 * i + 3):
            out[k] -= forces.form_vertex_weight[i] * p[k]
    for e in range(len(forces.form_weight)):
        i, j, w = 4 * forces.form_pairs[e, 0], 4 * forces.form_pairs[e, 1], forces.form_weight[e]
        for c in range(3):
            f = w * (p[i + c] - p[j + c])
            out[i + c] -= f
            out[j + c] += f


@jit_inner
def compute_acceleration(forces, p, out):
    """Write the acceleration [m/s^2] by all forces except drag to `out`.

    Args:
        forces: forces of the system.
        p: positions [m] in rows of four.
        out: acceleration [m/s^2] in rows of four, overwritten; zero for pinned vertices.
    """
    for k in range(len(out)):
        out[k] = 0.0
    add_forces(forces, p, out)
    for k in range(len(out)):
        out[k] *= forces.inverse_mass[k]


@jit_inner
def apply_pins(pins, fraction, p):
    """Move the pins to their positions at a fraction of the frame.

    Args:
        pins: motion of the pins.
        fraction: time within the frame, 0 at its start and 1 at its end.
        p: positions [m] in rows of four, of which those of the pins are overwritten.
    """
    for q in range(len(pins.vertices)):
        for c in range(3):
            p[4 * pins.vertices[q] + c] = pins.end[q, c] + (1.0 - fraction) * (pins.start[q, c] - pins.end[q, c])


class SplittingSteps(NamedTuple):
    """The steps of a splitting method in a frame.

    Drifts and kicks alternate, from drift 0 and kick 0 to the last drift.

    Attributes:
        drifts: fractions of the step size (k + 1,).
        velocity_factor, gained: decay of a velocity by a kick, and its gain per acceleration [s], exact for drag: (k,
            rows), or (k, 1) if all vertices have the same drag.
        num_steps: number of steps.
        step_size: size of a step [s].
        frame_length: length of the frame [s].
    """

    drifts: FloatArray
    velocity_factor: FloatArray
    gained: FloatArray
    num_steps: int
    step_size: float
    frame_length: float


@jit_inner
def _kick_and_drift(steps, inverse, first, second, h, rows):
    """Apply one or two kicks and a drift; clear the force.

    Args:
        steps: steps of the frame, with the coefficients of the kicks.
        inverse: 1/m [1/kg] in rows of four, 0 for pinned vertices.
        first: index of the first kick.
        second: index of the second kick by the same force, negative for none.
        h: duration of the drift [s].
        rows: motion and force of the kicks, updated; the force is set to zero.
    """
    p, v, force, decay, gain = rows.p, rows.v, rows.force, steps.velocity_factor, steps.gained
    if decay.shape[1] == 1:  # half of the arrays, which then stay in the first-level cache
        first_decay, first_gain, second_decay, second_gain = (
            decay[first, 0],
            gain[first, 0],
            decay[second, 0],
            gain[second, 0],
        )
        for i in range(len(p)):
            a = force[i] * inverse[i]
            force[i] = 0.0
            w = first_decay * v[i] + first_gain * a
            if second >= 0:
                w = second_decay * w + second_gain * a
            v[i] = w
            p[i] += h * w
        return
    for i in range(len(p)):
        a = force[i] * inverse[i]
        force[i] = 0.0
        w = decay[first, i] * v[i] + gain[first, i] * a
        if second >= 0:
            w = decay[second, i] * w + gain[second, i] * a
        v[i] = w
        p[i] += h * w


@jit_kernel
def run_splitting(forces, steps, start, rows, motions):
    """Integrate frames by a splitting method.

    If a step neither starts nor ends with a drift, its last kick and the first kick of the next step share one force.

    Args:
        forces: forces of the system.
        steps: steps of a frame.
        start: start of the first frame.
        rows: scratch of the motion.
        motions: output: motion at the end of each frame.
    """
    pins, p, v, force = forces.pins, rows.p, rows.v, rows.force
    drifts, count, h, last = steps.drifts, steps.num_steps, steps.step_size, len(steps.velocity_factor) - 1
    joined = drifts[0] == 0.0 and drifts[-1] == 0.0
    _start_motion(forces.spring_packets.row_offset, forces.right_hand_side, forces.form_force, pins, start, rows)
    for frame in range(len(motions.positions)):
        _start_frame(pins, rows)
        for step in range(count):
            gone = drifts[0]
            if drifts[0] != 0.0:
                for i in range(len(p)):
                    p[i] += drifts[0] * h * v[i]
                apply_pins(pins, (step + gone) / count, p)
            for k in range(1 if joined and step > 0 else 0, last + 1):
                both = joined and k == last and step < count - 1
                after = drifts[1] if both else drifts[k + 1]
                add_forces(forces, p, force)
                _kick_and_drift(steps, forces.inverse_mass, k, 0 if both else -1, after * h, rows)
                gone = 1 + after if both else gone + after
                if after != 0.0:
                    apply_pins(pins, (step + gone) / count, p)
        _end_frame(pins, steps.frame_length, rows, motions.positions[frame], motions.velocities[frame])


class TableauCoefficients(NamedTuple):
    """The coefficients of a Runge-Kutta method.

    Attributes:
        a: rows of the tableau (s, s); the last one ends the step.
        stage_times: c (s,).
        error_weights: weights of the error (1 or 2, s); the second, of lower order, moderates the first.
    """

    a: FloatArray
    stage_times: FloatArray
    error_weights: FloatArray


class AdaptiveSteps(NamedTuple):
    """The steps of a Runge-Kutta method in a frame.

    Attributes:
        frame_length: length of the frame [s].
        tolerance: rms error tolerance of a step [m].
        max_steps: maximum number of attempted steps.
        initial_step: size of the first step [s]; an adaptive method starts a further frame with the last step size.
        controller: chooses the step sizes; an error order of 0 fixes them.
    """

    frame_length: float
    tolerance: float
    max_steps: float
    initial_step: float
    controller: StepSizeController


class StageScratch(NamedTuple):
    """The motion at a stage, and its derivatives at all stages.

    The motion is q [m] and w [m/s]. The derivatives q' and w' are `stage_velocities` and `stage_accelerations`, (s,
    rows).
    """

    q: FloatArray
    w: FloatArray
    stage_velocities: FloatArray
    stage_accelerations: FloatArray

    @classmethod
    def from_sizes(cls, stages: int, rows: int) -> StageScratch:
        """Allocate the scratch of a Runge-Kutta method.

        Args:
            stages: number of stages, with the one that ends the step.
            rows: number of coordinates, including padding.
        """
        return cls(allocate_aligned(rows), allocate_aligned(rows), *np.zeros((2, stages, rows)))


@jit_inner
def _write_stage(stages, s, h, p, v, at):
    """Write the motion of stage s to `at`."""
    for i in range(len(p)):
        at.q[i], at.w[i] = p[i], v[i]
    for j in range(s):
        a = stages.a[s, j]
        if a != 0.0:
            for i in range(len(p)):
                at.q[i] += h * a * at.stage_velocities[j, i]
                at.w[i] += h * a * at.stage_accelerations[j, i]


@jit_inner
def _evaluate_stage(forces, s, q, w, at):
    """Write q' and w' of stage s to `at`."""
    compute_acceleration(forces, q, at.stage_accelerations[s])
    for i in range(len(q)):
        at.stage_accelerations[s, i] -= forces.drag_rate[i] * w[i]
        at.stage_velocities[s, i] = w[i]


@jit_inner
def _error_squares(forces, weights, span, at):
    """Return the sum of squares of an error: of positions, and of velocities times `span`."""
    total = 0.0
    for i in range(0, len(forces.inverse_mass), 4):
        if forces.inverse_mass[i] != 0.0:
            for c in range(i, i + 3):
                x = y = 0.0
                for j in range(len(weights)):
                    x += weights[j] * at.stage_velocities[j, c]
                    y += weights[j] * at.stage_accelerations[j, c]
                total += x * x + span * span * y * y
    return total


@jit_inner
def _step_error(forces, errors, span, at):
    """Return the sum of squares of a step's error.

    A second estimate moderates the first one.
    """
    size = _error_squares(forces, errors[0], span, at)
    if len(errors) == 1:
        return size
    # The combination of both estimates in Hairer's DOP853.
    other = _error_squares(forces, errors[1], span, at)
    return size * size / (size + 0.01 * other) if size > 0.0 else 0.0


@jit_kernel
def integrate_adaptive(forces, stages, at, steps, start, rows, motions, step_stats):
    """Integrate frames by a Runge-Kutta method with adaptive step size.

    An error of the velocity is multiplied by the length of the frame.

    Args:
        forces: forces of the system.
        stages: coefficients of the method.
        at: scratch of its stages.
        steps: length and tolerance of a frame.
        start: start of the first frame.
        rows: scratch of the motion.
        motions: output: motion at the end of each frame.
        step_stats: output of each frame (k, 4): accepted steps, rejected steps, last step size [s], time reached [s].

    Returns:
        Number of frames that were integrated to their ends.
    """
    pins, p, v, free = forces.pins, rows.p, rows.v, 0
    for i in range(0, len(forces.inverse_mass), 4):
        free += 3 * (forces.inverse_mass[i] != 0.0)
    length, control, end = steps.frame_length, steps.controller, len(stages.a) - 1
    first = steps.initial_step
    _start_motion(forces.spring_packets.row_offset, forces.right_hand_side, forces.form_force, pins, start, rows)
    for frame in range(len(step_stats)):
        _start_frame(pins, rows)
        t, before, h, accepted, rejected = 0.0, 1.0, first, 0.0, 0.0
        _evaluate_stage(forces, 0, p, v, at)
        while t < length:
            last = t + 1.0000001 * h >= length  # round-off must not leave a tiny last step
            step = length - t if last else h
            for s in range(1, end + 1):
                _write_stage(stages, s, step, p, v, at)
                apply_pins(pins, (t + stages.stage_times[s] * step) / length, at.q)
                _evaluate_stage(forces, s, at.q, at.w, at)
            error = (
                step * np.sqrt(_step_error(forces, stages.error_weights, length, at) / max(1, free)) / steps.tolerance
            )
            if error <= 1.0:
                t = length if last else t + step
                for i in range(len(p)):
                    p[i], v[i] = at.q[i], at.w[i]
                    at.stage_velocities[0, i], at.stage_accelerations[0, i] = (
                        at.stage_velocities[end, i],
                        at.stage_accelerations[end, i],
                    )
                accepted += 1.0
                if control.error_order > 0.0:
                    h = choose_next_step_size(control, step, h, last, error, before)
                    before = error
            else:  # also if the error is nan
                rejected += 1.0
                h = step * compute_rejection_factor(control, error)
            if h < MIN_STEP_FRACTION * length or accepted + rejected >= steps.max_steps:
                break
        step_stats[frame, 0], step_stats[frame, 1], step_stats[frame, 2], step_stats[frame, 3] = (
            accepted,
            rejected,
            h,
            t,
        )
        if t < length:
            return frame
        _end_frame(pins, length, rows, motions.positions[frame], motions.velocities[frame])
        if control.error_order > 0.0:
            first = min(length, h)
    return len(step_stats)

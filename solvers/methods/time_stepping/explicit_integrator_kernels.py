"""Compiled explicit integration of a frame: splitting methods, and Runge-Kutta methods with adaptive step size.

    p' = v,    v' = M^-1 (f - grad E(p)) - c v

Positions, velocities and accelerations are in rows of four. `FrameForces` has the data that are constant in a frame.
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

MIN_STEP_FRACTION = 1e-10
"""Smallest step size relative to the frame; below it the integration is abandoned."""

FloatArray = NDArray[np.float64]


class FrameForces(NamedTuple):
    """The forces of a frame.

    Attributes:
        spring_packets: packets of the springs at unpinned vertices.
        right_hand_side: constant force [N], in the layout of `SpringPackets.build_right_hand_side`.
        form_pairs, form_weight, form_vertex_weight: quadratic form as in `QuadraticForm`, (k, 2), (k,) and (n,), or
            empty.
        inverse_mass: 1/m [1/kg] in rows of four, 0 for pinned vertices.
        drag_rate: c [1/s] in rows of four.
        pinned_vertices: vertices (q,) that move uniformly from `pin_start` to `pin_end`.
        pin_start, pin_end: positions of the pins (q, 3) [m].
    """

    spring_packets: SpringPackets
    right_hand_side: FloatArray
    form_pairs: NDArray[np.int64]
    form_weight: FloatArray
    form_vertex_weight: FloatArray
    inverse_mass: FloatArray
    drag_rate: FloatArray
    pinned_vertices: NDArray[np.int64]
    pin_start: Positions
    pin_end: Positions


@jit_inner
def add_forces(forces, p, out):
    """Add all forces except drag [N] at p to `out`.

    Args:
        forces: forces of the frame.
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
        forces: forces of the frame.
        p: positions [m] in rows of four.
        out: acceleration [m/s^2] in rows of four, overwritten; zero for pinned vertices.
    """
    for k in range(len(out)):
        out[k] = 0.0
    add_forces(forces, p, out)
    for k in range(len(out)):
        out[k] *= forces.inverse_mass[k]


@jit_inner
def apply_pins(forces, fraction, p):
    """Move the pins to their positions at a fraction of the frame.

    Args:
        forces: forces of the frame, with the motion of the pins.
        fraction: time within the frame, 0 at its start and 1 at its end.
        p: positions [m] in rows of four, of which those of the pins are overwritten.
    """
    for q in range(len(forces.pinned_vertices)):
        for c in range(3):
            p[4 * forces.pinned_vertices[q] + c] = forces.pin_end[q, c] + (1.0 - fraction) * (
                forces.pin_start[q, c] - forces.pin_end[q, c]
            )


@jit_inner
def kick_and_drift(inverse, velocity_factor, gained, first, second, h, p, v, force):
    """Apply one or two kicks to v and a drift to p; clear the force.

    Args:
        inverse: 1/m [1/kg] in rows of four, 0 for pinned vertices.
        velocity_factor, gained: decay of a velocity by each kick, and its gain per acceleration [s] (k, rows).
        first: index of the first kick.
        second: index of the second kick by the same force, negative for none.
        h: duration of the drift [s].
        p: positions [m] in rows of four, updated.
        v: velocities [m/s] in rows of four, updated.
        force: force of the kicks [N] in rows of four; set to zero.
    """
    for i in range(len(p)):
        a = force[i] * inverse[i]
        force[i] = 0.0
        w = velocity_factor[first, i] * v[i] + gained[first, i] * a
        if second >= 0:
            w = velocity_factor[second, i] * w + gained[second, i] * a
        v[i] = w
        p[i] += h * w


@jit_kernel
def run_splitting(forces, drifts, velocity_factor, gained, count, h, p, v, force):
    """Run `count` steps of size h: drift 0, kick 0, ..., the last drift.

    If a step neither starts nor ends with a drift, its last kick and the first kick of the next step share one force.
    The arrays p and v are overwritten with the result.

    Args:
        forces: forces of the frame.
        drifts: fractions of h (k + 1,).
        velocity_factor, gained: decay of a velocity by a kick, and its gain per acceleration [s] (k, rows), exact for
            drag.
        count: number of steps.
        h: step size [s].
        p: positions [m].
        v: velocities [m/s].
        force: scratch, initially zero.
    """
    last = len(velocity_factor) - 1
    joined = drifts[0] == 0.0 and drifts[-1] == 0.0
    for step in range(count):
        gone = drifts[0]
        if drifts[0] != 0.0:
            for i in range(len(p)):
                p[i] += drifts[0] * h * v[i]
            apply_pins(forces, (step + gone) / count, p)
        for k in range(1 if joined and step > 0 else 0, last + 1):
            both = joined and k == last and step < count - 1
            after = drifts[1] if both else drifts[k + 1]
            add_forces(forces, p, force)
            kick_and_drift(forces.inverse_mass, velocity_factor, gained, k, 0 if both else -1, after * h, p, v, force)
            gone = 1 + after if both else gone + after
            if after != 0.0:
                apply_pins(forces, (step + gone) / count, p)


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
    """The steps of a frame.

    Attributes:
        frame_length: length of the frame [s].
        tolerance: rms error tolerance of a step [m].
        max_steps: maximum number of attempted steps.
        initial_step: size of the first step [s].
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
def integrate_adaptive(forces, stages, steps, p, v, at, step_stats):
    """Integrate a frame by a Runge-Kutta method with adaptive step size.

    An error of the velocity is multiplied by the length of the frame.

    Args:
        forces: forces of the frame.
        stages: coefficients of the method.
        steps: length and tolerance of the frame.
        p: positions [m], overwritten with the result.
        v: velocities [m/s], overwritten with the result.
        at: scratch.
        step_stats: output: accepted steps, rejected steps, last step size [s], time reached [s].
    """
    free = 0
    for i in range(0, len(forces.inverse_mass), 4):
        free += 3 * (forces.inverse_mass[i] != 0.0)
    frame, control, end = steps.frame_length, steps.controller, len(stages.a) - 1
    t, before, h = 0.0, 1.0, steps.initial_step
    step_stats[0] = step_stats[1] = 0.0
    _evaluate_stage(forces, 0, p, v, at)
    while t < frame:
        last = t + 1.0000001 * h >= frame  # round-off must not leave a tiny last step
        step = frame - t if last else h
        for s in range(1, end + 1):
            _write_stage(stages, s, step, p, v, at)
            apply_pins(forces, (t + stages.stage_times[s] * step) / frame, at.q)
            _evaluate_stage(forces, s, at.q, at.w, at)
        error = step * np.sqrt(_step_error(forces, stages.error_weights, frame, at) / max(1, free)) / steps.tolerance
        if error <= 1.0:
            t = frame if last else t + step
            for i in range(len(p)):
                p[i], v[i] = at.q[i], at.w[i]
                at.stage_velocities[0, i], at.stage_accelerations[0, i] = (
                    at.stage_velocities[end, i],
                    at.stage_accelerations[end, i],
                )
            step_stats[0] += 1.0
            if control.error_order > 0.0:
                h = choose_next_step_size(control, step, h, last, error, before)
                before = error
        else:  # also if the error is nan
            step_stats[1] += 1.0
            h = step * compute_rejection_factor(control, error)
        if h < MIN_STEP_FRACTION * frame or step_stats[0] + step_stats[1] >= steps.max_steps:
            break
    step_stats[2], step_stats[3] = h, t

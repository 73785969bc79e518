"""Compiled iterations of A-Jacobi, for springs, quadratic forms, inertia and pins.

They are those of `springbench.solvers.methods.local_global.accelerated_local_global` in the same order of operations,
with the matrix S of the sweeps in place of a factor.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.accelerated_descent import (
    TRIAL_AGAIN,
    TRIAL_STALLED,
    AccelerationWindow,
    accept_trial,
    assess_trial,
    init_window,
    propose_trial,
)
from springbench.solvers.kernels.iteration_loop import build_unchecked_steps
from springbench.solvers.kernels.objective_kernels import (
    ExactPins,
    ObjectiveTerms,
    StepData,
    change_objective,
    move_to_targets,
    write_free_gradient,
)
from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm, multiply_matrix
from springbench.solvers.model.step_problem import Positions


class SweepMatrix(NamedTuple):
    """The matrix S [m/N] over all vertices, in compressed rows.

    The rows of exactly pinned vertices are empty.
    """

    row_pointers: NDArray[Any]
    columns: NDArray[Any]
    entries: NDArray[np.float64]


class SweepVectors(NamedTuple):
    """Views of the vectors of a window, and the correction at the trial.

    Attributes:
        positions, trial_positions: views of the window's positions [m].
        trial_descent: view of minus the gradient at the trial [N].
        trial_correction: S times it (n, 3) [m].
        correction_entries: its entries (3n,).
    """

    positions: Positions
    trial_positions: Positions
    trial_descent: Positions
    trial_correction: Positions
    correction_entries: NDArray[np.float64]


class JacobiStep(NamedTuple):
    """The objective of a step, the matrix S, and the arrays of a solve."""

    objective_terms: ObjectiveTerms
    quadratic_form: QuadraticForm | None
    step_data: StepData
    exact_pins: ExactPins
    sweep_matrix: SweepMatrix
    vectors: SweepVectors
    window: AccelerationWindow


@jit_kernel
def start_jacobi_solve(step: JacobiStep, guess):
    """Start the solve of a step at a guess (n, 3) [m].

    Args:
        step: the step; its window is initialised and its vectors are overwritten.
        guess: initial guess, with any positions of exactly pinned vertices.
    """
    for v in range(len(guess)):
        for c in range(3):
            step.vectors.trial_positions[v, c] = guess[v, c]
    move_to_targets(step.exact_pins, step.vectors.trial_positions)
    _evaluate_trial(step)
    _solve_trial(step)
    init_window(step.window, step.vectors.correction_entries)
    step.window.window_state[0].objective_decrease = 0.0


@jit_inner
def _step_state(step):
    """Do one iteration; return whether a trial was accepted."""
    now, vectors, verdict = step.window.window_state[0], step.vectors, TRIAL_AGAIN
    propose_trial(step.window)
    now.roundoff = 0.0
    while verdict == TRIAL_AGAIN:
        _evaluate_trial(step)
        now.objective_change = change_objective(
            step.objective_terms, step.quadratic_form, step.step_data, vectors.positions, vectors.trial_positions
        )
        verdict = assess_trial(step.window)
    if verdict == TRIAL_STALLED:
        return False
    _solve_trial(step)
    accept_trial(step.window, vectors.correction_entries)
    return True


_run_unchecked = build_unchecked_steps(_step_state)


@jit_kernel
def run_jacobi_solve(step: JacobiStep, num_iterations, out):
    """Do iterations up to the first that fails, and write the positions to `out`.

    Args:
        step: the step, from `start_jacobi_solve`; updated.
        num_iterations: maximum number of iterations.
        out: output (n, 3) [m].

    Returns:
        The number of iterations that succeeded.
    """
    count = _run_unchecked(step, num_iterations)
    for v in range(len(out)):
        for c in range(3):
            out[v, c] = step.vectors.positions[v, c]
    return count


@jit_inner
def _evaluate_trial(step):
    """Write minus the gradient at the trial."""
    there = step.vectors.trial_descent
    write_free_gradient(
        step.objective_terms,
        step.quadratic_form,
        step.step_data,
        step.exact_pins,
        step.vectors.trial_positions,
        there,
    )
    for v in range(len(there)):
        for c in range(3):
            there[v, c] = -there[v, c]


@jit_inner
def _solve_trial(step):
    """Write S times the descent at the trial."""
    matrix = step.sweep_matrix
    multiply_matrix(
        matrix.row_pointers, matrix.columns, matrix.entries, step.vectors.trial_descent, step.vectors.trial_correction
    )

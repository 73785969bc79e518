"""Iterations of nonlinear conjugate gradients without Python, for springs, quadratic forms and single vertices.

They are those of `springbench.solvers.methods.quasi_newton.nonlinear_cg` with Q^-1 as the preconditioner, in the same
order of operations. A kernel does one iteration; between two of them Python solves with the factor of Q.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.descent_method import MAX_HALVINGS
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.objective_kernels import (
    ExactPins,
    ObjectiveTerms,
    StepData,
    compute_max_magnitude,
    try_step,
    write_free_gradient,
)
from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
from springbench.solvers.kernels.spring_hessian import linearise_springs, multiply_hessian
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions

FloatArray = NDArray[np.float64]

_SUM_ENTRIES = 8192
"""Entries of an inner product that are summed together."""

DIRECTION_STATE_DTYPE = np.dtype(
    [
        ("is_new_point", np.int64),  # whether the correction at the current point is still to be read
        ("slope_change", np.float64),  # d y of the last iteration [J], 0 before the first
        ("beta", np.float64),  # multiple of the last direction in the next one
    ]
)
"""The scalars of a solve."""


class SearchVectors(NamedTuple):
    """Vectors of a solve (n, 3), and the entries (3n,) for inner products.

    Attributes:
        gradient, gradient_change: g at the current point and y [N].
        correction, correction_change: z = Q^-1 g and w [m].
        direction: d [m].
        product: H d [N].
        trial_positions, trial_gradient: positions [m] and gradient [N] of a trial.
        gradient_entries, gradient_change_entries: entries of g and y.
        correction_entries, correction_change_entries: entries of z and w.
        direction_entries, product_entries: entries of d and H d.
        linear_terms: linearised springs (m, 4), as of `linearise_springs`.
        direction_state: scalars (1,) of type DIRECTION_STATE_DTYPE.
    """

    gradient: Positions
    gradient_change: Positions
    correction: Positions
    correction_change: Positions
    direction: Positions
    product: Positions
    trial_positions: Positions
    trial_gradient: Positions
    gradient_entries: FloatArray
    gradient_change_entries: FloatArray
    correction_entries: FloatArray
    correction_change_entries: FloatArray
    direction_entries: FloatArray
    product_entries: FloatArray
    linear_terms: FloatArray
    direction_state: NDArray[Any]

    @classmethod
    def from_counts(cls, num_vertices: int, num_springs: int) -> SearchVectors:
        """Allocate the vectors of a system.

        Args:
            num_vertices: number of vertices, n.
            num_springs: number of springs, m.
        """
        entries = np.zeros((8, 3 * num_vertices))
        fields = (x.reshape(-1, 3) for x in entries)
        return cls(
            *(*fields, *entries[:6]),
            linear_terms=np.zeros((num_springs, 4)),
            direction_state=np.zeros(1, DIRECTION_STATE_DTYPE),
        )


class SearchStep(NamedTuple):
    """The objective of a step, the iterate and the vectors of a solve.

    Attributes:
        objective_terms, quadratic_form, step_data, exact_pins: the objective.
        unpinned_trace: trace of Q's unpinned part [N/m].
        positions: the iterate (n, 3) [m].
        vectors: the vectors.
    """

    objective_terms: ObjectiveTerms
    quadratic_form: QuadraticForm | None
    step_data: StepData
    exact_pins: ExactPins
    unpinned_trace: float
    positions: Positions
    vectors: SearchVectors


@jit_kernel
def start_conjugate_solve(step: SearchStep):
    """Start the solve of a step at its positions: write the gradient there.

    Args:
        step: the step, with exactly pinned vertices on their targets; its vectors are overwritten.
    """
    now = step.vectors.direction_state[0]
    now.is_new_point, now.slope_change = 1, 0.0
    terms = step.objective_terms, step.quadratic_form, step.step_data, step.exact_pins
    write_free_gradient(*terms, step.positions, step.vectors.gradient)


@jit_kernel
def search_along_conjugate(step: SearchStep, correction):
    """Do one iteration.

    Args:
        step: the step; its positions and gradient become those of the next point.
        correction: z = Q^-1 g at the current point (n, 3) [m].

    Returns:
        Whether a step descended. If not, the positions do not change.
    """
    vectors, now = step.vectors, step.vectors.direction_state[0]
    if now.is_new_point:
        _read_correction(vectors, now, correction)
    slope = -_inner_product(vectors.gradient_entries, vectors.correction_entries)
    roundoff = (EPS * compute_max_magnitude(step.positions)) ** 2 * step.unpinned_trace
    if not -slope > roundoff:
        return False
    linearise_springs(step.objective_terms, step.positions, vectors.linear_terms)
    if now.beta != 0.0:
        for k in range(len(vectors.direction_entries)):
            vectors.direction_entries[k] = now.beta * vectors.direction_entries[k] - vectors.correction_entries[k]
        along = _inner_product(vectors.gradient_entries, vectors.direction_entries)
        if _search_quadratic_model(step, along):
            _accept_trial(step, now)
            return True
    for k in range(len(vectors.direction_entries)):
        vectors.direction_entries[k] = -vectors.correction_entries[k]
    if _search_quadratic_model(step, slope) or _search_line(step, slope, 1.0):
        _accept_trial(step, now)
        return True
    return False


@jit_inner
def _read_correction(vectors, now, correction):
    """Copy the correction at a new point, and compute beta."""
    for v in range(len(correction)):
        for c in range(3):
            vectors.correction_change[v, c] = correction[v, c] - vectors.correction[v, c]
            vectors.correction[v, c] = correction[v, c]
    now.is_new_point, now.beta = 0, 0.0
    if not now.slope_change > 0.0:
        return
    y, d = vectors.gradient_change_entries, vectors.direction_entries
    slope = _inner_product(vectors.gradient_entries, d)
    beta = (
        _inner_product(y, vectors.correction_entries)
        - _inner_product(vectors.correction_change_entries, y) * slope / now.slope_change
    )
    if np.isfinite(beta):
        now.beta = beta / now.slope_change


@jit_inner
def _search_quadratic_model(step, slope):
    """Search along the direction, first at the minimum of the quadratic model."""
    vectors, terms = step.vectors, step.objective_terms
    multiply_hessian(terms, vectors.linear_terms, step.quadratic_form, None, None, vectors.direction, vectors.product)
    for k in range(len(step.exact_pins.vertices)):
        for c in range(3):
            vectors.product[step.exact_pins.vertices[k], c] = 0.0
    curvature = _inner_product(vectors.direction_entries, vectors.product_entries)
    return slope < 0.0 < curvature and _search_line(step, slope, -slope / curvature)


@jit_inner
def _search_line(step, slope, initial_step):
    """Search along the direction by halving the step size; return whether it descends."""
    vectors, t = step.vectors, initial_step
    for _ in range(MAX_HALVINGS if slope < 0.0 < t else 0):
        _, is_sufficient = try_step(
            step.objective_terms,
            step.quadratic_form,
            step.step_data,
            step.exact_pins,
            step.positions,
            vectors.direction,
            t,
            slope,
            0.0,
            vectors.trial_positions,
            vectors.trial_gradient,
        )
        if is_sufficient:
            return True
        t *= 0.5
    return False


@jit_inner
def _accept_trial(step, now):
    """Make the trial the current point."""
    vectors = step.vectors
    for v in range(len(step.positions)):
        for c in range(3):
            step.positions[v, c] = vectors.trial_positions[v, c]
            vectors.gradient_change[v, c] = vectors.trial_gradient[v, c] - vectors.gradient[v, c]
            vectors.gradient[v, c] = vectors.trial_gradient[v, c]
    now.is_new_point = 1
    now.slope_change = _inner_product(vectors.direction_entries, vectors.gradient_change_entries)


@jit_inner
def _inner_product(a, b):
    """Return the inner product of two vectors, summed as by `numpy.einsum` on x86-64.

    Even and odd entries are summed separately, in groups of eight from the last pair to the first.

    Args:
        a, b: entries (k,).
    """
    total = 0.0
    for begin in range(0, len(a), _SUM_ENTRIES):
        end = min(len(a), begin + _SUM_ENTRIES)
        even, odd, k = 0.0, 0.0, begin
        while k + 8 <= end:
            for pair in range(6, -1, -2):
                even += a[k + pair] * b[k + pair]
                odd += a[k + pair + 1] * b[k + pair + 1]
            k += 8
        while k < end:
            even += a[k] * b[k]
            if k + 1 < end:
                odd += a[k + 1] * b[k + 1]
            k += 2
        total += even + odd
    return total

"""Compiled full step of Newton's method with predicted tensions, for springs and quadratic forms.

`springbench.solvers.methods.newton.predicted_tension` describes the method.
"""

from __future__ import annotations

from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.kernels.objective_kernels import (
    change_objective,
    compute_inner_product,
    move_to_targets,
    write_free_gradient,
)
from springbench.solvers.kernels.spring_hessian import assemble_hessian, linearise_tensions
from springbench.solvers.methods.newton.newton_kernel import solve_negative


@jit_kernel
def try_full_step(
    arrays, step_data, exact_pins, tensions, negative_fraction, shift, min_fraction, p, gradient, predicted, q, there
):
    """Solve for a direction, and evaluate the full step along it.

    Args:
        arrays: arrays of the system; the direction is written there.
        step_data: data of the step.
        exact_pins: exactly pinned vertices, which are moved to their targets.
        tensions: tensions of the springs in the Hessian (m,) [N].
        negative_fraction: factor of the springs' negative transverse parts.
        shift: multiple of the inertia that is added.
        min_fraction: fraction of the slope from which the decrease of the objective is sufficient.
        p: positions (n, 3) [m].
        gradient: gradient there (n, 3) [N].
        predicted: output, tensions linearised for the direction (m,) [N].
        q: output, positions after the full step (n, 3) [m].
        there: output, gradient there (n, 3) [N], if the decrease is sufficient.

    Returns:
        The supernode at which the factorisation failed or -1, the slope [J], and whether the decrease is sufficient.
    """
    terms, form, places = arrays.search.objective_terms, arrays.search.quadratic_form, arrays.block_indices
    assemble_hessian(terms, places, arrays.constant_blocks, p, tensions, negative_fraction, arrays.values)
    if shift > 0.0:
        for v in places.free_vertices:
            for c in range(3):
                arrays.values[places.diagonal_block[v], c, c] += shift * terms.inertia_diagonal[v]
    failed = solve_negative(arrays, arrays.factor.schedule, gradient)
    if failed >= 0:
        return failed, 0.0, False
    slope = compute_inner_product(gradient, arrays.direction)
    linearise_tensions(terms, p, arrays.direction, predicted)
    for v in range(len(p)):
        for c in range(3):
            q[v, c] = p[v, c] + arrays.direction[v, c]
    move_to_targets(exact_pins, q)
    is_sufficient = change_objective(terms, form, step_data, p, q) <= min_fraction * slope
    if is_sufficient:
        write_free_gradient(terms, form, step_data, exact_pins, q, there)
    return failed, slope, is_sufficient

"""The gradient of the objective, and its change between two points.

Each is computed in one pass over springs and one over vertices.

    grad g = sum_e k_e (1 - r_e/l_e) v_e + h (p - target) - f + w (p - pin)              h = c m/dt^2
    g(q) - g(p) = sum_e k_e/2 (l'_e - l_e) (l'_e + l_e - 2 r_e) + ...,   l' - l = (v' - v)(v' + v) / (l' + l)

The change is a sum of differences without cancellation, not the difference of two sums. It distinguishes descent from
round-off as long as the gradient does, long after the values of the energies agree in all digits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.jit.typed_kernel import as_kernel_array
from springbench.solvers.kernels.line_search_conditions import is_armijo_step
from springbench.solvers.kernels.quadratic_form_kernels import add_product, change_form
from springbench.solvers.kernels.spring_law import spring_energy_change, unit_direction
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions, StepProblem, System


class ObjectiveTerms(NamedTuple):
    """The constant data of a run: springs, inertia h (n,) [N/m], penalty pins and their weights [N/m]."""

    edges: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]
    inertia_diagonal: NDArray[np.float64]
    pinned_vertices: NDArray[np.int64]
    pin_weight: NDArray[np.float64]

    @classmethod
    def from_system(cls, system: System, springs: Springs) -> ObjectiveTerms:
        """Copy the terms of a system into arrays.

        Args:
            system: the system, for inertia and penalty pins.
            springs: all springs of the system, concatenated.
        """
        _, pinned, weight = system.penalty_pins
        s = springs
        arrays: list[Any] = [
            s.edges,
            s.stiffness,
            s.rest_length,
            s.rest_direction,
            system.inertia_diagonal,
            pinned,
            weight,
        ]
        return cls(*(np.array(a, order="C") for a in arrays))


class StepData(NamedTuple):
    """The data of a step: target (n, 3) [m], force (n, 3) [N], the penalty pins' targets (q, 3) [m]."""

    inertial_target: Positions
    external_force: Positions
    pin_targets: Positions

    @classmethod
    def from_problem(cls, problem: StepProblem) -> StepData:
        """Select a step's arrays."""
        soft, vertices, _ = problem.system.penalty_pins
        pin_targets = problem.pin_targets if len(vertices) == len(soft) else problem.pin_targets[soft]
        return cls(
            as_kernel_array(problem.inertial_target),
            as_kernel_array(problem.external_force),
            as_kernel_array(pin_targets),
        )


@jit_kernel
def compute_max_magnitude(p):
    """Return the largest absolute coordinate of p (n, 3), 0 without rows, NaN if one is."""
    largest = 0.0
    for v in range(len(p)):
        for c in range(3):
            size = abs(p[v, c])
            if size > largest or size != size:
                largest = size
    return largest


@jit_kernel
def predict_positions(inertia_diagonal, target, force, pinned_vertices, pin_targets, out):
    """Write the positions under inertia and external force alone.

    Args:
        inertia_diagonal: inertia h (n,) [N/m].
        target: inertial target (n, 3) [m].
        force: external force (n, 3) [N]; it does not move vertices without mass.
        pinned_vertices: vertices of all pins (q,).
        pin_targets: their targets (q, 3) [m], on which these vertices are placed.
        out: output (n, 3) [m].
    """
    for v in range(len(out)):
        h = inertia_diagonal[v]
        for c in range(3):
            out[v, c] = target[v, c] + (force[v, c] / h if h > 0.0 else 0.0)
    place_pinned(pinned_vertices, pin_targets, out)


@jit_inner
def place_pinned(pinned_vertices, pin_targets, p):
    """Place pinned vertices on their targets.

    Args:
        pinned_vertices: vertices of all pins (q,).
        pin_targets: their targets (q, 3) [m].
        p: positions (n, 3) [m], updated.
    """
    for q in range(len(pinned_vertices)):
        for c in range(3):
            p[pinned_vertices[q], c] = pin_targets[q, c]


@jit_kernel
def sum_constant_forces(inertia_diagonal, pinned_vertices, pin_weight, target, force, pin_targets, out):
    """Write the terms of the negative gradient that are constant in a step.

    They are h target + f + w p_pin.

    Args:
        inertia_diagonal: inertia h (n,) [N/m].
        pinned_vertices: vertices of all pins (q,).
        pin_weight: weight of each pin (q,) [N/m]; exact pins, of infinite weight, are omitted.
        target: inertial target (n, 3) [m].
        force: external force (n, 3) [N].
        pin_targets: targets of all pins (q, 3) [m].
        out: output (n, 3) [N], overwritten.
    """
    for v in range(len(out)):
        for c in range(3):
            out[v, c] = inertia_diagonal[v] * target[v, c] + force[v, c]
    for q in range(len(pinned_vertices)):
        if pin_weight[q] < np.inf:
            for c in range(3):
                out[pinned_vertices[q], c] += pin_weight[q] * pin_targets[q, c]


@jit_inner
def spring_direction(terms, e, p):
    """Return the unit direction of a spring and its length [m].

    Args:
        terms: objective terms.
        e: index of the spring.
        p: positions (n, 3) [m].

    Returns:
        Three components of the direction from second to first end, at zero length that of the rest shape, and the
        length.
    """
    i, j = terms.edges[e, 0], terms.edges[e, 1]
    return unit_direction(p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2], terms.rest_direction, e)


@jit_kernel
def gradient(terms, form, step_data, exact_pins, p, out):
    """Write the gradient of springs, a quadratic form and single vertices.

    Args:
        terms: objective terms.
        form: quadratic form, or None.
        step_data: data of the step.
        exact_pins: exactly pinned vertices.
        p: positions (n, 3) [m].
        out: output (n, 3) [N], overwritten; zero at exactly pinned vertices.
    """
    write_free_gradient(terms, form, step_data, exact_pins, p, out)


@jit_inner
def _write_gradient(terms, step_data, p, out):
    for v in range(len(p)):
        for c in range(3):
            out[v, c] = (
                terms.inertia_diagonal[v] * (p[v, c] - step_data.inertial_target[v, c]) - step_data.external_force[v, c]
            )
    for q in range(len(terms.pinned_vertices)):
        v = terms.pinned_vertices[q]
        for c in range(3):
            out[v, c] += terms.pin_weight[q] * (p[v, c] - step_data.pin_targets[q, c])
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        if i == j:
            continue
        n0, n1, n2, length = spring_direction(terms, e, p)
        tension = terms.stiffness[e] * (length - terms.rest_length[e])
        out[i, 0] += tension * n0
        out[i, 1] += tension * n1
        out[i, 2] += tension * n2
        out[j, 0] -= tension * n0
        out[j, 1] -= tension * n1
        out[j, 2] -= tension * n2


@jit_kernel
def bound_gradient_roundoff(terms, step_data, p, out):
    """Write the bound of the rounding error of `gradient`.

    It is that of `springbench.solvers.model.rounding_bound` for springs, inertia, force and penalty pins.

    Args:
        terms: objective terms.
        step_data: data of the step.
        p: positions (n, 3) [m].
        out: output (n,) [N], overwritten.
    """
    for v in range(len(p)):
        out[v] = terms.inertia_diagonal[v] * (row_norm(p, v) + row_norm(step_data.inertial_target, v)) + row_norm(
            step_data.external_force, v
        )
    for q in range(len(terms.pinned_vertices)):
        out[terms.pinned_vertices[q]] += terms.pin_weight[q] * (
            row_norm(p, terms.pinned_vertices[q]) + row_norm(step_data.pin_targets, q)
        )
    for e in range(len(terms.stiffness)):
        i, j, rest = terms.edges[e, 0], terms.edges[e, 1], terms.rest_length[e]
        if i == j:
            continue
        _, _, _, length = spring_direction(terms, e, p)
        reach = row_norm(p, i) + row_norm(p, j)
        turned = reach + 2.0 * rest / EPS
        if length > 0.0:
            turned = min(max(1.0, rest / length - 1.0) * reach, turned)
        share = terms.stiffness[e] * (turned + length + rest)
        out[i] += share
        out[j] += share
    for v in range(len(p)):
        out[v] *= EPS


@jit_inner
def row_norm(x, v):
    """Return the norm of a row.

    Args:
        x: rows (n, 3).
        v: index of the row.
    """
    return np.sqrt(x[v, 0] * x[v, 0] + x[v, 1] * x[v, 1] + x[v, 2] * x[v, 2])


@jit_kernel
def objective_change(terms, form, step_data, p, q):
    """Return g(q) - g(p) [J] of springs, a quadratic form and single vertices.

    Args:
        terms: objective terms.
        form: quadratic form, or None.
        step_data: data of the step.
        p, q: positions (n, 3) [m], before and after.
    """
    return change_objective(terms, form, step_data, p, q)


@jit_inner
def _change_objective(terms, step_data, p, q):
    total = 0.0
    for v in range(len(p)):
        for c in range(3):
            middle = 0.5 * (p[v, c] + q[v, c])
            total += (q[v, c] - p[v, c]) * (
                terms.inertia_diagonal[v] * (middle - step_data.inertial_target[v, c]) - step_data.external_force[v, c]
            )
    for k in range(len(terms.pinned_vertices)):
        v = terms.pinned_vertices[k]
        for c in range(3):
            middle = 0.5 * (p[v, c] + q[v, c])
            total += terms.pin_weight[k] * (q[v, c] - p[v, c]) * (middle - step_data.pin_targets[k, c])
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        total += spring_energy_change(terms.stiffness[e], terms.rest_length[e], i, j, p, q)
    return total


class ExactPins(NamedTuple):
    """The exactly pinned vertices (x,) and their targets (x, 3) [m]."""

    vertices: NDArray[np.int64]
    targets: Positions


@jit_inner
def move_to_targets(exact_pins, p):
    """Move the exactly pinned vertices to their targets.

    Args:
        exact_pins: the exactly pinned vertices.
        p: positions (n, 3) [m], updated.
    """
    for k in range(len(exact_pins.vertices)):
        for c in range(3):
            p[exact_pins.vertices[k], c] = exact_pins.targets[k, c]


@jit_inner
def change_objective(terms, form, step_data, p, q):
    """Return g(q) - g(p) [J] of springs, a quadratic form and single vertices.

    Args:
        terms: objective terms.
        form: quadratic form, or None.
        step_data: data of the step.
        p, q: positions (n, 3) [m], before and after.
    """
    return _change_objective(terms, step_data, p, q) + change_form(form, p, q)


@jit_inner
def write_free_gradient(terms, form, step_data, exact_pins, p, out):
    """Write the gradient of springs, a quadratic form and single vertices.

    Args:
        terms: objective terms.
        form: quadratic form, or None.
        step_data: data of the step.
        exact_pins: exactly pinned vertices.
        p: positions (n, 3) [m].
        out: output (n, 3) [N], overwritten; zero at exactly pinned vertices.
    """
    _write_gradient(terms, step_data, p, out)
    add_product(form, p, out)
    for k in range(len(exact_pins.vertices)):
        for c in range(3):
            out[exact_pins.vertices[k], c] = 0.0


@jit_kernel
def try_step(terms, form, step_data, exact_pins, p, direction, step_size, slope, curvature, q, out):
    """Evaluate a line-search trial, and the gradient there if the objective decreases enough.

    Args:
        terms: objective terms.
        form: quadratic form, or None.
        step_data: data of the step.
        exact_pins: exactly pinned vertices, which are moved to their targets.
        p: current positions (n, 3) [m].
        direction: search direction (n, 3) [m].
        step_size: multiple of the direction.
        slope, curvature: first and second derivative along the direction [J].
        q: output, positions of the trial (n, 3) [m].
        out: output, gradient at q (n, 3) [N], zero at exactly pinned vertices, if the decrease is sufficient.

    Returns:
        The change of the objective [J], and whether the decrease is sufficient.
    """
    for v in range(len(p)):
        for c in range(3):
            q[v, c] = p[v, c] + step_size * direction[v, c]
    move_to_targets(exact_pins, q)
    change = change_objective(terms, form, step_data, p, q)
    if not is_armijo_step(change, step_size, slope, curvature):
        return change, False
    write_free_gradient(terms, form, step_data, exact_pins, q, out)
    return change, True


@jit_inner
def compute_product_with_displacement(a, p, q):
    """Return the inner product of a field and a displacement over all vertices.

    Args:
        a: field (n, 3), such as a gradient [N].
        p, q: positions (n, 3) [m] before and after the displacement.
    """
    total = 0.0
    for v in range(len(p)):
        for c in range(3):
            total += a[v, c] * (q[v, c] - p[v, c])
    return total


@jit_inner
def compute_inner_product(a, b):
    """Return the inner product of two fields over all vertices.

    Args:
        a, b: fields (n, 3), such as a gradient [N] and a direction [m].
    """
    total = 0.0
    for v in range(len(a)):
        total += a[v, 0] * b[v, 0] + a[v, 1] * b[v, 1] + a[v, 2] * b[v, 2]
    return total

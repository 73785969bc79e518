"""Planted errors in integrators, steps, matrices and methods: name, file, fragment, replacement, tests."""

from __future__ import annotations

from tests.mutations.base import Mutation

_U = "tests/unit"
_STEPS, _ORDER = (f"{_U}/test_{name}.py" for name in ("simulate", "integrator_recursions"))

_TABLE = (
    ("bdf2-target", "solvers/model/integrators/single_stage.py", "2.0 * dt / 9.0", "2.0 * dt / 3.0", _ORDER),
    (
        "bdf2-factor",
        "solvers/model/integrators/single_stage.py",
        "SingleStageIntegrator(2.25,",
        "SingleStageIntegrator(2.0,",
        _ORDER,
    ),
    (
        "midpoint-target",
        "solvers/model/integrators/single_stage.py",
        "motion.positions + 0.5 * dt * motion.velocity",
        "motion.positions + dt * motion.velocity",
        _ORDER,
    ),
    (
        "midpoint-velocity",
        "solvers/model/integrators/single_stage.py",
        "2.0 * v - step_start.velocity",
        "1.9 * v - step_start.velocity",
        _ORDER,
    ),
    (
        "midpoint-forces",
        "solvers/model/integrators/single_stage.py",
        "SingleStageIntegrator(4.0, 0.5, 0.5,",
        "SingleStageIntegrator(4.0, 0.5, 0.0,",
        "tests/contracts/test_integrators.py::test_the_error_falls_with_the_methods_order",
    ),
    (
        "euler-target",
        "solvers/model/integrators/single_stage.py",
        "motion.positions + dt * motion.velocity, motion",
        "motion.positions + 0.9 * dt * motion.velocity, motion",
        _STEPS,
    ),
    ("force-time", "harness/simulation/time_loop.py", "time + a * dt)", "time + dt)", _STEPS),
    (
        "filters-first",
        "harness/simulation/time_loop.py",
        "in scene.velocity_filters:",
        "in scene.velocity_filters[:1]:",
        _STEPS,
    ),
    (
        "inertial-guess",
        "harness/simulation/time_loop.py",
        "initial_guess=_place_pins(step_problem.system, step_problem.inertial_target, step_problem.pin_targets)",
        "initial_guess=step_problem.inertial_target",
        _STEPS,
    ),
    (
        "pins-late",
        "harness/simulation/time_loop.py",
        "scene.compute_pin_targets(time + dt)",
        "scene.compute_pin_targets(time)",
        f"{_U}/test_effect_motion.py",
    ),
    (
        "inertia-in-matrix",
        "solvers/model/system_matrix_assembly.py",
        "A.T @ K @ A + M / time_step**2",
        "A.T @ K @ A + M / time_step",
        f"{_U}/test_matrices.py",
    ),
    (
        "pins-in-matrix",
        "solvers/model/system_matrix_assembly.py",
        "system.inertia_diagonal + np.bincount(vertices, weight,",
        "system.inertia_diagonal + np.bincount(vertices, 2.0 * weight,",
        f"{_U}/test_local_global.py",
    ),
    (
        "force-in-right",
        "solvers/kernels/objective_kernels.py",
        "out[v, c] = inertia_diagonal[v] * target[v, c] + force[v, c]",
        "out[v, c] = inertia_diagonal[v] * target[v, c] - force[v, c]",
        f"{_U}/test_local_global.py",
    ),
    (
        "zero-length",
        "solvers/methods/local_global/reference_local_global.py",
        "np.where(length <= ZERO_LENGTH, rest_direction,",
        "np.where(length <= ZERO_LENGTH, -rest_direction,",
        f"{_U}/test_local_global.py",
    ),
    (
        "stop-early",
        "solvers/kernels/iteration_loop.py",
        "if residual <= limits.residual_limit:",
        "if residual <= 10.0 * limits.residual_limit:",
        f"{_U}/test_stop_rule.py",
    ),
    (
        "newton-direction",
        "solvers/methods/newton/newton_direct.py",
        "direction = -hessian.solve(at.gradient)",
        "direction = -0.5 * hessian.solve(at.gradient)",
        f"{_U}/test_newton.py",
    ),
    (
        "compiled-newton-direction",
        "solvers/methods/newton/newton_kernel.py",
        "arrays.direction[free[k], c] = -x[k, c]",
        "arrays.direction[free[k], c] = -0.5 * x[k, c]",
        f"{_U}/test_newton.py",
    ),
    (
        "compiled-newton-convergence",
        "solvers/methods/newton/newton_kernel.py",
        "        and now.decrement_ratio <= max_ratio\n",
        "",
        f"{_U}/test_compiled_iterations.py",
    ),
    (
        "compiled-tension-shift",
        "solvers/methods/newton/predicted_tension_kernel.py",
        "shift * terms.inertia_diagonal[v]",
        "0.5 * shift * terms.inertia_diagonal[v]",
        f"{_U}/test_compiled_iterations.py",
    ),
    (
        "compiled-tension-prediction",
        "solvers/methods/newton/predicted_tension_kernel.py",
        "tensions[e] += length * (state.predicted[e] - tensions[e])",
        "tensions[e] += 0.5 * length * (state.predicted[e] - tensions[e])",
        f"{_U}/test_compiled_iterations.py",
    ),
    (
        "compiled-newton-cg-tolerance",
        "solvers/methods/newton/newton_cg_kernel.py",
        "max(MIN_ETA, 0.9 * square / square_before,",
        "max(MIN_ETA, 0.3,",
        f"{_U}/test_newton_cg.py",
    ),
    (
        "compiled-conjugate-direction",
        "solvers/methods/quasi_newton/nonlinear_cg_kernel.py",
        "w[v, c] = correction[v, c] - w[v, c]",
        "w[v, c] = correction[v, c]",
        f"{_U}/test_compiled_iterations.py",
    ),
    (
        "compiled-jacobi-pins",
        "solvers/methods/local_global/aggregated_jacobi_kernel.py",
        "move_to_targets(step.exact_pins, step.vectors.trial_positions)",
        "pass",
        f"{_U}/test_compiled_iterations.py",
    ),
    (
        "xpbd-force",
        "solvers/methods/position_based/xpbd_projection.py",
        "(length - rest_length[e])",
        "(length - 1.01 * rest_length[e])",
        f"{_U}/test_xpbd.py",
    ),
    (
        "xpbd-velocity",
        "solvers/methods/position_based/xpbd_projection.py",
        "(p[i, c] - before[i, c]) / h",
        "(p[i, c] - before[i, c]) / (1.1 * h)",
        f"{_U}/test_xpbd.py",
    ),
    (
        "explicit-drift",
        "solvers/methods/time_stepping/symplectic_euler.py",
        "p[k] += h * v[k]",
        "p[k] += 0.9 * h * v[k]",
        f"{_U}/test_symplectic_euler.py",
    ),
)

STEPS = tuple(Mutation(name, file, old, new, (tests,)) for name, file, old, new, tests in _TABLE)

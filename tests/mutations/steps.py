"""Lies in integrators, steps, matrices and methods: name, file, fragment, replacement, tests."""

from __future__ import annotations

from tests.mutations.base import Mutation

_K, _M, _U = "solvers/kernels", "solvers/methods", "tests/unit"
_STEPS, _ORDER = (f"{_U}/test_{name}.py" for name in ("simulate", "integrator_recursions"))

_TABLE = (
    ("bdf2-target", "solvers/model/integrators/single_stage.py", "2.0 * dt / 9.0", "2.0 * dt / 3.0", _ORDER),
    ("bdf2-factor", "solvers/model/integrators/single_stage.py", "Integrator(2.25,", "Integrator(2.0,", _ORDER),
    (
        "midpoint-target",
        "solvers/model/integrators/single_stage.py",
        "now.positions + 0.5 * dt * now.velocity",
        "now.positions + dt * now.velocity",
        _ORDER,
    ),
    (
        "midpoint-velocity",
        "solvers/model/integrators/single_stage.py",
        "2.0 * v - start.velocity",
        "1.9 * v - start.velocity",
        _ORDER,
    ),
    (
        "midpoint-forces",
        "solvers/model/integrators/single_stage.py",
        "Integrator(4.0, 0.5, 0.5,",
        "Integrator(4.0, 0.5, 0.0,",
        "tests/contracts/test_integrators.py::test_the_error_falls_with_the_methods_order",
    ),
    (
        "euler-target",
        "solvers/model/integrators/single_stage.py",
        "now.positions + dt * now.velocity, now",
        "now.positions + 0.9 * dt * now.velocity, now",
        _STEPS,
    ),
    ("force-time", "harness/simulation/time_loop.py", "time + a * dt)", "time + dt)", _STEPS),
    (
        "filters-first",
        "harness/simulation/time_loop.py",
        "filtered(v), scene.filters, motion",
        "filtered(v), scene.filters[:1], motion",
        _STEPS,
    ),
    (
        "inertial-guess",
        "harness/simulation/time_loop.py",
        "first_guess=_pinned(stated.system, stated.inertial_target, stated.pin_targets)",
        "first_guess=stated.inertial_target",
        _STEPS,
    ),
    (
        "pins-late",
        "harness/simulation/time_loop.py",
        "scene.pins_at(time + dt)",
        "scene.pins_at(time)",
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
        "system.inertia + np.bincount(vertices, weight,",
        "system.inertia + np.bincount(vertices, 2.0 * weight,",
        f"{_U}/test_local_global.py",
    ),
    (
        "force-in-right",
        "solvers/methods/local_global/prefactored.py",
        "y = s.inertia[:, None] * problem.inertial_target + problem.force",
        "y = s.inertia[:, None] * problem.inertial_target - problem.force",
        f"{_U}/test_local_global.py",
    ),
    (
        "zero-length",
        f"{_M}/local_global.py",
        "np.where(length <= TINY, rest_direction,",
        "np.where(length <= TINY, -rest_direction,",
        f"{_U}/test_local_global.py",
    ),
    (
        "stop-early",
        f"{_K}/loop.py",
        "if residual <= limits.limit:",
        "if residual <= 10.0 * limits.limit:",
        f"{_U}/test_stop_rule.py",
    ),
    (
        "newton-direction",
        f"{_M}/newton.py",
        "direction = -hessian.solve(at.gradient)",
        "direction = -0.5 * hessian.solve(at.gradient)",
        f"{_U}/test_newton.py",
    ),
    (
        "xpbd-force",
        f"{_K}/xpbd.py",
        "(length - rest_length[e])",
        "(length - 1.01 * rest_length[e])",
        f"{_U}/test_xpbd.py",
    ),
    (
        "xpbd-velocity",
        f"{_K}/xpbd.py",
        "(p[i, c] - before[i, c]) / h",
        "(p[i, c] - before[i, c]) / (1.1 * h)",
        f"{_U}/test_xpbd.py",
    ),
    (
        "explicit-drift",
        f"{_K}/explicit.py",
        "p[k] += h * v[k]",
        "p[k] += 0.9 * h * v[k]",
        f"{_U}/test_symplectic_euler.py",
    ),
)

STEPS = tuple(Mutation(name, file, old, new, (tests,)) for name, file, old, new, tests in _TABLE)

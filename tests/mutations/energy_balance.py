"""Errors in the balance of energy: what a motion has, what sources give, and what becomes of a run that gains."""

from __future__ import annotations

from tests.mutations.base import Mutation

_BALANCE, _TESTS = "harness/simulation/energy_balance.py", ("tests/unit/test_energy_balance.py",)

ENERGY_BALANCE = (
    Mutation("kinetic-energy-doubled", _BALANCE, "return 0.5 * float(mass @", "return float(mass @", _TESTS),
    Mutation(
        "velocity-as-claimed",
        _BALANCE,
        "speed = step.state.motion.velocity, moved / stated.system.time_step",
        "speed = step.state.motion.velocity, 0.0 * moved",
        _TESTS,
    ),
    Mutation(
        "drag-as-source",
        _BALANCE,
        "work.append(min(float(np.mean(taken)), self._force_work(step, moved)))",
        "work.append(float(np.mean(taken)))",
        _TESTS,
    ),
    Mutation(
        "pins-give-nothing",
        _BALANCE,
        "work.append(_dot(self._conservative_gradient(stated, x)[self._exact], moved[self._exact]))",
        "work.append(0.0)",
        _TESTS,
    ),
    Mutation(
        "load-left-out",
        _BALANCE,
        "-_dot(self._load, (p - self._first)[self._free]),",
        "0.0,",
        _TESTS,
    ),
    Mutation(
        "pins-projected-by-the-integrator",
        _BALANCE,
        "if not is_way_simulated and away[led].any():",
        "if False:",
        ("tests/unit/test_dissipation.py::test_pins_that_the_start_has_displaced_are_projected_before_the_motion",),
    ),
    Mutation("growth-of-a-thousand", _BALANCE, "GROWTH_LIMIT = 1.0", "GROWTH_LIMIT = 1e4", _TESTS),
    Mutation(
        "growth-is-ok",
        "harness/experiments/failure_columns.py",
        '"status": "energy-growth"',
        '"status": "ok"',
        _TESTS,
    ),
    Mutation(
        "no-blow-up",
        "harness/simulation/instrumentation_pass.py",
        "if balance.is_above(BLOW_UP_FACTOR):",
        "if False:",
        _TESTS,
    ),
)

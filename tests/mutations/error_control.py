"""Errors planted in error control: name, file, fragment, replacement, tests."""

from __future__ import annotations

from tests.mutations.base import Mutation

_SEARCH, _GROWTH = "harness/experiments/error_control/method_search.py", "harness/reference/perturbation_growth.py"
_CONTROLLER = "solvers/model/integrators/step_size_controller.py"
_CONTROLLERS = "tests/unit/test_step_size_controller.py"
_FORMULAS = "tests/contracts/test_error_search.py"
_ERROR_CONTROL = "tests/contracts/test_error_control.py"
_GROWS = f"{_ERROR_CONTROL}::test_growth_does_not_depend_on_the_time_step_and_ends_where_nothing_is_predictable"

_TABLE = (
    (
        "control-power",
        "harness/simulation/adaptive_stepping.py",
        "setting * ratio ** ((order + 1.0) / order)",
        "setting * ratio ** (order / (order + 1.0))",
        f"{_ERROR_CONTROL}::test_a_tolerance_is_changed_by_the_order_of_a_step",
    ),
    ("control-history", _CONTROLLER, "** (-control.beta_2 / power)", "** (control.beta_2 / power)", _CONTROLLERS),
    ("control-limits", _CONTROLLER, "min(control.max_factor, max(control.min_factor, change))", "change", _CONTROLLERS),
    (
        "control-measured",
        _SEARCH,
        "log(before.error_estimated / after.error_estimated) / shorter",
        "log(before.error_estimated / after.error_estimated) / (2.0 * shorter)",
        _FORMULAS,
    ),
    (
        "control-promise",
        _SEARCH,
        "stepping * error_fraction ** (-1.0 / trial.order)",
        "stepping * error_fraction ** -1.0",
        _FORMULAS,
    ),
    (
        "control-fallback",
        "harness/experiments/best_first_search.py",
        "answer.error <= max_error",
        "answer.error < 10.0 * max_error",
        _FORMULAS,
    ),
    (
        "growth-rescaled",
        _GROWTH,
        "one + (two - one) * (first / apart), factor * apart / first",
        "one + (two - one) * (first / apart), factor",
        _GROWS,
    ),
    ("growth-not-rescaled", _GROWTH, "if apart > _LINEAR_LIMIT * first:", "if apart > 1e30 * first:", _GROWS),
    (
        "growth-longest",
        _GROWTH,
        "self.times[self.growth_factor <= _HORIZON_SAFETY * REFERENCE_MARGIN * error]",
        "self.times[self.growth_factor <= error]",
        f"{_ERROR_CONTROL}::test_a_refusal_names_the_longest_horizon_that_works",
    ),
    (
        "growth-at-rest",
        _GROWTH,
        "moved.max() > unit * max(1, half) ** 0.5",
        "moved.max() > 0.0",
        f"{_ERROR_CONTROL}::test_what_only_round_off_moves_is_at_rest",
    ),
    (
        "error-doubt",
        _SEARCH,
        "ESTIMATE_SAFETY * self._compute_distance(p[-1], q[-1]) / moved",
        "0.5 * self._compute_distance(p[-1], q[-1]) / moved",
        _FORMULAS,
    ),
)

ERROR_CONTROL = tuple(Mutation(name, file, old, new, (tests,)) for name, file, old, new, tests in _TABLE)

"""Planted errors in whether a setting is converged: name, file, fragment, replacement, test."""

from __future__ import annotations

from tests.mutations.base import Mutation

_STUDY, _VERDICT = "harness/experiments/setting_convergence.py", "harness/results/setting_verdict.py"
_TESTS = "tests/unit/test_setting_convergence.py"
_WORDS = f"{_TESTS}::test_the_verdict_names_what_is_wrong_and_the_cheapest_setting_for_each_error"
_CHANGE = f"{_TESTS}::test_the_change_of_two_motions_is_relative_to_the_largest_displacement"

_TABLE = (
    (
        "setting-change-of-the-end",
        _STUDY,
        "largest = float(np.linalg.norm(moved, axis=1).max(initial=0.0))",
        "largest = float(np.linalg.norm(moved, axis=1)[-1])",
        _CHANGE,
    ),
    (
        "setting-pins-count",
        _STUDY,
        "((x - y)[:, free_vertices].reshape(len(q), -1) for",
        "((x - y).reshape(len(q), -1) for",
        _CHANGE,
    ),
    (
        "setting-stiffness-inverted",
        _STUDY,
        "return {setting: true / sag for",
        "return {setting: sag / true for",
        f"{_TESTS}::test_the_effective_stiffness_is_the_true_sag_over_that_of_the_setting",
    ),
    (
        "setting-drift-reversed",
        _STUDY,
        "return (_compute_mechanical_energy(scene, p, v) - self.end_energy) / self.kinetic_scale",
        "return (self.end_energy - _compute_mechanical_energy(scene, p, v)) / self.kinetic_scale",
        f"{_TESTS}::test_the_drift_is_the_energy_above_the_reference_over_its_largest_kinetic_energy",
    ),
    (
        "setting-energy-without-load",
        _STUDY,
        'stored - float(np.einsum("ij,ij->", scene.constant_force, p))',
        "stored",
        f"{_TESTS}::test_the_drift_is_the_energy_above_the_reference_over_its_largest_kinetic_energy",
    ),
    (
        "setting-finest-is-coarsest",
        _STUDY,
        "fine = max(known, key=lambda one:",
        "fine = min(known, key=lambda one:",
        f"{_TESTS}::test_without_a_reference_settings_are_compared_with_the_finest",
    ),
    ("setting-by-threes", _VERDICT, "factors = [2**k for", "factors = [3**k for", _TESTS),
    (
        "setting-cheapest-is-best",
        _VERDICT,
        "return min(within, key=lambda result: result.frame_seconds, default=None)",
        "return min(within, key=lambda result: result.error, default=None)",
        _WORDS,
    ),
    (
        "setting-doubling-ignored",
        _VERDICT,
        "max([self.find_result(assessment.setting).error, *changes])",
        "max([self.find_result(assessment.setting).error])",
        f"{_TESTS}::test_converged_is_a_small_error_that_doubling_does_not_change",
    ),
)

SETTINGS = tuple(Mutation(name, file, old, new, (test,)) for name, file, old, new, test in _TABLE)

"""Planted errors in performance tests: in their statistics, verdicts and comparisons."""

from __future__ import annotations

from tests.mutations.base import Mutation

_UNIT_ABBA, _UNIT_LISTED, _UNIT_SEQUENTIAL = (
    f"tests/unit/test_{name}.py" for name in ("abba_benchmark", "gates_file", "confidence_sequence")
)

GATES = (
    Mutation(
        "each-gate-errs-as-the-file-may",
        "harness/experiments/regression/gates_file.py",
        "alpha / len(gates_file.gates)",
        "alpha",
        (_UNIT_LISTED,),
    ),
    Mutation(
        "a-budget-for-each-race",
        "harness/experiments/regression/abba_benchmark.py",
        "max(time_budget - first.elapsed_seconds, 0.0)",
        "time_budget",
        (_UNIT_ABBA,),
    ),
    Mutation(
        "unconfirmed-holds",
        "harness/experiments/regression/abba_benchmark.py",
        "RegressionVerdict.FAIL if second.verdict is RegressionVerdict.FAIL else RegressionVerdict.INCONCLUSIVE",
        "RegressionVerdict.FAIL if second.verdict is RegressionVerdict.FAIL else RegressionVerdict.PASS",
        (_UNIT_ABBA,),
    ),
    Mutation(
        "times-exchanged",
        "harness/experiments/regression/abba_benchmark.py",
        'compute_log_ratio(self.program_seconds("A"), self.program_seconds("B"))',
        'compute_log_ratio(self.program_seconds("B"), self.program_seconds("A"))',
        (_UNIT_ABBA,),
    ),
    Mutation(
        "undecided-outweighs-failure",
        "harness/results/regression_verdict.py",
        "if RegressionVerdict.FAIL in found:",
        "if found == {RegressionVerdict.FAIL}:",
        ("tests/unit/test_regress_revision.py::test_a_failure_outweighs_an_inconclusive_test_and_that_a_pass",),
    ),
    Mutation(
        "sizes-from-the-origin",
        "harness/experiments/regression/program_pair.py",
        "float(np.ptp(points, axis=0).max(initial=0.0)) if points.size",
        "float(np.abs(points).max(initial=0.0)) if points.size",
        ("tests/unit/test_pytest_plugin.py::test_solutions_are_compared_relative_to_their_size",),
    ),
    Mutation(
        "an-interval-too-narrow",
        "harness/experiments/regression/confidence_sequence.py",
        "exp(x[n - needed]), exp(x[needed - 1])",
        "exp(x[n - needed + 1]), exp(x[needed - 2])",
        (_UNIT_SEQUENTIAL,),
    ),
)

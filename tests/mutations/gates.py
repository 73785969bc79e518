"""Lies in gates: in their statistics, their answers and what they compare."""

from __future__ import annotations

from tests.mutations.base import Mutation

_ABBA, _AGAINST, _AGREEMENT, _LISTED, _SEQUENTIAL = (
    f"harness/experiments/gates/{name}.py" for name in ("abba", "against", "agreement", "listed", "sequential")
)
_UNIT_ABBA, _UNIT_LISTED, _UNIT_SEQUENTIAL = (
    f"tests/unit/test_gate_{name}.py" for name in ("abba", "listed", "sequential")
)

GATES = (
    Mutation(
        "each-gate-errs-as-the-table-may",
        _LISTED,
        "alpha / len(table.gates)",
        "alpha",
        (_UNIT_LISTED,),
    ),
    Mutation(
        "a-budget-for-each-race",
        _ABBA,
        "max(budget - first.elapsed, 0.0)",
        "budget",
        (_UNIT_ABBA,),
    ),
    Mutation(
        "unconfirmed-holds",
        _ABBA,
        "Verdict.FAILS if second.answer is Verdict.FAILS else Verdict.UNDECIDED",
        "Verdict.FAILS if second.answer is Verdict.FAILS else Verdict.HOLDS",
        (_UNIT_ABBA,),
    ),
    Mutation(
        "times-exchanged",
        _ABBA,
        'turn(self.of("A"), self.of("B"))',
        'turn(self.of("B"), self.of("A"))',
        (_UNIT_ABBA,),
    ),
    Mutation(
        "undecided-outweighs-failure",
        _AGAINST,
        "(Verdict.FAILS, Verdict.UNDECIDED) if a in answers",
        "(Verdict.UNDECIDED, Verdict.FAILS) if a in answers",
        ("tests/unit/test_gate_against.py::test_one_failure_outweighs_what_is_undecided_and_that_what_holds",),
    ),
    Mutation(
        "sizes-from-the-origin",
        _AGREEMENT,
        "float(np.ptp(points, axis=0).max(initial=0.0)) if points.size",
        "float(np.abs(points).max(initial=0.0)) if points.size",
        ("tests/unit/test_gate_plugin.py::test_answers_are_compared_in_their_own_size",),
    ),
    Mutation(
        "an-interval-too-narrow",
        _SEQUENTIAL,
        "exp(x[n - needed]), exp(x[needed - 1])",
        "exp(x[n - needed + 1]), exp(x[needed - 2])",
        (_UNIT_SEQUENTIAL,),
    ),
)

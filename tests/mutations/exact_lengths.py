"""Errors in exact lengths: their multipliers, the residual that ends a solve, and the dual step."""

from __future__ import annotations

from tests.mutations.base import Mutation

_MULTIPLIERS, _AVBD, _GRADE = (
    "solvers/methods/vertex_block/lagrange_multipliers.py",
    "solvers/methods/vertex_block/avbd.py",
    "harness/reference/residual_audit.py",
)
_TESTS = "tests/unit/test_avbd.py"

EXACT_LENGTHS = (
    Mutation(
        "multipliers-of-one-limit",
        _MULTIPLIERS,
        "return np.where(\n            (trial > x.max_length) | (x.min_length == x.max_length), 1, "
        "np.where(trial < x.min_length, -1, 0)\n        )",
        "return np.ones(len(trial), np.int64)",
        (_TESTS,),
    ),
    Mutation(
        "multipliers-halved",
        _MULTIPLIERS,
        "tension[active_indices] = found",
        "tension[active_indices] = 0.5 * found",
        (_TESTS,),
    ),
    Mutation(
        "multipliers-of-lengths-unmended",
        _MULTIPLIERS,
        "right = np.concatenate([downhill, length_changes])",
        "right = np.concatenate([downhill, 0.0 * open])",
        (_TESTS,),
    ),
    Mutation(
        "ended-by-own-multipliers",
        _AVBD,
        "while ended == iteration_loop.REASON_TOLERANCE and not residual <= limits.residual_limit:",
        "while False:",
        (_TESTS,),
    ),
    Mutation(
        "exact-lengths-exempt",
        _GRADE,
        "if self._done in self._frames and np",
        "if self._done in self._frames and not problem.system.lengths and np",
        (_TESTS,),
    ),
    Mutation(
        "stabilisation-halved",
        _AVBD,
        "past = method.error_stabilisation * np.where",
        "past = 0.5 * method.error_stabilisation * np.where",
        (_TESTS,),
    ),
    Mutation(
        "doubt-a-hundredth",
        "harness/reference/hessian_curvature.py",
        "here = HessianCurvature(smallest, 4.0 * (sums + moved), direction, solve)",
        "here = HessianCurvature(smallest, 0.04 * (sums + moved), direction, solve)",
        ("tests/unit/test_verification.py",),
    ),
)

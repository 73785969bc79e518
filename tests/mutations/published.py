"""Planted errors in the published set, and in how repetitions are compared with it: name, file, fragment, replacement,
test."""

from __future__ import annotations

from tests.mutations.base import Mutation

_COMPARISON = "harness/results/study_comparison.py"
_TESTS = "tests/unit/test_reproduce.py"
_STEP = f"{_TESTS}::test_a_step_agrees_within_the_tolerances"

_TABLE = (
    (
        "published-checksum-unread",
        "harness/results/published_set.py",
        "stated.get(path) != compute_file_digest(path)",
        "path not in stated",
        f"{_TESTS}::test_a_changed_table_is_refused",
    ),
    ("repeated-iterations-any", _COMPARISON, "ITERATION_SLACK = 0.1, 3", "ITERATION_SLACK = 0.1, 30", _STEP),
    (
        "repeated-residual-of-one-side",
        _COMPARISON,
        "if not was / RESIDUAL_FACTOR <= now <= was * RESIDUAL_FACTOR:",
        "if not now <= was * RESIDUAL_FACTOR:",
        _STEP,
    ),
    (
        "repeated-residual-below-tolerance",
        _COMPARISON,
        "or _meets_tolerance(old) or _meets_tolerance(new):",
        "or _meets_tolerance(old):",
        _STEP,
    ),
    (
        "repeated-outcome-ignored",
        _COMPARISON,
        "    if was != now:\n",
        "    if False:\n",
        f"{_TESTS}::test_another_outcome_differs",
    ),
    (
        "repeated-ratio-of-one-side",
        _COMPARISON,
        "if low <= new.ratio <= high:",
        "if low <= new.ratio:",
        f"{_TESTS}::test_a_ratio_agrees_within_the_published_interval",
    ),
    (
        "repeated-share-of-a-fifth",
        _COMPARISON,
        "MAX_DIFFERING_SHARE = 0.02",
        "MAX_DIFFERING_SHARE = 0.2",
        f"{_TESTS}::test_two_in_a_hundred_runs_may_differ",
    ),
    (
        "repeated-by-any-seed",
        "harness/experiments/archive/study_reproduction.py",
        "random.Random(seed).sample",
        "random.Random().sample",
        f"{_TESTS}::test_a_tenth_is_drawn_by_its_seed",
    ),
    (
        "published-times-of-untimed",
        "harness/experiments/archive/study_publication.py",
        "_drop_columns(rows, DROPPED_COLUMNS) if has_times else _drop_times(rows)",
        "_drop_columns(rows, DROPPED_COLUMNS)",
        f"{_TESTS}::test_an_untimed_study_publishes_no_times",
    ),
)

PUBLISHED_STUDIES = tuple(Mutation(name, file, old, new, (test,)) for name, file, old, new, test in _TABLE)

"""Lies in how results are read together, packed, merged, published and verified, and in locks."""

from __future__ import annotations

from tests.mutations.base import Mutation

_COMPACT, _MERGE, _PUBLISH, _VERIFY = (
    f"harness/experiments/archive/{name}.py" for name in ("compact", "merge", "publish", "verify")
)
_SHELF, _MERGED, _PUBLISHED, _REFUSED, _LOCKS = (
    f"tests/unit/test_{name}.py" for name in ("shelf", "merge", "publish", "publish_refused", "machine_lock")
)

ARCHIVE = (
    Mutation(
        "columns-from-folders",
        "harness/results/row_union.py",
        ", hive_partitioning = false)",
        ")",
        (f"{_SHELF}::test_no_name_of_a_folder_sets_a_column_or_leads_to_other_files",),
    ),
    Mutation(
        "packed-without-comparing",
        _COMPACT,
        "if not rows.same(file.read_row_group(group), rows.read_each(batch, schema, named=True)):",
        "if not file.num_row_groups:",
        (f"{_SHELF}::test_nothing_is_removed_where_the_packed_rows_differ_from_the_originals",),
    ),
    Mutation(
        "merged-without-comparing",
        _MERGE,
        "if not rows.same(rows.read_each([partial], _ANY), table):",
        "if not partial.exists():",
        (f"{_MERGED}::test_rows_that_are_not_written_as_they_were_replace_nothing",),
    ),
    Mutation(
        "older-rows-keep-the-name",
        _MERGE,
        "_started(heads[pair[0]]), reverse=True)",
        "_started(heads[pair[0]]), reverse=False)",
        (f"{_MERGED}::test_a_run_that_was_done_twice_keeps_both_rows_and_the_newer_its_name",),
    ),
    Mutation(
        "published-from-anywhere",
        _PUBLISH,
        "if not place.is_relative_to(folder.resolve()):",
        "if not place.is_absolute():",
        (_REFUSED,),
    ),
    Mutation(
        "positions-alone-are-verified",
        _VERIFY,
        "wrong = _differing([(row, of_place[_place(row)]) for row in old.rows], names)",
        "wrong = _differing([], names)",
        (f"{_PUBLISHED}::test_a_forged_column_does_not_hold",),
    ),
    Mutation(
        "any-times-are-verified",
        _VERIFY,
        "RATIO, ELSEWHERE, SECONDS = 1.25, 2.0, 3.0",
        "RATIO, ELSEWHERE, SECONDS = 1.25, 2.0, 3e6",
        (f"{_PUBLISHED}::test_a_forged_column_does_not_hold",),
    ),
    Mutation(
        "names-are-not-verified",
        _VERIFY,
        "wrong = _differing([(row, asked_for) for row in one.rows], asked_for)",
        "wrong = _differing([(row, row) for row in one.rows], asked_for)",
        (f"{_PUBLISHED}::test_a_forged_column_does_not_hold",),
    ),
    Mutation(
        "locks-that-are-links",
        "harness/atomic_files.py",
        "access | os.O_NOFOLLOW | os.O_NONBLOCK",
        "access | os.O_NONBLOCK",
        (f"{_LOCKS}::test_what_is_in_the_way_of_a_lock_is_named_at_once",),
    ),
)

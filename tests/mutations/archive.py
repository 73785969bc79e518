"""Planted errors in how results are read together, packed, merged, published and verified, and in locks."""

from __future__ import annotations

from tests.mutations.base import Mutation

_ROW_STORE, _RESULT_MERGE, _PUBLISH, _PUBLISH_REFUSED, _LOCKS = (
    f"tests/unit/test_{name}.py" for name in ("row_store", "result_merge", "publish", "publish_refused", "machine_lock")
)

ARCHIVE = (
    Mutation(
        "columns-from-folders",
        "harness/results/row_union.py",
        ", hive_partitioning = false)",
        ")",
        (f"{_ROW_STORE}::test_no_name_of_a_folder_sets_a_column_or_leads_to_other_files",),
    ),
    Mutation(
        "packed-without-comparing",
        "harness/experiments/archive/compaction.py",
        "if not parquet_rows.is_bitwise_equal(file.read_row_group(group), _read_by_file(batch, schema)):",
        "if not file.num_row_groups:",
        (f"{_ROW_STORE}::test_nothing_is_removed_where_the_packed_rows_differ_from_the_originals",),
    ),
    Mutation(
        "merged-without-comparing",
        "harness/experiments/archive/result_merge.py",
        "if not parquet_rows.is_bitwise_equal(parquet_rows.read_rows_by_file([partial], _EMPTY_SCHEMA), table):",
        "if not partial.exists():",
        (f"{_RESULT_MERGE}::test_rows_that_are_not_written_as_they_were_replace_nothing",),
    ),
    Mutation(
        "older-rows-keep-the-name",
        "harness/experiments/archive/result_merge.py",
        "_read_start_time(heads[pair[0]]), reverse=True\n        )",
        "_read_start_time(heads[pair[0]]), reverse=False)",
        (f"{_RESULT_MERGE}::test_a_run_that_was_done_twice_has_both_rows_and_the_newer_has_its_name",),
    ),
    Mutation(
        "published-from-anywhere",
        "harness/experiments/archive/publication.py",
        "if not place.is_relative_to(folder.resolve()):",
        "if not place.is_absolute():",
        (_PUBLISH_REFUSED,),
    ),
    Mutation(
        "positions-alone-are-verified",
        "harness/experiments/archive/archive_verification.py",
        "wrong = _find_differences([(row, of_place[_row_key(row)]) for row in original.rows], names)",
        "wrong = _find_differences([], names)",
        (f"{_PUBLISH}::test_a_forged_column_is_refuted",),
    ),
    Mutation(
        "any-times-are-verified",
        "harness/experiments/archive/archive_verification.py",
        "MAX_RATIO_SAME_MACHINE, MAX_SECONDS_RATIO = 1.25, 3.0",
        "MAX_RATIO_SAME_MACHINE, MAX_SECONDS_RATIO = 1.25, 3e6",
        (f"{_PUBLISH}::test_a_forged_column_is_refuted",),
    ),
    Mutation(
        "names-are-not-verified",
        "harness/experiments/archive/archive_verification.py",
        "wrong = _find_differences([(row, requested) for row in published_run.rows], requested)",
        "wrong = _find_differences([(row, row) for row in published_run.rows], requested)",
        (f"{_PUBLISH}::test_a_forged_column_is_refuted",),
    ),
    Mutation(
        "locks-that-are-links",
        "harness/atomic_files.py",
        '("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC")',
        '("O_NONBLOCK", "O_CLOEXEC")',
        (f"{_LOCKS}::test_what_prevents_a_lock_is_named_at_once",),
    ),
)

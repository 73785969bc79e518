"""The rows of accuracy measurements: queries see them."""

from __future__ import annotations

from pathlib import Path

from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_COLUMNS, ACCURACY_SCHEMA
from springbench.harness.report.sql_query import run_query
from springbench.harness.results import parquet_rows


def test_columns_are_named_once() -> None:
    assert len(set(ACCURACY_SCHEMA.names)) == len(ACCURACY_COLUMNS)


def test_a_query_sees_the_accuracy_rows_of_all_configs(tmp_path: Path) -> None:
    for name, error in (("first", 0.5), ("second", 0.25)):
        (tmp_path / name / "accuracy").mkdir(parents=True)
        row = {"kind": "work", "sweep": name, "error": error, "seconds": [0.1, 0.2]}
        parquet_rows.write_rows(tmp_path / name / "accuracy" / "a.parquet", [row], ACCURACY_SCHEMA)
    found = run_query("SELECT sweep, list_min(seconds) FROM accuracy ORDER BY error", tmp_path)
    assert found.values == [("second", 0.1), ("first", 0.1)]
    assert run_query("SELECT count(*) FROM rows", tmp_path).values == [(0,)]

"""Rows: files are whole or absent, and reading joins them."""

from pathlib import Path

import pyarrow as pa
import pytest
from springbench.harness.results import parquet_rows, run_schema


def test_rows_come_back_in_the_order_of_the_files(tmp_path: Path):
    for k in (1, 0):
        parquet_rows.write_rows(
            tmp_path / f"{k}.parquet", [{"run_id": f"run {k}", "frame": f, "seconds": 0.5} for f in (1, 2)]
        )
    table = parquet_rows.read_rows([tmp_path / "0.parquet", tmp_path / "1.parquet"])
    assert table.schema.equals(run_schema.RUN_SCHEMA)
    assert table["run_id"].to_pylist() == ["run 0", "run 0", "run 1", "run 1"]
    assert table["size"].null_count == 4


def test_no_files_give_an_empty_table_with_all_columns():
    assert parquet_rows.read_rows([]).num_rows == 0
    assert parquet_rows.read_rows([]).schema.names == run_schema.RUN_SCHEMA.names


def test_a_column_that_the_schema_does_not_have_is_refused_and_nothing_is_left(tmp_path: Path):
    with pytest.raises(ValueError, match="colour"):
        parquet_rows.write_rows(tmp_path / "x.parquet", [{"colour": "red"}])
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_file_that_was_there(tmp_path: Path):
    path = tmp_path / "x.parquet"
    parquet_rows.write_rows(path, [{"run_id": "first"}])
    with pytest.raises(pa.ArrowInvalid):
        parquet_rows.write_rows(path, [{"size": "not a number"}])
    assert parquet_rows.read_rows([path])["run_id"].to_pylist() == ["first"]

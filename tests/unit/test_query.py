"""Queries: SQL over the rows of all sweeps, and over nothing else."""

from pathlib import Path

import pytest
from springbench.harness.errors import InputError
from springbench.harness.experiments.ablation.ablation_schema import ABLATION_SCHEMA
from springbench.harness.report.sql_query import run_query
from springbench.harness.results import parquet_rows


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two sweeps of one row each."""
    for sweep, seconds in (("first", 0.5), ("second", 0.25)):
        (tmp_path / sweep / "rows").mkdir(parents=True)
        parquet_rows.write_rows(tmp_path / sweep / "rows" / "a.parquet", [{"sweep": sweep, "seconds": seconds}])
    return tmp_path


def test_a_query_sees_the_rows_of_all_sweeps(results: Path):
    found = run_query("SELECT sweep, seconds FROM rows ORDER BY seconds", results)
    assert found.columns == ["sweep", "seconds"]
    assert found.values == [("second", 0.25), ("first", 0.5)]
    assert found.build_table().row_count == 2


def test_a_query_sees_the_rows_of_all_ablations(results: Path):
    for scene, cost in (("cloth", 0.5), ("chain", 0.25)):
        (results / scene / "ablation").mkdir(parents=True)
        row = {"kind": "ablated", "name": "bending", "scene": scene, "added_seconds": cost}
        parquet_rows.write_rows(results / scene / "ablation" / "a.parquet", [row], ABLATION_SCHEMA)
    found = run_query("SELECT scene, added_seconds FROM ablation ORDER BY added_seconds", results)
    assert found.values == [("chain", 0.25), ("cloth", 0.5)]


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT nothing FROM rows",
        "SELEKT 1",
        "SELECT * FROM read_text('/etc/hostname')",
        "COPY rows TO 'stolen.csv'",
        "SET enable_external_access = true",
        "",
    ],
)
def test_what_is_wrong_or_leaves_the_rows_is_the_users_mistake(results: Path, sql: str, monkeypatch):
    monkeypatch.chdir(results)
    before = sorted(results.rglob("*"))
    with pytest.raises(InputError, match="query"):
        run_query(sql, results)
    assert sorted(results.rglob("*")) == before


def test_without_rows_the_message_states_what_to_do(tmp_path: Path):
    with pytest.raises(InputError, match="run a sweep first"):
        run_query("SELECT 1", tmp_path)

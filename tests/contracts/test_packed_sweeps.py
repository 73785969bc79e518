"""A sweep of many runs packs their rows when it ends: no run is lost, doubled or done again."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.execution.folder_locks import lock_folder_shared
from springbench.harness.experiments import sweep_runner
from springbench.harness.experiments.archive import compaction
from springbench.harness.experiments.sweep_runner import ExecutionOptions
from springbench.harness.report.sql_query import run_query
from springbench.harness.results import parquet_rows, row_store

from tests.plugin_solvers import SCENE_SOURCE
from tests.progress_displays import SilentDisplay

QUERY = "SELECT run_id, count(*), sum(seconds) FROM rows GROUP BY run_id ORDER BY run_id"


@pytest.fixture(autouse=True)
def few_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_store, "MANY_FILES", 3)


def run_sizes(folder: Path, sizes: list[int], *, rerun: bool = False) -> list[str]:
    """Run a sweep in this process, and return what it printed."""
    (folder / "scene.yaml").write_text(SCENE_SOURCE)
    options = "{frames: 2, rounds: 1, max_iterations: 2, record: false, pictures: false}"
    (folder / "s.yaml").write_text(f"scenes: [scene.yaml]\nsizes: {sizes}\nsolvers: [sparse]\noptions: {options}\n")
    (folder / "r" / "s").mkdir(parents=True, exist_ok=True)
    said: list[str] = []
    execution = ExecutionOptions(isolated=False, rerun=rerun)
    swept = sweep_runner.run_sweep(
        "s", load_config(folder / "s.yaml").list_runs(), folder / "r" / "s", SilentDisplay(), said.append, execution
    )
    assert sorted(set(swept.table["size"].to_pylist())) == sizes
    return said


def count_files(folder: Path) -> tuple[int, int]:
    """Number of runs with a file of their own, and of packed ones."""
    rows = folder / "r" / "s" / "rows"
    return len(row_store.list_unit_files(rows)), len(row_store.list_packed_units(rows))


def test_a_sweep_packs_many_runs_and_repeats_none_of_them(tmp_path: Path):
    run_sizes(tmp_path, [3, 4])
    assert count_files(tmp_path) == (2, 0)
    said = run_sizes(tmp_path, [3, 4, 5])
    assert count_files(tmp_path) == (0, 3)
    assert any("3 units packed" in line for line in said)
    packed = run_query(QUERY, tmp_path / "r").values
    assert len(packed) == 3
    assert any("3 of 3 runs are there already" in line for line in run_sizes(tmp_path, [3, 4, 5]))
    assert run_query(QUERY, tmp_path / "r").values == packed
    run_sizes(tmp_path, [3, 4, 5, 6])
    assert count_files(tmp_path) == (1, 3)
    assert [row for row in run_query(QUERY, tmp_path / "r").values if row in packed] == packed


def test_repeated_runs_replace_their_packed_rows(tmp_path: Path):
    run_sizes(tmp_path, [3, 4, 5])
    packed = run_query(QUERY, tmp_path / "r").values
    run_sizes(tmp_path, [3], rerun=True)
    assert count_files(tmp_path) == (1, 3)
    found = run_query(QUERY, tmp_path / "r").values
    assert [(run, count) for run, count, _ in found] == [(run, count) for run, count, _ in packed]
    assert sum(row not in packed for row in found) == 1
    run_sizes(tmp_path, [3, 4, 5], rerun=True)
    assert count_files(tmp_path) == (0, 3)
    assert not set(run_query(QUERY, tmp_path / "r").values) & set(packed)


def test_rows_stay_in_files_while_another_process_uses_the_folder(tmp_path: Path):
    (tmp_path / "r" / "s").mkdir(parents=True)
    with lock_folder_shared(tmp_path / "r" / "s"):
        said = run_sizes(tmp_path, [3, 4, 5])
    assert count_files(tmp_path) == (3, 0)
    assert any("rows stay in one file per run" in line for line in said)
    run_sizes(tmp_path, [3, 4, 5])
    assert count_files(tmp_path) == (0, 3)


def test_a_sweep_succeeds_where_its_rows_cannot_be_packed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compaction, "unify_schemas", fail)
    said = run_sizes(tmp_path, [3, 4, 5])
    assert count_files(tmp_path) == (3, 0)
    assert any("No space left" in line for line in said)


def test_a_query_reads_files_that_are_added_replaced_removed_or_packed(tmp_path: Path):
    run_sizes(tmp_path, [3, 4])
    rows = tmp_path / "r" / "s" / "rows"
    steps = [len(run_query(QUERY, tmp_path / "r").values)]
    run_sizes(tmp_path, [3, 4, 5])
    steps.append(len(run_query(QUERY, tmp_path / "r").values))
    unit = row_store.list_units(rows)[0]
    table = parquet_rows.read_rows([unit])
    parquet_rows.write_rows(unit, table.slice(0, 1).to_pylist())
    assert (unit.stem[-12:], 1) in [row[:2] for row in run_query(QUERY, tmp_path / "r").values]
    unit.unlink()
    assert (unit.stem[-12:], len(table)) in [row[:2] for row in run_query(QUERY, tmp_path / "r").values]
    assert steps == [2, 3]

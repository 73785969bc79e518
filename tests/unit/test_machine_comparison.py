"""Every table says which numbers may be compared across machines, and no time stands for one of another machine."""

import csv
import re
from io import StringIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from rich.console import Console
from springbench.harness.atomic_files import get_user_cache_dir
from springbench.harness.cli.main import app
from springbench.harness.execution.machine_info import compute_node_id, describe_machine
from springbench.harness.experiments import machine_calibration
from springbench.harness.report.machine_footer import COMPARISON_NOTE
from springbench.harness.report.median_times import write_medians
from springbench.harness.report.robustness import build_score_table
from springbench.harness.report.sweep_summary import summarise_sweep
from springbench.harness.report.timing_table import build_summary_table, label_runs, read_run_times
from springbench.harness.results import parquet_rows
from springbench.harness.results.run_schema import RUN_SCHEMA
from typer.testing import CliRunner

from tests.contracts.hostile import scene
from tests.synthetic_run_rows import build_dummy_rows

ABLE = {"machine_bandwidth": 12.0e9, "machine_flops_per_second": 40.0e9, "machine_step_seconds": 3.1e-3}


def two_machines(solvers: tuple[str, ...] = ("sparse", "dense")) -> list[dict[str, Any]]:
    """Each solver on a machine of its own, one twice as fast."""
    messages = list[dict[str, Any]]()
    for number, solver in enumerate(solvers):
        own = {"run_id": f"{number:012x}", "solver": solver, "scene": "cloth", "size": 8, "residual": 1e-3}
        own |= {"machine_id": f"{number}" * 12, "node_id": "e" * 12, "seconds": 1e-3 * (1 + number), **ABLE}
        messages += [row | own for row in build_dummy_rows(number)]
    return messages


def table_of(rows: list[dict[str, Any]]) -> pa.Table:
    return pa.Table.from_pylist(rows, schema=RUN_SCHEMA)


def print_table(table: Any) -> str:
    console = Console(width=300, record=True, file=StringIO())
    console.print(table)
    return " ".join(console.export_text().split())


def test_a_sweeps_table_names_the_machine_of_each_run_and_what_it_can_do():
    table = table_of(two_machines())
    assert list(label_runs(read_run_times(table)).values()) == ["sparse, machine 000000", "dense, machine 111111"]
    text = print_table(build_summary_table(read_run_times(table), table))
    assert "8 sparse, machine – – 1 1 – – 50 ok 1.0e-03 – – 000000" in text
    assert "machine 111111: a processor, 2 cores, by one thread 12 GB/s, 40 GFLOP/s, a fixed step 3.1 ms" in text
    assert COMPARISON_NOTE in text


def test_two_computers_of_one_kind_are_distinguished():
    given_rows = [row | {"machine_id": "a" * 12, "node_id": str(row["seconds"] > 1e-3) * 3} for row in two_machines()]
    assert sorted(label_runs(read_run_times(table_of(given_rows))).values()) == [
        "dense, machine aaaaaa-True",
        "sparse, machine aaaaaa-Fals",
    ]


def test_a_table_of_one_machine_names_it_once_and_in_no_row():
    one = [row | {"machine_id": "a" * 12} for row in two_machines()]
    table = table_of(one)
    text = print_table(build_summary_table(read_run_times(table), table))
    assert len(re.findall("machine aaaaaa", text)) == 1
    assert COMPARISON_NOTE in text


def test_no_solver_is_called_faster_than_one_on_another_machine():
    assert not [line for line in summarise_sweep(read_run_times(table_of(two_machines()))) if "fastest" in line]
    one = [row | {"machine_id": "a" * 12} for row in two_machines()]
    assert [line for line in summarise_sweep(read_run_times(table_of(one))) if "fastest" in line]


def test_medians_are_those_of_one_machine(tmp_path: Path):
    (path,) = write_medians(table_of(two_machines(("sparse", "sparse"))), tmp_path)
    with path.open() as file:
        found = [(row["machine_id"], float(row["median_seconds"])) for row in csv.DictReader(file)]
    assert found == [("0" * 12, 1e-3), ("1" * 12, 2e-3)]


def command(*arguments: object) -> str:
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


def test_list_query_and_merge_report_other_machines(tmp_path: Path):
    (tmp_path / "cloth.yaml").write_text(scene())
    assert f"states are those on this machine, {describe_machine().machine_id:.6}" in command(
        "list", tmp_path / "cloth.yaml", "--results", tmp_path / "none"
    )
    for name, rows in zip("ab", (two_machines()[:2], two_machines()[2:]), strict=True):
        (tmp_path / name / "sweep" / "rows").mkdir(parents=True)
        parquet_rows.write_rows(tmp_path / name / "sweep" / "rows" / f"{name}.parquet", rows)
    question = "SELECT machine_id, median(seconds) FROM rows GROUP BY ALL"
    assert COMPARISON_NOTE in command("query", question, "--results", tmp_path / "a")
    assert COMPARISON_NOTE not in command("query", question, "--results", tmp_path / "a", "--csv"), (
        "it is read by programs"
    )
    said = command("merge", tmp_path / "a", tmp_path / "b", "-o", tmp_path / "all")
    assert "machine 000000: " in said
    assert "machine 111111: " in said
    assert COMPARISON_NOTE in said


def test_a_report_states_that_its_counts_may_be_compared():
    assert "may be compared across machines" in print_table(build_score_table([]))


def test_the_limits_of_a_machine_are_measured_once_and_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(machine_calibration, "_CALIBRATION_CACHE", {})
    monkeypatch.setattr(machine_calibration, "_MIN_CPU_SHARE", 0.0)  # whatever else runs here
    found = machine_calibration.calibrate_machine(lambda said: None)
    assert set(found) == set(machine_calibration.CALIBRATION_COLUMNS)
    assert 1e7 < found["machine_bandwidth"] < 1e13
    assert 1e7 < found["machine_flops_per_second"] < 1e13
    assert 1e-6 < found["machine_step_seconds"] < 10.0
    (saved,) = get_user_cache_dir("machine").iterdir()
    assert saved.stem == compute_node_id()
    for name in ("measure_copy_bandwidth", "measure_flops", "measure_step_seconds"):
        monkeypatch.delattr(machine_calibration, name)  # what is cached is not computed again
    monkeypatch.setattr(machine_calibration, "_CALIBRATION_CACHE", {})
    assert machine_calibration.calibrate_machine(lambda said: None) == found


def test_the_limits_of_a_busy_machine_are_reported_and_not_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(machine_calibration, "_CALIBRATION_CACHE", {})
    monkeypatch.setattr(machine_calibration, "_MIN_CPU_SHARE", 2.0)  # more than any thread can have
    assert set(machine_calibration.calibrate_machine(lambda said: None)) == set(machine_calibration.CALIBRATION_COLUMNS)
    assert not get_user_cache_dir("machine").exists()


def test_a_run_without_the_memory_for_it_is_done_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full() -> float:
        raise MemoryError

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(machine_calibration, "_CALIBRATION_CACHE", {})
    monkeypatch.setattr(machine_calibration, "measure_copy_bandwidth", full)
    assert machine_calibration.calibrate_machine(lambda said: None) == {}

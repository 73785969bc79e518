"""`springbench regress NEW --baseline OLD` for results of sweeps: folders and archives, paired by run."""

import shutil
import tarfile
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.cli.main import app
from springbench.harness.results import parquet_rows
from typer.testing import CliRunner

FRAMES, ROUNDS = 12, 3


def results(folder: Path, *runs: dict[str, Any]) -> Path:
    """A folder of results: steps of `factor` times 1, 2, 3, 1, ... ms, and whatever else a run's columns say."""
    (folder / "rows").mkdir(parents=True)
    for number, given in enumerate(runs):
        factor = given.pop("factor", 1.0)
        shared = {
            "scene": "cloth",
            "size": 16,
            "solver": "numba",
            "parameters": "{}",
            "threads": 1,
            "machine_id": "here",
        }
        shared |= {
            "cpu": "Fast 9000",
            "cores": 2,
            "status": "ok",
            "phase": "step",
            "positions_digest": "abc",
            "num_iterations": 50,
        }
        steps = [
            {"frame": frame, "round": round, "seconds": factor * (1 + frame % 3) * 1e-3 * (1 + round)}
            for frame in range(1, FRAMES + 1)
            for round in range(ROUNDS)
        ]
        if given.get("status", "ok") != "ok":
            steps = [{"phase": "run"}]
        parquet_rows.write_rows(folder / "rows" / f"{number}.parquet", [shared | given | step for step in steps])
    return folder


def regress(old: str | Path, new: str | Path, *options: str) -> tuple[int, str]:
    command = ["regress", str(new), "--baseline", str(old), *options]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    return done.exit_code, " ".join(done.output.split())


@pytest.mark.parametrize(
    ("old", "new", "code", "message"),
    [
        ({}, {}, 0, "+0.0 % [+0.0, +0.0] pass 50 equal"),
        ({}, {"factor": 1.05}, 0, "+5.0 % [+5.0, +5.0] pass"),
        ({}, {"factor": 1.2}, 1, "+20.0 % [+20.0, +20.0] fail: slower"),
        ({}, {"factor": 0.8}, 0, "-20.0 % [-20.0, -20.0] pass: faster"),
        ({}, {"positions_digest": "def", "num_iterations": 55}, 0, "pass 600 -> 660 different"),
        ({"residual": 1e-3}, {"residual": 2e-3, "stationarity": 1e-6}, 0, "0.001 -> 0.002; 1e-06 equal"),
        ({}, {"status": "failed", "reason": "no"}, 1, "fail: run failed"),
    ],
)
def test_runs_are_paired_and_compared(
    old: dict[str, Any], new: dict[str, Any], code: int, message: str, tmp_path: Path
):
    found, output = regress(results(tmp_path / "old", dict(old)), results(tmp_path / "new", dict(new)))
    assert found == code, output
    assert all(words in output for words in message.replace(" 50 ", " 600 ").split("; "))


def test_runs_of_one_side_are_listed_without_a_verdict(tmp_path: Path):
    old = results(tmp_path / "old", {}, {"solver": "sparse"})
    code, output = regress(old, results(tmp_path / "new", {}, {"size": 32}))
    assert code == 0
    assert "cloth 16 sparse missing" in output
    assert "cloth 32 numba new" in output
    assert "pass: 1 pass" in output


def test_an_archive_is_as_good_as_its_folder_wherever_its_names_lead(tmp_path: Path):
    old, new = results(tmp_path / "old", {}), results(tmp_path / "new", {"factor": 1.2})
    packed = shutil.make_archive(str(tmp_path / "packed"), "zip", old)
    with tarfile.open(tmp_path / "new.tar.gz", "w:gz") as archive:
        archive.add(new, "../../results/cloth")
    code, output = regress(packed, tmp_path / "new.tar.gz")
    assert code == 1
    assert "+20.0 % [+20.0, +20.0] fail: slower" in output


def test_times_of_other_machines_are_inconclusive_and_ratios_to_a_solver_are_not(tmp_path: Path):
    there = {"machine_id": "there", "cpu": "Slow 100"}
    old = results(tmp_path / "old", {}, {"solver": "sparse"})
    new = results(tmp_path / "new", {**there, "factor": 5.0}, {**there, "solver": "sparse", "factor": 4.0})
    code, output = regress(old, new)
    assert code == 3
    assert "cloth 16 numba: other machines (Fast 9000, 2 cores; Slow 100, 2 cores); --relative-to SOLVER" in output
    assert "inconclusive: 2 inconclusive" in output
    code, output = regress(old, new, "--relative-to", "sparse")
    assert code == 1
    assert "cloth 16 numba 1 1.25 +25.0 % [+25.0, +25.0] fail: slower" in output
    assert "cloth 16 sparse 1 1 +0.0 % [+0.0, +0.0] pass" in output
    code, output = regress(old, new, "--relative-to", "dense")
    assert code == 2
    assert "has no runs of dense; expected a solver of both results" in output


def test_one_run_that_cannot_be_compared_makes_the_verdict_inconclusive(tmp_path: Path):
    old = results(tmp_path / "old", {}, {"solver": "sparse", "status": "failed", "reason": "no"})
    code, output = regress(old, results(tmp_path / "new", {}, {"solver": "sparse"}))
    assert code == 3
    assert "not compared: cloth 16 sparse: the baseline has no time: failed" in output
    assert "inconclusive: 1 pass, 1 inconclusive" in output


def test_other_threads_are_another_run(tmp_path: Path):
    code, output = regress(results(tmp_path / "old", {}), results(tmp_path / "new", {"threads": 2}))
    assert code == 3
    assert "inconclusive: " in output
    assert "have no run in common" in output


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "does not exist; expected a folder of results"),
        (lambda path: path.write_text("nothing"), "expected a folder of results, an archive of one"),
        (lambda path: path.mkdir(), "has no rows (rows/*.parquet)"),
        (lambda path: path.write_bytes(b"PK\x05\x06" + 18 * b"\0"), "has no rows (rows/*.parquet)"),
    ],
    ids=["missing", "text", "empty", "empty archive"],
)
def test_a_folder_without_results_is_the_users_mistake(make: Any, message: str, tmp_path: Path):
    good, bad = results(tmp_path / "good", {}), tmp_path / "bad"
    make(bad)
    for pair in ((good, bad), (bad, good)):
        code, output = regress(*pair)
        assert code == 2
        assert message in output


def test_results_and_benchmarks_do_not_mix(tmp_path: Path):
    code, output = regress(results(tmp_path / "old", {}), tmp_path / "new.json")
    assert code == 2
    assert "one is a file of pytest-benchmark, one is not" in output

"""`springbench regress OLD NEW` for results of sweeps: folders and archives, paired by run."""

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


def gate(*arguments: str | Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["regress", *map(str, arguments)], catch_exceptions=False)
    return done.exit_code, " ".join(done.output.split())


@pytest.mark.parametrize(
    ("old", "new", "code", "said"),
    [
        ({}, {}, 0, "+0.0 % [+0.0, +0.0] unchanged 50 the same"),
        ({}, {"factor": 1.05}, 0, "+5.0 % [+5.0, +5.0] unchanged"),
        ({}, {"factor": 1.2}, 1, "+20.0 % [+20.0, +20.0] slower"),
        ({}, {"factor": 0.8}, 0, "-20.0 % [-20.0, -20.0] faster"),
        ({}, {"positions_digest": "def", "num_iterations": 55}, 0, "unchanged 600 -> 660 others"),
        ({"residual": 1e-3}, {"residual": 2e-3, "stationarity": 1e-6}, 0, "0.001 -> 0.002; 1e-06 the same"),
        ({}, {"status": "failed", "reason": "no"}, 1, "fails now"),
    ],
)
def test_runs_are_paired_and_judged(old: dict[str, Any], new: dict[str, Any], code: int, said: str, tmp_path: Path):
    found, told = gate(results(tmp_path / "old", dict(old)), results(tmp_path / "new", dict(new)))
    assert found == code, told
    assert all(words in told for words in said.replace(" 50 ", " 600 ").split("; "))


def test_runs_that_only_one_has_are_told_and_not_judged(tmp_path: Path):
    old = results(tmp_path / "old", {}, {"solver": "sparse"})
    code, told = gate(old, results(tmp_path / "new", {}, {"size": 32}))
    assert code == 0
    assert "cloth 16 sparse vanished" in told
    assert "cloth 32 numba new" in told
    assert "nothing of 1 became slower" in told


def test_an_archive_is_as_good_as_its_folder_wherever_its_names_lead(tmp_path: Path):
    old, new = results(tmp_path / "old", {}), results(tmp_path / "new", {"factor": 1.2})
    packed = shutil.make_archive(str(tmp_path / "packed"), "zip", old)
    with tarfile.open(tmp_path / "new.tar.gz", "w:gz") as archive:
        archive.add(new, "../../results/cloth")
    code, told = gate(packed, tmp_path / "new.tar.gz")
    assert code == 1
    assert "+20.0 % [+20.0, +20.0] slower" in told


def test_times_of_other_machines_are_refused_and_ratios_to_a_yardstick_are_not(tmp_path: Path):
    there = {"machine_id": "there", "cpu": "Slow 100"}
    old = results(tmp_path / "old", {}, {"solver": "sparse"})
    new = results(tmp_path / "new", {**there, "factor": 5.0}, {**there, "solver": "sparse", "factor": 4.0})
    code, told = gate(old, new)
    assert code == 3
    assert "cannot be compared: other machines (Fast 9000, 2 cores; Slow 100, 2 cores); --yardstick SOLVER" in told
    code, told = gate(old, new, "--yardstick", "sparse")
    assert code == 1
    assert "cloth 16 numba 1 1.25 +25.0 % [+25.0, +25.0] slower" in told
    assert "cloth 16 sparse 1 1 +0.0 % [+0.0, +0.0] unchanged" in told
    code, told = gate(old, new, "--yardstick", "dense")
    assert code == 2
    assert "--yardstick: dense was not run in" in told


def test_other_threads_are_another_run(tmp_path: Path):
    code, told = gate(results(tmp_path / "old", {}), results(tmp_path / "new", {"threads": 2}))
    assert code == 3
    assert "cannot tell: " in told
    assert "cannot be compared: they have no run in common" in told


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: None, "is not there; wanted a folder of results"),
        (lambda path: path.write_text("nothing"), "wanted a folder of results, an archive of one"),
        (lambda path: path.mkdir(), "holds no rows (rows/*.parquet)"),
        (lambda path: path.write_bytes(b"PK\x05\x06" + 18 * b"\0"), "holds no rows (rows/*.parquet)"),
    ],
    ids=["missing", "text", "empty", "empty archive"],
)
def test_what_holds_no_results_is_the_users_mistake(make: Any, said: str, tmp_path: Path):
    good, bad = results(tmp_path / "good", {}), tmp_path / "bad"
    make(bad)
    for pair in ((good, bad), (bad, good)):
        code, told = gate(*pair)
        assert code == 2
        assert said in told


def test_results_and_benchmarks_do_not_mix(tmp_path: Path):
    code, told = gate(results(tmp_path / "old", {}), tmp_path / "new.json")
    assert code == 2
    assert "one is of pytest-benchmark, the other is not" in told

"""A disk that is full ends a sweep at once, by its name; completed results remain, and the next start does the rest."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from springbench.harness.results import parquet_rows

ROOT = Path(__file__).resolve().parents[2]
CLOTH = """
mesh: {kind: grid}
mass: 1.0
time_step: 1/30
frames: 30
effects:
  - {kind: springs, stretch: 100}
  - {kind: gravity}
  - {kind: pins, parts: [top_corners]}
"""
SWEEP = "{scenes: [cloth.yaml], sizes: [16], solvers: [sparse, dense], options: {max_iterations: 4, rounds: 1, %s}}"
WALL = 200.0
"""Seconds after which a start counts as one that lingers: it takes a few, and used to wait for two threads of 30 s each
and longer on a machine that is idle."""
PATIENCE = 15.0
"""Seconds of processor time that a start takes at most, with its imports."""


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """A file system of so many bytes in memory."""
    folder.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", folder], capture_output=True, text=True
    )
    if made.returncode:
        pytest.skip(f"a small disk takes the right to mount one: {made.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def start(config: Path, results: Path, limit: str = "") -> subprocess.CompletedProcess[str]:
    """Run a sweep; limit: Python code that goes first."""
    code = f"{limit}\nimport sys\nfrom springbench.harness.cli.main import main\nsys.argv[0] = 'springbench'\nmain()"
    command = [sys.executable, "-c", code, "run", str(config), "--results", str(results)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=WALL)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A sweep of two runs that are recorded and not drawn."""
    (tmp_path / "cloth.yaml").write_text(CLOTH)
    (tmp_path / "sweep.yaml").write_text(SWEEP % "pictures: false")
    return tmp_path / "sweep.yaml"


# Full before the lock is there, in the first recording, in its rows or in the second one: which of them is the
# libraries' own affair, and so is the page that a file system reserves.
SIZES = ["200k", *(pytest.param(size, marks=pytest.mark.long) for size in ("8k", "100k", "300k"))]


@pytest.mark.parametrize("size", SIZES)
def test_a_full_disk_is_reported_by_name_and_failed_runs_are_repeated(size: str, config: Path, tmp_path: Path):
    results = tmp_path / "disk"
    with small_disk(results, size):
        result = start(config, results)
        assert result.returncode == 1, result.stderr
        assert "No space left on device" in result.stderr
        assert "Traceback" not in result.stderr
        assert "shut down prematurely" not in result.stderr
        left = [path for path in results.rglob("*") if "partial" in path.name]
        assert left == []
        done = parquet_rows.read_rows(results.glob("sweep/rows/*.parquet"))
        assert set(done["status"].to_pylist()) <= {"ok"}
        subprocess.run(["mount", "-o", "remount,size=64m", results], check=True)
        again = start(config, results)
        assert again.returncode == 0, again.stderr
        assert len(set(parquet_rows.read_rows(results.glob("sweep/rows/*.parquet"))["run_id"].to_pylist())) == 2


LARGEST = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (2**16, resource.RLIM_INFINITY))"


def test_a_limit_to_the_size_of_files_is_no_outcome_of_a_run_either(config: Path, tmp_path: Path):
    result = start(config, tmp_path / "results", LARGEST)
    assert result.returncode == 1, result.stderr
    assert "cannot be written: File too large" in result.stderr
    assert "Traceback" not in result.stderr
    outcomes = parquet_rows.read_rows(tmp_path.rglob("rows/*.parquet")).select(["status", "reason"]).to_pylist()
    assert list(tmp_path.rglob("*.parquet")) == [], outcomes


@pytest.mark.long
def test_a_limit_to_the_size_of_files_ends_the_run_at_once(config: Path, tmp_path: Path):
    before = os.times()
    test_a_limit_to_the_size_of_files_is_no_outcome_of_a_run_either(config, tmp_path)
    after = os.times()
    assert after.children_user - before.children_user < PATIENCE

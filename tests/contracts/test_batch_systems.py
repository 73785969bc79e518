"""A batch system's workers, by dask-jobqueue as it is: its commands are stand-ins, which start a job's script here."""

from __future__ import annotations

import os
import shlex
import signal
import sys
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments.sweep_runner import ExecutionOptions, run_sweep
from springbench.harness.results import parquet_rows

from tests.plugin_solvers import SCENE_SOURCE
from tests.progress_displays import SilentDisplay

pytest.importorskip("dask_jobqueue", reason="pip install 'springbench[cluster]'")

ROOT = Path(__file__).resolve().parents[2]
SWEEP = (
    "scenes: [scene.yaml]\nsolvers: [sparse]\n"
    "options: {frames: 2, rounds: 1, max_iterations: [5, 6, 7], record: false}\n"
)

SUBMIT = """#!/bin/sh
cp "$1" {jobs}/$$.sh
setsid sh "$1" >{jobs}/$$.out 2>&1 &
echo $! >{jobs}/$$.pid
echo "Submitted batch job $!"
"""
CANCEL = """#!/bin/sh
echo "$@" >>{jobs}/cancelled
kill -- "-$1"
"""
"""`sbatch` says the number of a job, by which `scancel` ends it; here both are of a group of processes."""

pytestmark = pytest.mark.long


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[Path]:
    """The folder in which jobs leave their scripts and what they said."""
    folder = tmp_path / "jobs"
    folder.mkdir()
    for name, text in (("sbatch", SUBMIT), ("scancel", CANCEL)):
        (folder / name).write_text(text.format(jobs=shlex.quote(str(folder))))
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *filter(None, sys.path)]))
    yield folder
    for found in folder.glob("*.pid"):
        with suppress(ProcessLookupError):
            os.killpg(int(found.read_text()), signal.SIGKILL)


def test_runs_are_done_by_jobs_that_are_submitted_and_cancelled(tmp_path: Path, jobs: Path):
    (tmp_path / "scene.yaml").write_text(SCENE_SOURCE)
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    options = "cores: 1, processes: 1, memory: 1GiB, walltime: '00:10:00', account: springs"
    (tmp_path / "slurm.yaml").write_text(
        f"{{kind: SLURM, jobs: 2, {options}, interface: lo, local_directory: {tmp_path}}}"
    )
    (tmp_path / "r").mkdir()
    found = load_config(tmp_path / "sweep.yaml")
    messages: list[Any] = []
    table = run_sweep(
        "sweep",
        found.list_runs(),
        tmp_path / "r",
        SilentDisplay(),
        messages.append,
        ExecutionOptions(scheduler_address=str(tmp_path / "slurm.yaml")),
    ).table
    assert set(table["status"].to_pylist()) == {"ok"}
    assert len(set(table["run_id"].to_pylist())) == 3
    assert parquet_rows.read_rows((tmp_path / "r" / "rows").glob("*.parquet")).num_rows == table.num_rows
    scripts = [path.read_text() for path in jobs.glob("*.sh")]
    assert len(scripts) == 2
    assert all("#SBATCH -A springs" in text and "distributed.cli.dask_worker" in text for text in scripts)
    assert len((jobs / "cancelled").read_text().split()) == 2

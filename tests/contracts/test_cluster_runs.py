"""A real scheduler and workers on the loopback: a crash is a row, a worker that is killed costs its run at hand."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from distributed import LocalCluster

from harness.base import rows
from harness.base.machine import node
from harness.config.load import load_any
from harness.experiments.sweep import run_sweep
from tests.displays import Quiet
from tests.own_solvers import own


def done(sweep: Path, results: Path, address: str) -> pa.Table:
    found = load_any(sweep)
    results.mkdir(exist_ok=True)
    return run_sweep(found.name, found.runs(), results, Quiet(), print, on=address)


def test_runs_are_done_by_workers_and_a_crash_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = own(tmp_path, monkeypatch, solving="import os; os._exit(3)")
    quiet: Any = {"dashboard_address": None}
    with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", **quiet) as started:
        found: Any = started
        table = done(made.sweep, tmp_path / "r", found.scheduler_address)
        assert len(found.workers) == 1
    first = {row["solver"]: row for row in table.to_pylist()}
    assert first["sparse"]["status"] == "ok", first["sparse"]["reason"]
    assert first["mine"]["status"] == "failed"
    assert "ended its process with exit code 3" in first["mine"]["reason"]
    assert {row["node"] for row in first.values()} == {node()}
    assert not [*(tmp_path / "r").rglob("*partial*")]


SWEEP = """
scenes: [scene.yaml]
solvers: [sparse]
options: {frames: 4, rounds: 1, iterations: [5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16], record: false}
"""


@pytest.mark.long
def test_workers_that_are_killed_lose_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = own(tmp_path, monkeypatch)
    made.sweep.write_text(SWEEP)
    quiet: Any = {"dashboard_address": None}
    over = threading.Event()
    with LocalCluster(n_workers=3, threads_per_worker=1, **quiet) as started:
        found: Any = started

        def kill() -> None:
            while not over.wait(10.0):
                workers = [nanny.pid for nanny in found.workers.values() if nanny.pid]
                if workers:
                    os.kill(workers[0], signal.SIGKILL)

        killer = threading.Thread(target=kill, daemon=True)
        killer.start()
        killed = done(made.sweep, tmp_path / "r", found.scheduler_address)
        over.set()
        killer.join()
        whole = done(made.sweep, tmp_path / "s", found.scheduler_address)
    assert set(killed["status"].to_pylist()) == {"ok"}
    for column in ("run_id", "phase", "frame", "digest", "iterations"):
        assert sorted(map(str, killed[column].to_pylist())) == sorted(map(str, whole[column].to_pylist()))
    assert len([*(tmp_path / "r" / "rows").glob("*.parquet")]) == 12
    assert rows.read((tmp_path / "r" / "rows").glob("*.parquet")).num_rows == killed.num_rows

"""A real scheduler and workers on the loopback: a crash is a row, a worker that is killed costs its run at hand, and
runs of one machine are timed one at a time."""

from __future__ import annotations

import os
import signal
import socket
import ssl
import threading
from pathlib import Path
from typing import Any

import psutil
import pyarrow as pa
import pytest
from distributed import Client, LocalCluster
from distributed.security import Security
from springbench.harness.config.config_loader import load_config
from springbench.harness.execution.dask_scheduler import open_scheduler
from springbench.harness.execution.machine_info import compute_node_id
from springbench.harness.experiments.machine_calibration import CALIBRATION_COLUMNS as MACHINE
from springbench.harness.experiments.sweep_runner import ExecutionOptions, run_sweep

from tests.plugin_solvers import SCENE_SOURCE, SOLVER_SOURCE, write_plugin_solver
from tests.progress_displays import SilentDisplay


def run_on_cluster(sweep: Path, results: Path, address: str) -> pa.Table:
    found = load_config(sweep)
    results.mkdir(exist_ok=True)
    execution = ExecutionOptions(scheduler_address=address)
    return run_sweep(found.name, found.list_runs(), results, SilentDisplay(), print, execution).table


def test_runs_are_done_by_workers_and_a_crash_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = write_plugin_solver(tmp_path, monkeypatch, solve_code="import os; os._exit(3)")
    quiet: Any = {"dashboard_address": None}
    with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", **quiet) as started:
        found: Any = started
        table = run_on_cluster(made.sweep_path, tmp_path / "r", found.scheduler_address)
        assert len(found.workers) == 1
    first = {row["solver"]: row for row in table.to_pylist()}
    assert first["sparse"]["status"] == "ok", first["sparse"]["reason"]
    assert first["mine"]["status"] == "failed"
    assert "ended its process with exit code 3" in first["mine"]["reason"]
    assert {row["node_id"] for row in first.values()} == {compute_node_id()}
    assert not [*(tmp_path / "r").rglob("*partial*")]


def is_refused(place: tuple[str, int], security: Security | None) -> bool:
    """Whether a server talks neither Dask's protocol, with this certificate if any, nor HTTP, but of pages it lacks."""
    bare = ssl.create_default_context()
    bare.check_hostname, bare.verify_mode = False, ssl.CERT_NONE
    context = security.get_connection_args("client")["ssl_context"] if security else bare
    with socket.create_connection(place, timeout=60.0) as connection:
        try:
            with context.wrap_socket(connection, server_hostname="dask-internal") as talk:
                talk.sendall(b"\0" * 64)
                return not talk.recv(1)
        except OSError:
            pass
    with socket.create_connection(place, timeout=60.0) as connection:
        connection.sendall(b"GET /health HTTP/1.0\r\n\r\n")
        try:
            return connection.recv(64).startswith((b"HTTP/1.1 404", b"HTTP/1.0 404")) or not connection.recv(1)
        except OSError:
            return True


def test_no_client_without_the_certificate_reaches_a_cluster_of_this_machine():
    with open_scheduler("local:1") as found, Client(found, timeout=300.0) as client:
        assert client.submit(os.getpid).result() != os.getpid()
        me = psutil.Process()
        there = [c for process in (me, *me.children(recursive=True)) for c in process.net_connections()]
        places = {(c.laddr.ip, c.laddr.port) for c in there if c.status == "LISTEN"}
        assert {place for place, _ in places} == {"127.0.0.1"}
        assert int(found.scheduler_address.rpartition(":")[2]) in {port for _, port in places}
        another = Security.temporary()
        assert all(is_refused(place, security) for place in places for security in (None, another))
        mine = found.security.get_connection_args("client")["ssl_context"]
        address = found.scheduler_address.rpartition(":")[2]
        with (
            socket.create_connection(("127.0.0.1", int(address))) as connection,
            mine.wrap_socket(connection, server_hostname="dask-internal") as talk,
        ):
            assert talk.recv(1), "with the certificate the scheduler answers"


RUNS, FRAMES, ROUNDS, SLEEP = 12, 2, 2, 0.02
"""Of a sweep, and seconds that each solve lasts at least; who sleeps leaves its core to the others."""

NOTE = (
    f"import os, time; began = time.monotonic(); time.sleep({SLEEP}); "
    "[open({noted!r}, 'a').write(f'{{stop.iterations}} {{os.getpid()}} {{began}} {{time.monotonic()}}\\n')]"
)
"""A solver that notes of each solve its run, its process, and from when to when it lasted by the machine's clock."""


def lock_by(folder: Path, *, shared: bool) -> None:
    """In a worker: the machine's locks lie in a folder that all share, or in one of this worker's own."""
    os.environ["SPRINGBENCH_LOCKS"] = str(folder / ("shared" if shared else str(os.getpid())))


@pytest.mark.long
@pytest.mark.parametrize("shared", [True, False], ids=["locked", "without-the-lock"])
def test_of_four_workers_of_a_machine_one_is_timed_at_a_time(tmp_path: Path, shared: bool):
    noted = tmp_path / "noted"
    (tmp_path / "noting.py").write_text(SOLVER_SOURCE.replace("pass  # while solving", NOTE.format(noted=str(noted))))
    (tmp_path / "scene.yaml").write_text(SCENE_SOURCE)
    sweep = tmp_path / "sweep.yaml"
    options = f"frames: {FRAMES}, rounds: {ROUNDS}, max_iterations: {list(range(1, RUNS + 1))}, record: false"
    sweep.write_text(f"scenes: [scene.yaml]\nsolvers: ['./noting.py:Mine']\noptions: {{{options}, pictures: false}}\n")
    quiet: Any = {"dashboard_address": None, "silence_logs": 50, "local_directory": tmp_path}
    with LocalCluster(n_workers=4, threads_per_worker=1, **quiet) as started, Client(started) as client:
        client.run(lock_by, tmp_path, shared=shared)
        found: Any = started
        rows = run_on_cluster(sweep, tmp_path / "r", found.scheduler_address).to_pylist()
    assert {row["status"] for row in rows} == {"ok"}
    assert {row["timing"] for row in rows} == {"exclusive"}
    lines = [line.split() for line in noted.read_text().splitlines()]
    assert len({process for _, process, *_ in lines}) == 4
    timed, looked = list[tuple[int, float, float]](), list[tuple[int, float, float]]()
    for run in range(1, RUNS + 1):
        solves = [(float(began), float(ended)) for number, _, began, ended in lines if int(number) == run]
        measured, second = solves[:-FRAMES], solves[-FRAMES:]
        took = [row["seconds"] for row in rows if row["max_iterations"] == run and row["phase"] == "step"]
        own = [ended - began for began, ended in measured[-FRAMES * ROUNDS :]]
        assert all(
            SLEEP <= mine <= reported for mine, reported in zip(own, took, strict=True)
        )  # these are what rows time
        timed.append((run, measured[0][0], measured[-1][1]))
        looked += [(run, *solve) for solve in second]
    at_once = {
        frozenset([a, b])
        for a, began, ended in timed
        for b, *other in timed + looked
        if a != b
        if other[0] < ended and other[1] > began
    }
    print(f"{len(at_once)} pairs of {RUNS} runs overlapped")
    assert not at_once if shared else at_once


MANY, EVERY = 200, 10.0
"""Runs, and seconds between two kills."""

TIMES = {"started_at", "seconds", "wall_seconds_check", "wall_seconds_sum", "cpu_seconds", "preempted", *MACHINE}
"""Columns that differ from run to run."""

SOLVE = 0.03
"""Seconds that a solve takes at least: six of them make a run, so that all last through several kills."""

RECORD_PROCESS = (
    "import os, time; [open({log!r}, 'a').write(f'{{os.getpid()}} {{stop.iterations}}\\n')]; "
    f"until = time.perf_counter() + {SOLVE}; any(time.perf_counter() > until for _ in iter(int, 1))"
)
"""A solver that shows which process does which run: each has its own number of iterations."""


def all_but_times(table: pa.Table) -> list[str]:
    """The rows, in an order of their own."""
    return sorted(map(repr, table.drop_columns(sorted(TIMES)).to_pylist()))


@pytest.mark.long
def test_workers_that_are_killed_lose_nothing_and_repeat_the_runs_at_hand_alone(tmp_path: Path):
    log_path = tmp_path / "told"
    (tmp_path / "counted.py").write_text(
        SOLVER_SOURCE.replace("pass  # while solving", RECORD_PROCESS.format(log=str(log_path)))
    )
    (tmp_path / "scene.yaml").write_text(SCENE_SOURCE)
    sweep = tmp_path / "sweep.yaml"
    options = f"frames: 2, rounds: 1, max_iterations: {list(range(1, MANY + 1))}, record: false, pictures: false"
    sweep.write_text(f"scenes: [scene.yaml]\nsolvers: ['./counted.py:Mine']\noptions: {{{options}}}\n")
    quiet: Any = {"dashboard_address": None, "silence_logs": 50, "local_directory": tmp_path}
    over, killed = threading.Event(), list[int]()
    with LocalCluster(n_workers=4, threads_per_worker=1, **quiet) as started:
        found: Any = started

        def kill() -> None:
            while not over.wait(EVERY):
                workers = [nanny.pid for nanny in found.workers.values() if nanny.pid]
                if len(found.scheduler.workers) == 4 and log_path.exists():  # else a slow machine would do nothing else
                    killed.append(workers[len(killed) % len(workers)])
                    os.kill(killed[-1], signal.SIGKILL)

        killer = threading.Thread(target=kill, daemon=True)
        killer.start()
        disturbed = run_on_cluster(sweep, tmp_path / "r", found.scheduler_address)
        over.set()
        killer.join()
        began = set(log_path.read_text().splitlines())
        whole = run_on_cluster(sweep, tmp_path / "s", found.scheduler_address)
    print(f"{len(killed)} workers were killed, and {len(began) - MANY} of {MANY} runs begun again")
    assert killed
    assert set(disturbed["status"].to_pylist()) == {"ok"}
    assert len([*(tmp_path / "r" / "rows").glob("*.parquet")]) == MANY
    assert all_but_times(disturbed) == all_but_times(whole)
    assert len(began) - MANY <= len(killed)  # each worker has one run at hand

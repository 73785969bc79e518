# pyright: reportUnknownMemberType=false
"""Many workers and many runs, simulated: what a cluster's scheduler and its client bear.

    python -m tests.cluster_load [WORKERS] [RUNS] [FOLDER] [--seconds S]        1,000 and 100,000 if left out

Three processes: the client, which is the command as it is; Dask's scheduler; and all workers, as coroutines. A run's
own process is left out, with what it measures: in its place stands `Dummy`, which writes rows as a run does. All else
is the real code. Workers do not see the client's folder, so rows travel by the scheduler; what each stores on its own
disk is in memory, for a thousand machines have as many disks. After the given seconds it ends where it is, and
goes on from there when it is given the same folder again.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from math import ceil
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, process_time
from typing import Any, NamedTuple

import dask.config
import psutil
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.experiments import dask_cluster
from springbench.harness.experiments.provenance import (
    build_run_columns,
    collect_source_parts,
    compute_source_fingerprint,
)
from springbench.harness.experiments.sweep_runner import ExecutionOptions, run_sweep
from springbench.harness.results import parquet_rows

from tests.plugin_solvers import SCENE_SOURCE
from tests.progress_displays import SilentDisplay

SOLVER_NAMES = ("sparse", "numba", "anderson", "lbfgs", "xpbd")
MESH_SIZES = range(3, 23)
MAX_CONFIG_RUNS = 10_000
"""Runs of a config."""
THREAD_COUNT, FRAME_COUNT = 4, 3
"""Threads that all workers share, and steps that a run reports."""

DASK_CONFIG = {"distributed.worker.profile.enabled": False, "distributed.admin.system-monitor.interval": "1h"}
"""What Dask looks at in each worker by itself; here it would be looked at in one process a thousand times."""


class ProcessUsage(NamedTuple):
    """What a process took: MiB at most, seconds of CPU, and messages received, and bytes received
    and went."""

    peak_mib: float
    cpu_seconds: float
    message_counts: tuple[int, int] = (0, 0)


class DummyWorker:
    """In place of a run's process: writes the rows of a run that was not done."""

    def __init__(self, ready: object, *, fork: bool) -> None: ...

    def run_task(self, function: Any, tick: object, limits: object) -> str:
        unit = function.args[0]
        same = build_run_columns(unit.run) | {
            "source_fingerprint": _cached_fingerprint(collect_source_parts(unit.run)),
            "phase": "step",
            "status": "ok",
            "seconds": 1e-3,
        }
        parquet_rows.write_rows(unit.files.rows, [same | {"frame": frame} for frame in range(1, FRAME_COUNT + 1)])
        return "1 ms a step"


_cached_fingerprint = cache(compute_source_fingerprint)


def run_scheduler(pipe: Connection) -> None:
    """Be the scheduler until the pipe ends, and count the messages that come."""
    from distributed import Scheduler
    from distributed.comm import tcp

    logging.getLogger("distributed").setLevel(logging.CRITICAL)

    messages, moved = 0, 0
    read, write, read_bytes = tcp.TCP.read, tcp.TCP.write, tcp.read_bytes_rw

    async def counting(self: tcp.TCP, deserializers: Any = None) -> Any:
        nonlocal messages
        found = await read(self, deserializers)
        messages += len(found) if isinstance(found, tuple | list) else 1
        return found

    async def sending(self: tcp.TCP, *args: Any, **options: Any) -> int:
        nonlocal moved
        sent = await write(self, *args, **options)
        moved += sent
        return sent

    async def receiving(stream: Any, n: int) -> Any:
        nonlocal moved
        moved += n
        return await read_bytes(stream, n)

    async def serve() -> None:
        async with Scheduler(host="127.0.0.1", port=0, dashboard=False) as served:
            pipe.send(served.address)
            await _ended(pipe)

    tcp.TCP.read, tcp.TCP.write, tcp.read_bytes_rw = counting, sending, receiving  # type: ignore[method-assign]
    with suppress(Exception):  # workers that leave in the same second
        asyncio.run(serve())
    pipe.send(_measure_usage((messages, moved)))


def run_workers(pipe: Connection, address: str, count: int) -> None:
    """Be so many workers until the pipe ends."""
    from distributed import Worker

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    do: Any = dask_cluster._execute_run

    def far(unit: object, folder: Path, *rest: object) -> Any:
        return do(unit, Path("/elsewhere"), *rest)

    dask_cluster._execute_run, dask_cluster.IsolatedWorker = far, DummyWorker  # type: ignore[assignment, misc]

    async def serve(home: str) -> None:
        own: Any = {"nthreads": 1, "dashboard": False, "memory_limit": 0, "executor": ThreadPoolExecutor(THREAD_COUNT)}
        for begun in range(0, count, 50):
            some = range(begun, min(count, begun + 50))
            await asyncio.gather(*(Worker(address, local_directory=f"{home}/{number}", **own) for number in some))
        pipe.send(count)
        await _ended(pipe)

    if Path("/dev/shm").is_dir():
        tempfile.tempdir = "/dev/shm"
    with TemporaryDirectory() as home, suppress(Exception), dask.config.set(DASK_CONFIG):
        asyncio.run(serve(home))
    pipe.send(_measure_usage())


async def _ended(pipe: Connection) -> None:
    while not pipe.poll():
        await asyncio.sleep(0.2)


def _measure_usage(messages: tuple[int, int] = (0, 0)) -> ProcessUsage:
    import resource

    return ProcessUsage(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, process_time(), messages)


class TimeIsUp(Exception):
    """The time is over."""


class ProgressCounter(SilentDisplay):
    """Print the progress at each tenth, and raise Over after the given seconds."""

    def __init__(self, runs: int, seconds: float) -> None:
        super().__init__()
        self._tenth, self._began, self._seconds = max(1, runs // 10), monotonic(), seconds

    def finish_run(self, outcome: str) -> None:
        super().finish_run(outcome)
        took = monotonic() - self._began
        if not self.finished_units % self._tenth:
            here = psutil.Process().memory_info().rss / 2**20
            print(f"{self.finished_units:,} runs after {took:.0f} s; client {here:.0f} MiB", flush=True)
        if took > self._seconds:
            raise TimeIsUp


def _build_runs(folder: Path, part: int) -> list[RunSpec]:
    """The runs of a config, of which several make the sweep: none may request more than `MOST`."""
    each = MAX_CONFIG_RUNS // len(SOLVER_NAMES) // len(MESH_SIZES)
    options = {
        "max_iterations": list(range(1 + each * part, 1 + each * (part + 1))),
        "rounds": 1,
        "frames": FRAME_COUNT,
    }
    options |= {"record": False, "pictures": False}
    settings = {"scenes": ["scene.yaml"], "sizes": list(MESH_SIZES), "solvers": list(SOLVER_NAMES), "options": options}
    (folder / "sweep.yaml").write_text(json.dumps(settings))
    return load_config(folder / "sweep.yaml").list_runs()


def simulate_cluster(count: int, runs: int, folder: Path, seconds: float) -> dict[str, Any]:
    """Do dummy runs by so many workers, those of so many that are missing; what each process bore for how many, and
    how many a second that allows: on this machine's cores, and where each process has a core of its own."""
    (folder / "scene.yaml").write_text(SCENE_SOURCE)
    began, context = monotonic(), get_context("spawn")
    found = [run for part in range(ceil(runs / MAX_CONFIG_RUNS)) for run in _build_runs(folder, part)][:runs]
    values: dict[str, Any] = {"workers": count, "runs": len(found), "expanded_seconds": monotonic() - began}
    (mine, theirs), (ours, others) = context.Pipe(), context.Pipe()
    processes = {"scheduler": context.Process(target=run_scheduler, args=(theirs,))}
    processes["scheduler"].start()
    address = mine.recv()
    processes["workers"] = context.Process(target=run_workers, args=(others, address, count))
    processes["workers"].start()
    ours.recv()
    values["workers_seconds"] = monotonic() - began - values["expanded_seconds"]
    pids = {"client": os.getpid()} | {name: process.pid or 0 for name, process in processes.items()}
    before, done, display = (
        {name: _process_cpu_seconds(pid) for name, pid in pids.items()},
        monotonic(),
        ProgressCounter(runs, seconds),
    )
    values["ended"] = "all runs are done"
    try:
        execution = ExecutionOptions(scheduler_address=address)
        swept = run_sweep("sweep", found, folder / "r", display, print, execution)
        values["rows"] = len(swept.table)
    except TimeIsUp:
        values["ended"] = f"after {seconds:g} s; the same command, with the same folder, does the rest"
    took = {name: _process_cpu_seconds(pid) - before[name] for name, pid in pids.items()}
    values |= {"done": display.finished_units, "seconds": monotonic() - done, "client_bore": _measure_usage()._asdict()}
    for name, pipe in (("workers", ours), ("scheduler", mine)):
        pipe.send(None)
        values[f"{name}_bore"] = pipe.recv()._asdict()
        processes[name].join(60.0)
        processes[name].kill()
    each = {name: 1e3 * cpu / max(1, display.finished_units) for name, cpu in took.items()}
    values |= {"runs_per_second": values["done"] / values["seconds"], "cpu_ms_per_run": each}
    values["binds"] = max(each, key=lambda name: each[name])
    here = max(sum(each.values()) / (os.cpu_count() or 1), max(each.values()))
    return values | {"runs_per_second_idle": 1e3 / here, "runs_per_second_own_cores": 1e3 / max(each.values())}


def _process_cpu_seconds(pid: int) -> float:
    """Seconds of CPU that a process has taken."""
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


if __name__ == "__main__":
    asked = argparse.ArgumentParser()
    asked.add_argument("workers", type=int, nargs="?", default=1000)
    asked.add_argument("runs", type=int, nargs="?", default=100_000)
    asked.add_argument("folder", type=Path, nargs="?")
    asked.add_argument("--seconds", type=float, default=3600.0)
    given = asked.parse_args()
    with TemporaryDirectory() as temporary:
        place = given.folder or Path(temporary)
        (place / "r").mkdir(parents=True, exist_ok=True)
        print(json.dumps(simulate_cluster(given.workers, given.runs, place, given.seconds), indent=1))

"""Overhead of a sweep over its timed passes, and what a second core saves; on an idle machine.

    python -m tests.sweep_overhead short [RUNS]        500 runs of five solvers, sizes 8 to 16, if left out
    python -m tests.sweep_overhead isolation [RUNS]    the same by one worker, and in the calling process
    python -m tests.sweep_overhead cores [CASES]       10 cases of configs/hard.yaml by five solvers, judged and drawn

`short` prints what each run takes over its timed passes, of the wall's time and of all processes' CPU, and the memory
of the calling process, when half of the runs have ended and when all have. `isolation` prints what of it a
worker adds, which is the fixed cost of isolation (process, messages, locks), and its share of the sweep: the rest is
what runs request, a second pass, its judging, and rows. `cores` does a sweep by one worker and by two and prints

    t = timed / wall            of one worker: the share that two may not do side by side
    speed-up / (1 / (t + (1 - t) / 2))          .9 is the target

What is timed is what `springbench.harness.experiments.run_pipeline` does while it has the machine for itself:
preparing, the pass that warms
up, and the timed rounds. Every sweep is done in a process of its own, once before to have its kernels compiled.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from collections.abc import Generator
from contextlib import contextmanager
from math import ceil
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, process_time
from typing import Any, NamedTuple

import psutil
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.sweep_config import RunSpec

from tests.progress_displays import SilentDisplay

CONFIG_FOLDER = Path(__file__).resolve().parents[1] / "configs"
SOLVER_NAMES = ("numba", "sparse", "hybrid", "xpbd", "lbfgs")
MESH_SIZES = (8, 10, 12, 14, 16)
SHORT_OPTIONS = {"frames": 10, "rounds": 2, "record": False, "pictures": False}


class SweepCost(NamedTuple):
    """Seconds of a sweep: by the wall, and of CPU in all its processes; and both of what is timed.

    mib_halfway, mib_last: the memory [MiB] of the calling process, when half of the runs have ended, and all.
    """

    wall_seconds: float
    cpu_seconds: float
    mib_at_half: float
    mib_at_end: float
    timed_seconds: float
    timed_cpu_seconds: float


class MemoryDisplay(SilentDisplay):
    """Notes how much memory [MiB] this process has when a run ends."""

    def __init__(self) -> None:
        super().__init__()
        self.mib: list[float] = []

    def finish_run(self, outcome: str) -> None:
        super().finish_run(outcome)
        self.mib.append(psutil.Process().memory_info().rss / 2**20)


def run_timed_sweep(runs: list[RunSpec], folder: Path, workers: int | None) -> SweepCost:
    """Do runs in a process of its own; workers: by how many, 0 by none. Raises RuntimeError where it fails."""
    folder.mkdir(parents=True)
    mine, theirs = (context := get_context("spawn")).Pipe()
    process = context.Process(target=_run_in_child, args=(theirs, runs, folder, workers))
    process.start()
    theirs.close()
    try:
        return mine.recv()
    except EOFError:
        raise RuntimeError("the sweep failed") from None
    finally:
        process.join()


def _run_in_child(answer: Any, runs: list[RunSpec], folder: Path, workers: int | None) -> None:
    began = monotonic()
    from springbench.harness.execution.pandas_deferral import request_deferral

    request_deferral()  # as a command does
    from springbench.harness.experiments import run_pipeline as runs_of
    from springbench.harness.experiments.sweep_runner import ExecutionOptions, run_sweep

    timed, note = runs_of._acquire_timing_lock, folder / "timed"

    @contextmanager
    def noting(*given: Any) -> Generator[dict[str, Any]]:
        with timed(*given) as how:
            since, used = monotonic(), process_time()
            yield how
            took = monotonic() - since, process_time() - used
        with note.open("a") as file:  # a short line is written at once
            file.write("{} {}\n".format(*took))

    runs_of._acquire_timing_lock = noting
    weighed = MemoryDisplay()
    execution = ExecutionOptions(num_workers=workers, isolated=workers != 0)
    run_sweep("costs", runs, folder, weighed, lambda said: None, execution)
    wall = monotonic() - began
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu = sum(one.ru_utime + one.ru_stime for one in used)
    noted = [[float(word) for word in line.split()] for line in note.read_text().splitlines()]
    mib = weighed.mib[len(runs) // 2], weighed.mib[-1]
    answer.send(SweepCost(wall, cpu, *mib, *map(sum, zip(*noted, strict=True))))


def _load_runs(folder: Path, **requested: Any) -> list[RunSpec]:
    path = folder / "costs.yaml"
    path.write_text(json.dumps(requested))
    return load_config(path).list_runs()


def list_short_runs(folder: Path, **options: Any) -> list[RunSpec]:
    """One short run of each solver and mesh size, for each value of an option that is a list."""
    scene = os.path.relpath(CONFIG_FOLDER / "scenes" / "hanging-cloth.yaml", folder)
    given = {"scenes": [scene], "sizes": list(MESH_SIZES), "solvers": list(SOLVER_NAMES)}
    return _load_runs(folder, **given, options=SHORT_OPTIONS | options)


def _build_short_runs(count: int, folder: Path) -> list[RunSpec]:
    """So many short runs, whose kernels are compiled."""
    run_timed_sweep(list_short_runs(folder, max_iterations=1, frames=2), folder / "first", None)
    each = range(1, 1 + ceil(count / len(MESH_SIZES) / len(SOLVER_NAMES)))
    return list_short_runs(folder, max_iterations=list(each))[:count]


def _untimed_cost(cost: SweepCost, count: int) -> dict[str, float]:
    """What a run takes in addition to its timed passes, in milliseconds."""
    other = {
        "wall_ms_beside": cost.wall_seconds - cost.timed_seconds,
        "cpu_ms_beside": cost.cpu_seconds - cost.timed_cpu_seconds,
    }
    return {name: 1e3 * seconds / count for name, seconds in other.items()}


def measure_short_runs(count: int, folder: Path) -> dict[str, Any]:
    """What n short runs take in addition to their timed passes, a run in milliseconds."""
    took = run_timed_sweep(_build_short_runs(count, folder), folder / "all", None)
    return took._asdict() | {"runs": count, "cores": len(os.sched_getaffinity(0))} | _untimed_cost(took, count)


def measure_isolation(count: int, folder: Path) -> dict[str, Any]:
    """What a worker adds to so many short runs, a run in milliseconds, and its share of what they take in all."""
    runs = _build_short_runs(count, folder)
    took = {name: run_timed_sweep(runs, folder / name, workers) for name, workers in {"here": 0, "by_1": 1}.items()}
    here, by_1 = (_untimed_cost(one, count) for one in took.values())
    added = {name: by_1[name] - here[name] for name in here}
    whole = {"wall_ms_beside": took["by_1"].wall_seconds, "cpu_ms_beside": took["by_1"].cpu_seconds}
    share = {name: added[name] * count / 1e3 / whole[name] for name in added}
    return {"runs": count, "here": here, "by_1": by_1, "added": added, "share_of_sweep": share}


def measure_cores(cases: int, folder: Path) -> dict[str, Any]:
    """What two workers save of a sweep of hard cases, one worker's share of timed passes, and what that allows."""
    hard = load_config(CONFIG_FOLDER / "hard.yaml").list_runs()
    scenes = list(dict.fromkeys(run.scene_name for run in hard))
    saved = scenes[:: max(1, len(scenes) // cases)][:cases]
    runs = [run for run in hard if run.scene_name in saved and run.solver.name in SOLVER_NAMES]
    run_timed_sweep(runs, folder / "first", None)
    one, two = (run_timed_sweep(runs, folder / f"by{workers}", workers) for workers in (1, 2))
    t = one.timed_seconds / one.wall_seconds
    allowed = 1.0 / (t + (1.0 - t) / 2.0)
    values = {
        "runs": len(runs),
        "t": t,
        "wall_by_1": one.wall_seconds,
        "wall_by_2": two.wall_seconds,
        "speed_up": one.wall_seconds / two.wall_seconds,
    }
    return values | {"allowed": allowed, "share_of_allowed": one.wall_seconds / two.wall_seconds / allowed}


MEASUREMENT_COMMANDS = {
    "short": (measure_short_runs, 500),
    "isolation": (measure_isolation, 500),
    "cores": (measure_cores, 10),
}
"""By name, and the number of each."""

if __name__ == "__main__":
    (what, usual), asked = MEASUREMENT_COMMANDS[sys.argv[1]], sys.argv[2:]
    with TemporaryDirectory() as temporary:
        print(json.dumps(what(int(asked[0]) if asked else usual, Path(temporary)), indent=1))

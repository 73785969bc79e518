"""A scheduler and workers as processes of their own: whichever is killed, no run is lost."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import Any, NamedTuple

import pytest
from springbench.harness.results import parquet_rows

from tests.plugin_solvers import SCENE_SOURCE

ROOT = Path(__file__).resolve().parents[2]
RUNS, PATIENCE = 12, 240.0

pytestmark = pytest.mark.long

SWEEP = """
scenes: [scene.yaml]
solvers: [sparse]
options: {frames: 4, rounds: 1, max_iterations: [5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16], record: false}
"""

FAR = """
from pathlib import Path
from springbench.harness.experiments import cluster
if cluster._do.__name__ == "_do":  # Dask loads it twice
    def far(unit, folder, *rest, do=cluster._do):
        return do(unit, Path("/elsewhere"), *rest)
    cluster._do = far
"""
"""A worker that does not see the client's folder."""

FULL = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))\n"
"""One that cannot write the rows of a run."""


class Farm(NamedTuple):
    """The processes of a cluster, and its address."""

    address: str
    scheduler: subprocess.Popen[str]
    workers: list[subprocess.Popen[str]]


@contextmanager
def farm(folder: Path, loaded: tuple[str, str] = ("", "")) -> Generator[Farm]:
    """A scheduler and two workers, and what they load first."""
    folder.mkdir()
    found, begun = folder / "scheduler.json", list[subprocess.Popen[str]]()

    def begin(what: str, *more: object) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--scheduler-file", found, "--no-dashboard"]
        quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        begun.append(subprocess.Popen([*map(str, [*command, *more])], cwd=ROOT, text=True, **quiet))
        return begun[-1]

    try:
        scheduler = begin("scheduler", "--host", "127.0.0.1", "--port", 0)
        wait_for(found.exists)
        for number, code in enumerate(loaded):
            first, place = folder / f"first{number}.py", folder / f"local{number}"
            first.write_text(code)
            begin("worker", "--nthreads", 1, "--no-nanny", "--local-directory", place, "--preload", first)
        yield Farm(json.loads(found.read_text())["address"], scheduler, begun[1:])
    finally:
        for process in begun:
            process.kill()
            process.wait()


def wait_for(holds: Any) -> None:
    until = monotonic() + PATIENCE
    while not holds():
        assert monotonic() < until
        sleep(0.02)


class Sweep(NamedTuple):
    config: Path
    rows: Path

    @classmethod
    def create(cls, folder: Path) -> Sweep:
        (folder / "scene.yaml").write_text(SCENE_SOURCE)
        (folder / "sweep.yaml").write_text(SWEEP)
        return cls(folder / "sweep.yaml", folder / "r" / "sweep" / "rows")

    def begin(self, address: str) -> subprocess.Popen[str]:
        command = ["run", str(self.config), "--results", str(self.rows.parents[1]), "--scheduler", address]
        return subprocess.Popen(
            [sys.executable, "-m", "springbench", *command], cwd=ROOT, stdout=-1, stderr=-2, text=True
        )

    def list_done_runs(self) -> dict[str, tuple[int, int]]:
        """The runs that have rows: which file, and when it was written."""
        there = [path for path in self.rows.glob("*.parquet") if not path.name.startswith(".")]
        return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in there}

    def finish_runs(self, address: str, before: dict[str, tuple[int, int]]) -> str:
        """Go on to the end, with nothing done again that was there; what was said."""
        said = self.begin(address)
        words, _ = said.communicate(timeout=PATIENCE)
        assert said.returncode == 0, words
        after = self.list_done_runs()
        assert before.items() <= after.items()
        assert len(after) == RUNS
        assert set(parquet_rows.read_rows(self.rows / name for name in after)["status"].to_pylist()) == {"ok"}
        assert not [*self.rows.parent.rglob("*partial*")]
        return " ".join(words.split())


def test_a_killed_scheduler_ends_the_command_with_that_reason_and_the_next_command_does_the_rest(tmp_path: Path):
    sweep = Sweep.create(tmp_path)
    with farm(tmp_path / "one") as first:
        client = sweep.begin(first.address)
        wait_for(sweep.list_done_runs)
        first.scheduler.kill()
        said, _ = client.communicate(timeout=PATIENCE)
    assert client.returncode == 1, said
    assert "the scheduler was lost" in " ".join(said.split())
    assert "Traceback" not in said
    with farm(tmp_path / "two") as second:
        sweep.finish_runs(second.address, sweep.list_done_runs())


def test_a_client_that_is_killed_leaves_what_was_done_and_the_workers_to_the_next(tmp_path: Path):
    sweep = Sweep.create(tmp_path)
    with farm(tmp_path / "one") as found:
        client = sweep.begin(found.address)
        wait_for(sweep.list_done_runs)
        client.kill()
        client.communicate()
        before = sweep.list_done_runs()
        there = re.search(rf"(\d+) of {RUNS} runs are there already", sweep.finish_runs(found.address, before))
    assert there
    assert int(there[1]) >= len(before)  # workers end what they have at hand, and see the folder here


def test_a_disk_that_is_full_on_one_worker_sends_its_runs_to_the_other(tmp_path: Path):
    sweep = Sweep.create(tmp_path)
    with farm(tmp_path / "one", (FAR + FULL, FAR)) as found:
        said = sweep.finish_runs(found.address, {})
    assert "is repeated by another worker" in said
    assert "File too large" in said

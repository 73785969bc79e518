"""A sweep that is killed and started again ends as an undisturbed one, and does nothing twice."""

import os
import random
import signal
import subprocess
import sys
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from textwrap import dedent
from time import monotonic, sleep
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from springbench.harness.cli.main import main
from springbench.harness.experiments.machine_calibration import CALIBRATION_COLUMNS as MACHINE
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.report import opengl_probe
from springbench.harness.results import parquet_rows

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 8
TIMES = ("seconds", "wall_seconds_check", "wall_seconds_sum", "cpu_seconds", "preempted", "phases_consistent")
WRITTEN_BY = (*TIMES, *MACHINE, "started_at", "commit", "source_fingerprint")
"""Columns that state how long a run took, and when and by which state of the code it was done."""

CLOTH = f"""
mesh: {{kind: grid}}
mass: 1.0
time_step: 1/30
frames: {FRAMES}
effects:
  - {{kind: springs, stretch: 100}}
  - {{kind: gravity}}
  - {{kind: pins, parts: [top_corners]}}
"""
SWEEP = """
scenes: [cloth.yaml]
sizes: [6]
solvers: [%s]
options: {max_iterations: 10, rounds: 2, pictures: %s}
"""

# One process imports what the command needs, and a copy of it runs each command.
PROCESSES = get_context("forkserver")
PROCESSES.set_forkserver_preload(
    [
        "springbench.harness.cli.main",
        "springbench.harness.config.config_loader",
        "springbench.harness.experiments.sweep_runner",
        "springbench.harness.recording.recording_reader",
        "springbench.harness.recording.rerun_recorder",
        "springbench.harness.report.run_picture",
        "springbench.harness.report.site",
        "springbench.harness.report.timing_plot",
        "springbench.harness.report.timing_table",
        "springbench.harness.simulation.timing_pass",
    ]
)


def command(arguments: list[str], output_path: Path) -> None:
    """The command line in a process of its own, which writes what it says to a file."""
    sys.stderr.flush()
    with output_path.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.argv = ["springbench", *arguments]
    main()


@dataclass(frozen=True)
class Sweep:
    """A sweep's file, and the folder of its results."""

    config: Path
    folder: Path

    @classmethod
    def write(cls, home: Path, solvers: str, pictures: bool) -> "Sweep":
        home.mkdir()
        (home / "cloth.yaml").write_text(CLOTH)
        (home / "sweep.yaml").write_text(SWEEP % (solvers, str(pictures).lower()))
        return cls(home / "sweep.yaml", home / "results" / "sweep")

    @property
    def arguments(self) -> list[str]:
        return ["run", str(self.config), "--results", str(self.folder.parent)]

    @property
    def output(self) -> str:
        """What the last start of it said."""
        return self.config.with_suffix(".log").read_text()

    def start(self) -> ForkServerProcess:
        """Start it."""
        process = PROCESSES.Process(target=command, args=(self.arguments, self.config.with_suffix(".log")))
        process.start()
        return process

    def finish(self) -> None:
        """Run it to its end."""
        process = self.start()
        process.join()
        assert process.exitcode == 0, self.output

    def files(self) -> set[str]:
        return {str(path.relative_to(self.folder)) for path in self.folder.rglob("*") if path.is_file()}

    def rows(self) -> list[dict[str, Any]]:
        table = parquet_rows.read_rows(sorted((self.folder / "rows").iterdir()))
        return table.drop_columns(list(WRITTEN_BY)).to_pylist()

    def complete(self) -> dict[Path, tuple[int, int]]:
        """The rows and recordings of all runs that have rows: which file it is, and when it was written."""
        there = [path for path in (self.folder / "rows").glob("*.parquet") if not path.name.startswith(".")]
        there += [self.folder / "recordings" / f"{path.stem}.rrd" for path in there]
        return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in there}

    def recordings(self) -> dict[str, Path]:
        """The recordings of single runs."""
        return {p.name: p for p in (self.folder / "recordings").iterdir() if not p.stem.endswith("-solvers")}


@dataclass(frozen=True)
class Case:
    """What is swept, whether it is drawn, and how often it is killed; ten times in all."""

    solvers: str
    pictures: bool
    kills: int

    def write(self, home: Path) -> Sweep:
        return Sweep.write(home, self.solvers, self.pictures)


CASES = [Case("dense, sparse, numba", pictures=False, kills=7), Case("sparse, numba", pictures=True, kills=3)]


@dataclass(frozen=True)
class UndisturbedSweep:
    """A sweep that was left alone, and how long it took [s]."""

    case: Case
    sweep: Sweep
    seconds: float


@pytest.fixture(scope="module", params=CASES, ids=["without pictures", "with pictures"])
def undisturbed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> UndisturbedSweep:
    imported = PROCESSES.Process(target=int)
    imported.start()
    imported.join()
    sweep = request.param.write(tmp_path_factory.mktemp("undisturbed") / "home")
    began = monotonic()
    sweep.finish()
    return UndisturbedSweep(request.param, sweep, monotonic() - began)


def assert_equal(sweep: Sweep, other: Sweep) -> None:
    """Both have the same files, rows and recorded positions; all recordings and pictures can be read."""
    assert sweep.files() == other.files()
    # As text, because a residual that was not computed is not a number, which equals nothing.
    assert list(map(repr, sweep.rows())) == list(map(repr, other.rows()))
    for name, path in other.recordings().items():
        expected, found = read_replay(path), read_replay(sweep.recordings()[name])
        np.testing.assert_array_equal(found.frames, np.arange(FRAMES + 1))
        np.testing.assert_array_equal(found.positions, expected.positions)
    for picture in (sweep.folder / "pictures").glob("*.png"):
        assert imread(picture).std() > 0


def test_a_sweep_leaves_its_files_and_nothing_else(undisturbed: UndisturbedSweep):
    runs = {path.stem for path in (undisturbed.sweep.folder / "rows").iterdir()}
    assert len(runs) == len(undisturbed.case.solvers.split())
    expected = {".lock", ".claims", ".config", "references.bib", "recordings/cloth-6-solvers.rrd"}
    expected |= {f"rows/{run}.parquet" for run in runs} | {f"recordings/{run}.rrd" for run in runs}
    if undisturbed.case.pictures:
        expected |= {"pictures/timing.png", "pictures/timing.svg"}
        if not opengl_probe.find_opengl_problem():
            expected |= {f"pictures/{run}.png" for run in runs} | {"pictures/cloth-6-solvers.png"}
    assert undisturbed.sweep.files() == expected


def test_a_killed_sweep_resumes_where_it_was(undisturbed: UndisturbedSweep, tmp_path: Path):
    """It is killed at seeded moments; if it comes to its end before that, a new one begins."""
    chance, case, kills, lasts = random.Random(2013), undisturbed.case, 0, undisturbed.seconds
    sweep, complete = case.write(tmp_path / "0"), {}
    for attempt in range(1, 10 * case.kills):
        process, began = sweep.start(), monotonic()
        process.join(chance.uniform(0.0, lasts) if kills < case.kills else None)
        if process.exitcode is None:
            process.kill()
            process.join()
            kills += process.exitcode == -signal.SIGKILL
        assert process.exitcode in (0, -signal.SIGKILL), sweep.output
        assert complete.items() <= sweep.complete().items(), "a run that was complete was done again"
        complete = sweep.complete()
        if process.exitcode == 0:
            lasts = min(lasts, monotonic() - began)  # with kernels that were compiled before, much less than at first
            assert_equal(sweep, undisturbed.sweep)
            if kills == case.kills:
                return
            sweep, complete = case.write(tmp_path / str(attempt)), {}
    pytest.fail("it comes to its end before it can be killed")


def test_ctrl_c_states_how_to_resume(tmp_path: Path):
    sweep = Sweep.write(tmp_path / "home", "sparse, numba", pictures=False)
    process = subprocess.Popen(
        [sys.executable, "-m", "springbench", *sweep.arguments],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # A shell that started these tests in the background has made its children deaf to Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while not (sweep.folder / "recordings").exists() and process.poll() is None:
        sleep(0.002)
    process.send_signal(signal.SIGINT)
    _, completed = process.communicate()
    assert process.returncode == 130, completed
    assert "the same command resumes from there" in completed
    assert "Traceback" not in completed
    sweep.finish()
    undisturbed = Sweep.write(tmp_path / "undisturbed", "sparse, numba", pictures=False)
    undisturbed.finish()
    assert_equal(sweep, undisturbed)


# Mass goes by area: the fourth vertex, in no face, has neither mass nor a spring.
FAILING = {
    "blown.yaml": """
        mesh: {kind: chain}
        mass: 1.0
        time_step: 1/30
        frames: 2
        effects: [{kind: springs, stretch: 10}, {kind: constant-force, force: [1.0e+300, 0, 0]}]
        """,
    "cloth.yaml": CLOTH,
    "sweep.yaml": """
        scenes: [blown.yaml, cloth.yaml]
        solvers: [sparse, numba]
        options: {pictures: false}
        sizes: [4]
        """,
}


def test_a_failing_run_is_a_row_with_its_reason_and_the_others_are_done(tmp_path: Path):
    for name, text in FAILING.items():
        (tmp_path / name).write_text(dedent(text))
    sweep = Sweep(tmp_path / "sweep.yaml", tmp_path / "results" / "sweep")
    for again in (False, True):
        process = sweep.start()
        process.join()
        assert process.exitcode == 1, sweep.output
        assert "Traceback" not in sweep.output
        assert ("are there already" in sweep.output) == again
        found = {(row["scene"], row["solver"], row["status"]) for row in sweep.rows()}
        failed = {("blown", solver, "diverged") for solver in ("sparse", "numba")}
        assert found == failed | {("cloth", solver, "ok") for solver in ("sparse", "numba")}
        reasons = [row["reason"] for row in sweep.rows() if row["status"] == "diverged"]
        assert len(reasons) == 2
        assert all("not finite" in reason for reason in reasons)

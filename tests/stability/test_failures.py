"""What goes wrong while a run runs is a row with a status, the frame and the reason, and the sweep goes on.

The frames before it are recorded, and the recording is marked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pyarrow.parquet as pq
import pytest
from springbench.harness.cli.main import app
from springbench.harness.recording.recording_reader import read_replay
from springbench.solvers.linalg.direct_solvers import DenseCholesky
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.time_stepping.symplectic_euler import PreparedSymplecticEuler, SymplecticEuler
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solution, StepProblem, StopRule, System
from springbench.solvers.registry import SOLVERS
from typer.testing import CliRunner

FRAMES, FAILING_FRAME = 20, 4
"""Frames of the run, and the one in which what is made to break does."""

SCENE = f"""
mesh: {{kind: chain}}
mass: 1
time_step: 0.1
frames: {FRAMES}
default_size: 4
effects: [{{kind: springs, stretch: 1.0e+12}}, {{kind: gravity}}, {{kind: pins, parts: [first]}}]
"""
SWEEP = """
scenes: [scene.yaml]
solvers: [broken, sparse]
options: {pictures: false, rounds: 1, max_iterations: 5}
"""


@dataclass(frozen=True)
class _Breaking:
    """Local-global, until a frame in which something else happens instead."""

    sound: PreparedSolver
    happens: Callable[[], object]

    @property
    def description(self) -> str:
        return ""

    @property
    def stats(self) -> dict[str, float]:
        return self.sound.stats

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        return self.sound.iterates(problem)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        if round(problem.step_start.time / problem.system.time_step) == FAILING_FRAME - 1:
            self.happens()
        return self.sound.solve(problem, stop)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        return self.sound.residual_at(problem, p)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        return {}


@dataclass(frozen=True)
class Indefinite:
    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True

    def prepare(self, system: System) -> PreparedSolver:
        return _Breaking(SparseLocalGlobal().prepare(system), lambda: DenseCholesky(-np.eye(3)))


@dataclass(frozen=True)
class OutOfMemory:
    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True

    def prepare(self, system: System) -> PreparedSolver:
        return _Breaking(SparseLocalGlobal().prepare(system), lambda: np.empty(2**55))


@dataclass(frozen=True)
class PastItsLimit:
    """Symplectic Euler in one substep, where stability requires a million: each step multiplies what it begins with."""

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False

    def prepare(self, system: System) -> PreparedSymplecticEuler:
        slow = SymplecticEuler().prepare(replace(system, time_step=1e-9))
        assert isinstance(slow, PreparedSymplecticEuler)
        return replace(slow, system=system, num_substeps=1)


FAILURES = {
    "a factorisation fails": (Indefinite, "failed", "positive definite"),
    "memory runs out": (OutOfMemory, "failed", "Unable to allocate"),
    "a solver diverges": (PastItsLimit, "diverged", "on the motion has"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_a_failure_in_a_frame_is_reported_and_recorded_up_to_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
):
    solver, status, reason = FAILURES[case]
    monkeypatch.setitem(SOLVERS, "broken", f"{__name__}:{solver.__name__}")
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    results = tmp_path / "results"
    answer = CliRunner().invoke(app, ["run", str(tmp_path / "sweep.yaml"), "--results", str(results)])
    assert answer.exit_code == 1, (answer.output, answer.exception)
    assert reason in answer.output.replace("\n", " ")
    rows = [row for path in (results / "sweep" / "rows").iterdir() for row in pq.read_table(path).to_pylist()]
    (broken,) = [row for row in rows if row["solver"] == "broken"]
    assert (broken["phase"], broken["status"]) == ("run", status)
    assert reason in broken["reason"]
    assert broken["frame"] == FAILING_FRAME or (status == "diverged" and 1 < broken["frame"] < FAILING_FRAME)
    others = [row for row in rows if row["solver"] == "sparse"]
    assert {row["status"] for row in others} == {"ok"}
    assert {row["frame"] for row in others if row["phase"] == "step"} == set(range(1, FRAMES + 1))
    (recording,) = (results / "sweep" / "recordings").glob("*-broken-*.rrd")
    replay = read_replay(recording)
    assert replay.frames.tolist() == list(range(broken["frame"]))
    assert np.isfinite(replay.positions[:FAILING_FRAME]).all()
    assert (replay.properties["status"], replay.properties["failed_frame"]) == (status, broken["frame"])
    assert reason in str(replay.properties["reason"])

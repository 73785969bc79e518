"""A run whose times, phases or recording are wrong is a failed run, for shipped and for user code."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any, ClassVar

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.recording.recorder_interface import RecordedFrame
from springbench.harness.recording.rerun_recorder import RerunRecorder
from springbench.harness.recording.strain_shading import StrainShading
from springbench.harness.simulation import stopwatch as clocks
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.integrators import Motion, SingleStageIntegrator
from springbench.solvers.model.step_problem import (
    Positions,
    PreparedSolver,
    Solution,
    StepProblem,
    StepStart,
    StopRule,
    System,
)
from springbench.solvers.registry import SOLVERS

from tests.preemption_retry import retry_if_preempted

FRAMES = 6
SCENE = f"""
mesh: {{kind: grid}}
mass: 1.0
time_step: 1/30
frames: {FRAMES}
default_size: 5
effects: [{{kind: springs, stretch: 100}}, {{kind: gravity}}, {{kind: pins, parts: [top_corners]}}]
"""
SOLVE = 0.003
"""Seconds of CPU time that a solve takes at least, so that steps are nothing but solves."""

spent = 0.0
"""Seconds that solves have taken until now."""


@dataclass(frozen=True)
class Busy:
    """Local-global iterations that take their time; lies: phases instead of its own."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    lies: ClassVar[dict[str, Callable[[], object]]] = {}

    def prepare(self, system: System) -> _Busy:
        return _Busy(SparseLocalGlobal().prepare(system))


@dataclass(frozen=True)
class _Busy:
    base: PreparedSolver

    @property
    def description(self) -> str:
        return self.base.description

    @property
    def stats(self) -> dict[str, float]:
        return self.base.stats

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        return self.base.iterates(problem)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        global spent
        began, busy = perf_counter(), thread_time()
        while thread_time() - busy < SOLVE:
            pass
        solution = self.base.solve(problem, stop)
        spent += perf_counter() - began
        return solution

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        return self.base.residual_at(problem, p)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        return self.base.iteration_phases(problem) | Busy.lies


@pytest.fixture
def execute_busy_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[], tuple[list[dict[str, Any]], RunFiles]]:
    """Does a run of the busy solver; its rows, and its files."""
    monkeypatch.setitem(SOLVERS, "busy", f"{__name__}:Busy")
    (tmp_path / "scene.yaml").write_text(SCENE)
    (spec,) = load_config(tmp_path / "scene.yaml", solvers=["busy"], max_iterations=3, rounds=1).list_runs()
    files = RunFiles.for_run(spec, tmp_path)
    files.rows_path.parent.mkdir()
    return lambda: (execute_run(spec, files, lambda phase: None), files)


def test_a_run_with_a_correct_report_is_accepted(execute_busy_run):
    found, files = execute_busy_run()
    assert {row["status"] for row in found} == {"ok"}
    assert files.recording_path.exists()
    steps = [row for row in found if row["phase"] == "step"]
    assert all(row["wall_seconds_check"] >= FRAMES * SOLVE for row in steps)
    assert [row["frame"] for row in steps if row.get("recording_digest")] == [FRAMES]


CLOCKS = {
    "without the solve": lambda: perf_counter() - spent,
    "over a thousand": lambda: perf_counter() / 1000,
    "times two": lambda: perf_counter() * 2,
}


@pytest.mark.parametrize("clock", CLOCKS.values(), ids=CLOCKS)
def test_a_run_whose_steps_do_not_add_up_to_the_wall_time_fails(
    execute_busy_run, monkeypatch: pytest.MonkeyPatch, clock
):
    monkeypatch.setattr(clocks, "perf_counter", clock)
    (row,), files = retry_if_preempted(execute_busy_run)
    assert row["status"] == "failed"
    assert "the times of step add up to" in row["reason"]
    assert not files.recording_path.exists()


UNCHANGED_ARRAY = np.ones((25, 3))


@pytest.mark.parametrize("whole", [lambda: None, lambda: UNCHANGED_ARRAY], ids=["nothing", "what was there"])
def test_a_run_with_a_phase_that_does_nothing_fails(execute_busy_run, monkeypatch: pytest.MonkeyPatch, whole):
    monkeypatch.setitem(Busy.lies, "global", whole)
    (row,), _ = execute_busy_run()
    assert row["status"] == "failed"
    assert "the phase global does nothing" in row["reason"]


def late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each frame has the positions of the one before."""
    record, fixed = RerunRecorder.record_frame, []

    def frame(self: RerunRecorder, frame: RecordedFrame) -> None:
        fixed.append(frame.positions)
        record(self, replace(frame, positions=fixed[-2] if len(fixed) > 1 else fixed[0]))

    monkeypatch.setattr(RerunRecorder, "record_frame", frame)


def recolour_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each frame has the colours of the first."""
    strains, first = StrainShading.compute_strains, []

    def of(self: StrainShading, p: Positions):
        first.append(strains(self, p))
        return first[0]

    monkeypatch.setattr(StrainShading, "compute_strains", of)


RECORDINGS = {
    "a frame late": (late, "was recorded with other positions"),
    "another frame's colours": (recolour_frames, "was recorded with other colours"),
}


@pytest.mark.parametrize(("lie", "reason"), RECORDINGS.values(), ids=RECORDINGS)
def test_a_run_whose_recording_does_not_end_as_it_did_fails(
    execute_busy_run, monkeypatch: pytest.MonkeyPatch, lie, reason: str
):
    lie(monkeypatch)
    (row,), files = execute_busy_run()
    assert row["status"] == "failed"
    assert reason in row["reason"]
    assert not files.recording_path.exists()


def test_a_run_whose_second_pass_differs_from_the_timed_one_fails(execute_busy_run, monkeypatch: pytest.MonkeyPatch):
    steps = count()
    advance = SingleStageIntegrator.complete_step

    def drifting(self: SingleStageIntegrator, start: StepStart, solution: Solution) -> Motion:
        moved = advance(self, start, solution)
        return moved._replace(positions=moved.positions + 1e-9 * (next(steps) >= 2 * FRAMES))

    monkeypatch.setattr(SingleStageIntegrator, "complete_step", drifting)
    (row,), _ = execute_busy_run()
    assert row["status"] == "failed"
    assert (
        row["reason"]
        == "the final positions of the recorded pass differ from those of the timed pass; expected equal bits"
    )

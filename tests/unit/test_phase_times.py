"""Times contain what they are said to contain: each is set between what was done within it and what went on around it.

A scripted solver sleeps and takes its own stamps, of the clock that the harness reads. An interval that encloses
another one is longer, on a machine of any speed; sums of them are not compared to a share.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from time import perf_counter, sleep
from typing import ClassVar

import numpy as np
import pytest
from springbench.harness.errors import RunFailed
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.simulation import timing_pass
from springbench.harness.simulation.stopwatch import PhaseWatch
from springbench.harness.simulation.timing_pass import (
    ITERATION_PHASE,
    PHASE_REPEATS,
    RunMeasurement,
    SteppingSettings,
    TimingSample,
    measure_run,
)
from springbench.solvers.model.step_problem import Positions, Solution, StepProblem, StopRule, System

from tests.scene_builders import build_test_scene

FRAMES, ROUNDS, ITERATIONS = 3, 2, 4
SCENE = build_test_scene(ChainMesh(), GravityEffect(), size=4)
SETTINGS = SteppingSettings(StopRule(ITERATIONS), "previous", FRAMES, ROUNDS)
TAKES = {"prepare": 0.004, "solve": 0.008, "local": 0.001, "global": 0.002}
"""Seconds that each part sleeps at least."""


@dataclass
class Sleeper:
    """A solver that is prepared with itself; slept: by part, how long each call of it slept, by its own stamps."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True

    slept: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    description: str = ""
    stats: dict[str, float] = field(default_factory=dict)

    def rest(self, part: str) -> Positions:
        began = perf_counter()
        sleep(TAKES[part])
        self.slept[part].append(perf_counter() - began)
        return np.zeros((4, 3))

    def prepare(self, system: System) -> Sleeper:
        self.rest("prepare")
        return self

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        yield problem.initial_guess

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        self.rest("solve")
        return Solution(problem.initial_guess + 1.0, stop.max_iterations, 0.0, 0.0, "max-iter")

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        return 0.0

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        return {part: lambda part=part: self.rest(part) for part in ("local", "global")}


@pytest.fixture(scope="module")
def measured_run() -> tuple[Sleeper, RunMeasurement, float]:
    """The solver, what was measured of it, and the seconds of all."""
    solver, began = Sleeper(), perf_counter()
    measured = measure_run(SCENE, solver, SETTINGS, lambda phase: sleep(0.02))
    return solver, measured, perf_counter() - began


def of(measured: RunMeasurement, phase: str) -> list[TimingSample]:
    return [t for t in measured.timings if t.phase == phase]


def test_each_phase_is_timed_as_often_as_reported(measured_run):
    _, measured, _ = measured_run
    counts = {phase: len(of(measured, phase)) for phase in ("prepare", "local", "global", ITERATION_PHASE, "step")}
    repeated = FRAMES * PHASE_REPEATS
    steps = FRAMES * ROUNDS
    assert counts == {
        "prepare": ROUNDS + 1,
        "local": repeated,
        "global": repeated,
        ITERATION_PHASE: FRAMES,
        "step": steps,
    }
    assert len(measured.timings) == sum(counts.values())
    assert [(t.frame, t.round) for t in of(measured, "step")] == [(f, r) for r in range(ROUNDS) for f in (1, 2, 3)]


def test_times_include_the_work_of_their_phase(measured_run):
    solver, measured, whole = measured_run
    repeats = [call for k, call in enumerate(solver.slept["local"]) if k % (PHASE_REPEATS + 2) >= 2]
    assert all(t.seconds >= slept for t, slept in zip(of(measured, "local"), repeats, strict=True))
    repeats = [call for k, call in enumerate(solver.slept["global"]) if k % (PHASE_REPEATS + 2) >= 2]
    assert all(t.seconds >= slept for t, slept in zip(of(measured, "global"), repeats, strict=True))
    assert all(t.seconds >= slept for t, slept in zip(of(measured, "prepare"), solver.slept["prepare"], strict=True))
    other, timed = solver.slept["solve"][1 : 2 * FRAMES : 2], solver.slept["solve"][2 * FRAMES :]
    assert all(t.seconds * t.num_calls >= slept for t, slept in zip(of(measured, ITERATION_PHASE), other, strict=True))
    assert all(t.seconds >= slept for t, slept in zip(of(measured, "step"), timed, strict=True))
    assert sum(t.seconds * t.num_calls for t in measured.timings) <= whole


def test_what_is_shown_between_steps_is_in_no_time(measured_run):
    _, measured, whole = measured_run
    shown = 0.02 * FRAMES * (1 + ROUNDS)
    assert sum(t.seconds * t.num_calls for t in measured.timings) <= whole - shown
    assert sum(watch.wall_seconds for watch in measured.watches.values()) <= whole - shown


def test_every_time_is_within_the_time_of_its_watch(measured_run):
    _, measured, _ = measured_run
    assert set(measured.watches) == {("prepare", None), ("local", None), ("global", None), (ITERATION_PHASE, None)} | {
        ("step", round) for round in range(ROUNDS)
    }
    for (phase, round), watch in measured.watches.items():
        total_seconds = sum(t.seconds * t.num_calls for t in of(measured, phase) if round in (None, t.round))
        # The raw clock and the one that is adjusted differ by 500 parts in a million at most.
        assert total_seconds <= watch.wall_seconds * (1 + 5e-4)


def test_rows_state_both_clocks_and_mark_a_solver_that_sleeps_as_preempted(measured_run):
    _, measured, _ = measured_run
    for row in timing_pass.build_timing_rows(measured):
        assert row["wall_seconds_sum"] <= row["wall_seconds_check"] * (1 + 5e-4)
        assert row["cpu_seconds"] < row["wall_seconds_check"]
        assert row["preempted"]
    by_round = [
        {
            r["wall_seconds_sum"]
            for r in timing_pass.build_timing_rows(measured)
            if r["round"] == k and r["phase"] == "step"
        }
        for k in (0, 1)
    ]
    for round, times in enumerate(by_round):
        assert times == {sum(t.seconds for t in of(measured, "step") if t.round == round)}


@pytest.mark.parametrize("phase", ["prepare", "local", "global", ITERATION_PHASE, "step"])
def test_no_row_is_made_of_times_that_are_scaled(measured_run, phase: str):
    _, measured, _ = measured_run
    scaled = [
        TimingSample(t.phase, t.frame, t.round, t.seconds / (1000 if t.phase == phase else 1), t.num_calls)
        for t in measured.timings
    ]
    # The other clock saw what the true times add up to, whatever else the machine did then.
    walls = {
        (name, round): sum(t.seconds * t.num_calls for t in of(measured, name) if round in (None, t.round))
        for name, round in measured.watches
    }
    busy = {
        key: PhaseWatch(1, walls[key], watch.num_entries, walls[key], walls[key])
        for key, watch in measured.watches.items()
    }
    with pytest.raises(RunFailed, match=f"the times of {phase} add up to"):
        timing_pass.build_timing_rows(RunMeasurement(measured.prepared, scaled, busy, measured.final_positions))


PARTS = {
    "they do": ({"local": 3.0, "global": 7.0}, 10.0, True),
    "a phase does nothing": ({"local": 3.0, "global": 0.001}, 10.0, False),
    "just so": ({"local": 3.0, "global": 8.4}, 10.0, True),
    "too much": ({"local": 3.0, "global": 8.6}, 10.0, False),
    "too little": ({"local": 3.0, "global": 5.4}, 10.0, False),
    "three of them": ({"gradient": 3.0, "factor": 5.0, "solve": 2.0}, 10.0, True),
}


@pytest.mark.parametrize(("phases", "iteration", "expected"), PARTS.values(), ids=PARTS)
def test_rows_state_whether_phases_add_up_to_an_iteration(phases: dict[str, float], iteration: float, expected: bool):
    timings = [TimingSample("step", 1, 0, 40.0)]
    for frame in (1, 2, 3):
        slow = 50.0 if frame == 2 else 1.0  # one frame that was disturbed does not decide
        timings += [
            TimingSample(phase, frame, k, t * slow) for phase, t in phases.items() for k in range(PHASE_REPEATS)
        ]
        timings.append(TimingSample(ITERATION_PHASE, frame, 0, iteration, 4))
    watches = {}
    for t in timings:
        watch = watches.setdefault((t.phase, RunMeasurement.get_round(t)), PhaseWatch(1))
        watch.wall_seconds = watch.process_seconds = watch.thread_seconds = watch.wall_seconds + t.seconds * t.num_calls
    found = {
        row["phase"]: row["phases_consistent"]
        for row in timing_pass.build_timing_rows(RunMeasurement(Sleeper(), timings, watches, np.zeros((4, 3))))
    }
    assert found == {"step": None, ITERATION_PHASE: expected} | dict.fromkeys(phases, expected)

"""The speed report: which candidates are interleaved, what is left out and why, what is counted."""

from __future__ import annotations

import shutil
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from springbench.harness.config.config_loader import load_config, load_sweep
from springbench.harness.config.sweep_config import RunSpec, SolverSpec
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.execution.folder_locks import lock_folder_exclusive
from springbench.harness.experiments.roofline import (
    benchmark_candidates,
    roofline_comparison,
    round_robin,
    stream_probes,
)
from springbench.harness.experiments.roofline.benchmark_candidates import CandidateTiming, compute_call_seconds
from springbench.harness.experiments.roofline.precision_error import compute_precision_error, find_converged_problem
from springbench.harness.experiments.roofline.roofline_comparison import run_roofline
from springbench.harness.experiments.roofline.round_robin import (
    NUM_PREPARATIONS,
    PastTiming,
    format_candidate_name,
    measure_round_robin,
    predict_seconds,
)
from springbench.harness.report.speed.operation_counts import count_operations
from springbench.harness.report.speed.speed_figures import compute_speed_figures
from springbench.harness.report.speed.speed_table import build_speed_table, describe_speed
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.model.step_problem import StopRule, Unsupported

from tests.preemption_retry import retry_if_preempted
from tests.progress_displays import SilentDisplay
from tests.scene_builders import build_cloth, build_first_problem

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "configs" / "scenes" / "yardstick-cloth.yaml"
COUNTS = {"vertices": 16, "springs": 42}
ROUNDS = 3


def run(solver: str, **parameters: Any) -> RunSpec:
    """A run of the report's cloth under another solver's name."""
    (made,) = load_config(SCENE, solvers=["sparse"], sizes=[4], rounds=ROUNDS, threads=1, max_iterations=50).list_runs()
    return made.replace_options(solver=SolverSpec(solver, parameters))


class ScriptedCandidate:
    """A candidate that records when it is called, and behaves as specified."""

    def __init__(self, solver: str, calls: list[str], *, at: float = 0.0, fails: Exception | None = None) -> None:
        self.run, self.calls, self.at, self.fails = run(solver), calls, at, fails
        self.columns: dict[str, Any] = {"solver_description": solver}

    def prepare(self) -> float | None:
        self.calls.append(f"prepare {self.run.solver.name}")
        if self.fails:
            raise self.fails
        return 0.5

    def time_phases(self) -> list[CandidateTiming]:
        self.calls.append(self.run.solver.name)
        return [CandidateTiming("step", 0.25, {"num_iterations": 50})]

    def close(self):
        # The second coordinate gives the scene a size of 1.
        return np.array([[self.at, 0.0, 0.0], [self.at, 1.0, 0.0]])


def test_candidates_are_interleaved():
    calls: list[str] = []
    found = measure_round_robin([ScriptedCandidate("a", calls), ScriptedCandidate("b", calls)], COUNTS, {}, budget=1.0)
    assert calls == ["prepare a", "prepare b"] * NUM_PREPARATIONS + ["a", "b"] * ROUNDS
    for rows, solver in zip(found, "ab", strict=True):
        assert [row["round"] for row in rows if row["phase"] == "prepare"] == list(range(NUM_PREPARATIONS))
        assert [row["seconds"] for row in rows if row["phase"] == "step"] == [0.25] * ROUNDS
        assert {row["status"] for row in rows} == {"ok"}
        assert {(row["solver"], row["solver_description"], row["vertices"]) for row in rows} == {(solver, solver, 16)}


@pytest.mark.parametrize(
    ("error", "status"), [(Unsupported("not for chains"), "unsupported"), (ZeroDivisionError("oh"), "failed")]
)
def test_a_candidate_that_fails_states_why_and_the_others_continue(error: Exception, status: str):
    calls: list[str] = []
    bad, good = measure_round_robin(
        [ScriptedCandidate("a", calls, fails=error), ScriptedCandidate("b", calls)], COUNTS, {}, budget=1.0
    )
    assert [(row["phase"], row["status"]) for row in bad] == [("run", status)]
    assert str(error) in bad[0]["reason"]
    assert calls.count("b") == ROUNDS
    assert {row["status"] for row in good} == {"ok"}


def test_times_of_a_candidate_with_another_solution_are_rejected():
    first, near, far = measure_round_robin(
        [ScriptedCandidate("a", []), ScriptedCandidate("b", [], at=1e-10), ScriptedCandidate("c", [], at=1e-8)],
        COUNTS,
        {},
        budget=1.0,
    )
    assert first[-1]["status"] == near[-1]["status"] == "ok"
    assert [row["status"] for row in far] == ["failed"]
    assert "1.0e-08" in far[0]["reason"]
    assert "seconds" not in far[0]


def test_a_candidate_that_would_take_too_long_is_omitted_with_a_row_that_states_it():
    calls: list[str] = []
    slow = ScriptedCandidate("a", calls)
    past = {format_candidate_name(slow.run): [PastTiming(4, prepare_seconds=1.0, iteration_seconds=1.0)]}
    (rows,) = measure_round_robin([slow], COUNTS, past, budget=10.0)
    assert calls == []
    assert [(row["status"], row["phase"]) for row in rows] == [("skipped", "run")]
    assert "budget of each candidate is 10 s" in rows[0]["reason"]


def test_a_long_preparation_is_not_repeated(monkeypatch: pytest.MonkeyPatch):
    calls: list[str] = []
    slow, quick = ScriptedCandidate("a", calls), ScriptedCandidate("b", calls)
    monkeypatch.setattr(round_robin, "MAX_REPEATED_SECONDS", 0.7)
    monkeypatch.setattr(slow, "prepare", lambda: calls.append("prepare a") or 1.0)
    found, _ = measure_round_robin([slow, quick], COUNTS, {}, budget=10.0)
    assert [calls.count(f"prepare {name}") for name in "ab"] == [1, NUM_PREPARATIONS]
    assert [row["round"] for row in found if row["phase"] == "prepare"] == [0]


@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_less_precision_moves_nothing_that_has_converged(precision):
    problem = build_first_problem(build_cloth(8))
    rest = find_converged_problem(problem)
    assert rest is not None
    assert np.abs(problem.gradient(rest.problem.initial_guess)).max() < 1e-6  # in addition to 9.81 N of weight
    # The tolerance of the method; rounding leaves 1e-13.
    assert compute_precision_error(rest, CompiledLocalGlobal("supernodal", precision).prepare(problem.system)) <= 1e-9


@pytest.mark.parametrize("power", [1.0, 1.5, 3.0])
def test_a_power_law_is_predicted_exactly(power: float):
    past = [PastTiming(n, prepare_seconds=2.0 * n**power, iteration_seconds=0.1 * n**power) for n in (10, 40)]
    seconds = NUM_PREPARATIONS * 2.0 * 90**power + ROUNDS * 50 * 0.1 * 90**power
    # Logarithms and back: a few units in the last place.
    assert predict_seconds(past, 90, run("a")) == pytest.approx(seconds, rel=1e-12)
    assert predict_seconds([], 90, run("a")) == 0.0
    # What is known of larger sizes says nothing about smaller ones.
    assert predict_seconds(past, 10, run("a")) == 0.0


def test_a_short_call_is_repeated_after_a_first_one_and_a_long_one_is_not():
    arguments: list[int] = []

    def seconds(number: int) -> float:
        arguments.append(number)
        return number * 1e-3

    assert compute_call_seconds(seconds, 0.02) == pytest.approx(1e-3, rel=1e-12)
    assert compute_call_seconds(seconds, 1e-4) == pytest.approx(1e-3, rel=1e-12)
    assert arguments == [1, 20, 1]


def test_an_entry_that_is_read_is_a_multiply_and_an_add_for_each_of_three_sides():
    facts = {"nnz_factor": 100.0, "factor_bytes": 960.0, "flops_per_solve": 1440.0}
    work = count_operations(facts, vertices=10, springs=20)
    assert work["global"].flop_count == 1440
    assert work["global"].bytes_moved == 240 * 8 + 176 * 10
    assert work["global"].working_set_bytes == 960 + 80 * 10
    assert work["iteration"].bytes_moved == work["global"].bytes_moved + work["local"].bytes_moved
    assert work["iteration"].working_set_bytes == 960 + 80 * 10 + 16 * 20  # vectors are there once
    # L alone is read once in each pass.
    assert count_operations({"nnz_factor": 100.0}, 10, 20, "float32")["global"].bytes_moved == 2 * 100 * 4 + 176 * 10
    assert set(count_operations({}, 10, 20)) == {"local"}


def test_the_microbenchmarks_do_the_operations_that_they_count():
    found = list(stream_probes.build_probes((1 << 14, 1 << 16)))
    assert [p.name for p in found] == ["read", "triad"] * 2 + ["fma float64", "fma float32"]
    assert all(p.bytes_moved % p.working_set_bytes == 0 for p in found if p.name == "read")
    total = found[0].call()
    # The array contains ones: every entry that was counted was read.
    assert 8 * total == found[0].bytes_moved
    b, c, a = np.full(8, 2.0), np.full(8, 5.0), np.empty(8)
    stream_probes._triad(a, b, c, 1, 1)
    assert (a == 17.0).all()
    assert found[4].flops == found[5].flops / 2


SWEEP = """
scenes: [yardstick-cloth.yaml]
sizes: [5, 4]
solvers: [dense, sparse]
options: {max_iterations: 4, rounds: 2, record: false, pictures: false}
"""


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A small sweep on a machine without a compiler, with few and short probes and no repetitions."""
    (tmp_path / "small.yaml").write_text(SWEEP)
    (tmp_path / SCENE.name).write_bytes(SCENE.read_bytes())
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.setattr(stream_probes, "WORKING_SETS", (1 << 14, 1 << 16))
    monkeypatch.setattr(stream_probes.build_probes, "__defaults__", ((1 << 14, 1 << 16),))
    monkeypatch.setattr(benchmark_candidates.compute_call_seconds, "__defaults__", (0.0,))
    return load_sweep(tmp_path / "small.yaml")


def test_candidates_compute_the_step_that_their_rows_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    options = {"integrator": "bdf2", "initial_guess": "inertial", "max_iterations": 4}
    (made,) = load_config(SCENE, solvers=["sparse"], sizes=[4], rounds=1, threads=1, **options).list_runs()
    (candidate,) = _catch_candidates([made], tmp_path, monkeypatch)
    scene = build_scene(made.scene, 4, "bdf2")
    problem = build_problem(scene, build_initial_state(scene), "inertial")
    assert candidate._scene.integrator is scene.integrator
    np.testing.assert_array_equal(candidate._problem.initial_guess, problem.initial_guess)
    # The first step of BDF2 is one of implicit Euler, of another system than the scene's.
    candidate.prepare()
    candidate._solve_step()
    solution = CompiledLocalGlobal().prepare(problem.system).solve(problem, StopRule(4))
    assert candidate._positions == pytest.approx(solution.positions, rel=1e-9, abs=1e-12)


def _catch_candidates(runs: list[RunSpec], folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    caught: list[Any] = []

    def catch(candidates: list[Any], *rest: Any) -> list[Any]:
        caught.extend(candidates)
        return []

    monkeypatch.setattr(roofline_comparison, "measure_round_robin", catch)
    roofline_comparison._measure_rows(runs, folder, {}, 1.0, lambda phase: None)
    return caught


def test_runs_that_take_different_steps_are_refused(tmp_path: Path):
    (tmp_path / "two.yaml").write_text(
        SWEEP.replace("max_iterations: 4", "max_iterations: 4, integrator: [implicit-euler, bdf2]")
    )
    (tmp_path / SCENE.name).write_bytes(SCENE.read_bytes())
    with pytest.raises(InputError, match="integrator: got implicit-euler, bdf2 for yardstick-cloth 4; expected one"):
        run_roofline(load_sweep(tmp_path / "two.yaml"), tmp_path / "out", SilentDisplay(), print)


def test_a_folder_admits_one_report_at_a_time(sweep, tmp_path: Path):
    (tmp_path / "out" / "rows").mkdir(parents=True)
    with lock_folder_exclusive(tmp_path / "out"), pytest.raises(InputError, match="another springbench"):
        run_roofline(sweep, tmp_path / "out", SilentDisplay(), print)


def test_a_report_is_complete_and_done_once(sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    said: list[str] = []
    display = SilentDisplay()

    def run_report() -> pa.Table:
        return run_roofline(sweep, tmp_path / "out", display, said.append, isolated=False)

    table = run_report()
    titles = [f"yardstick-cloth {size}: 5 candidates interleaved" for size in (4, 5)]
    assert (display.titles, said) == (titles, [])
    found = compute_speed_figures(table)
    assert [(f.size, f.label, f.status) for f in found] == [
        (size, label, status)
        for size in (4, 5)
        for label, status in (
            ("dense", "ok"),
            ("sparse", "ok"),
            ("eigen default", "unsupported"),
            ("eigen cheap", "unsupported"),
        )
    ]
    assert "there is no C++ compiler" in (found[2].reason or "")
    assert all(f.roofline_fraction and f.local and f.global_ and f.step and f.warm for f in found if f.status == "ok")
    assert build_speed_table(found).row_count == len(found)
    assert sum("there is no C++ compiler" in line and line.endswith("(at 4, 5)") for line in describe_speed(found)) == 2
    # What is there is not measured again.
    assert run_report().equals(table)
    assert (display.titles, said) == (titles, ["2 of 2 sizes are there already"])
    # What other code measured is shown, and said to be so.
    monkeypatch.setattr(machine_info, "hash_sources", lambda: "another")
    run_report()
    assert said[2] == f"2 of them by other code than today's: {', '.join(titles)}"
    assert all((tmp_path / "out" / "rows").glob("*.parquet"))


def test_a_time_that_another_clock_contradicts_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def busy() -> None:
        began = thread_time()
        while thread_time() - began < 0.005:
            pass

    def measure_busy_calls() -> tuple[list[dict[str, Any]], float]:
        calls = benchmark_candidates.RepeatedCall(busy)
        found = compute_call_seconds(calls)
        return [{"preempted": calls.preempted}], found

    assert measure_busy_calls()[1] >= 0.005
    monkeypatch.setattr(benchmark_candidates, "perf_counter", lambda: perf_counter() / 1000)
    with pytest.raises(RunFailed, match="the times of calls add up to"):
        retry_if_preempted(measure_busy_calls)

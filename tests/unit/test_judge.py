"""The judge: what is stationary, what is a minimum, how far a motion is from the reference; and failures kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from harness.base import rows
from harness.base.errors import InputError
from harness.config.load import load_any
from harness.experiments.plan import Files
from harness.experiments.run import execute
from harness.record.reader import read_replay
from harness.reference.curvature import curvature
from harness.reference.judge import Judge, is_minimum, reference
from harness.reference.oracle import Oracle
from harness.report.robustness import (
    DISPUTED,
    DIVERGED,
    OTHER,
    REFUSED,
    RIGHT,
    SADDLE,
    SHORT,
    VALLEY,
    WRONG,
    Judged,
    judged,
    read_cells,
    scores,
    summary,
)
from harness.report.robustness_map import draw_map, headline
from harness.scenes.bind import Scene
from harness.scenes.effects.gravity import Gravity
from harness.scenes.mesh.chain import Chain
from harness.simulation.step import simulate
from solvers.methods.local_global import SparseLocalGlobal
from solvers.methods.newton import Newton
from solvers.problem import Positions, StepProblem, StopRule
from solvers.round_off import EPS
from tests.scenes import cloth, first_problem, random_problem, scene


def stated() -> StepProblem:
    return random_problem(3)


def solved(problem: StepProblem, iterations: int = 200) -> Positions:
    return Newton().prepare(problem.system).solve(problem, StopRule(iterations)).positions


def test_the_residual_is_the_length_of_a_local_global_step():
    problem = stated()
    p = problem.first_guess.copy()
    exact = problem.system.pins.vertices[problem.system.pins.exact]
    p[exact] = problem.pin_targets[problem.system.pins.exact]
    step = SparseLocalGlobal().prepare(problem.system).solve(replace(problem, first_guess=p), StopRule(1, 1e-30))
    # Both are |p - LG(p)|_Q, of two factors of one matrix of condition below 1e5.
    np.testing.assert_allclose(Oracle(problem.system).residual(problem, p), step.residual, rtol=1e-10)


def test_a_heavy_pin_does_not_blind_the_stationarity():
    problem = first_problem(cloth(5, 1e16))
    oracle = Oracle(problem.system)
    assert oracle.stationarity(problem, problem.current)[0] == 1.0
    assert oracle.stationarity(problem, solved(problem))[0] < 1e-6
    moved = solved(problem)
    moved[12] += 1e-3  # a millimetre at a free vertex
    assert oracle.stationarity(problem, moved)[0] > 1e-3


def test_a_stretched_spring_is_a_minimum_and_a_compressed_one_is_not():
    made = cloth(3)
    problem = replace(first_problem(made), system=replace(made.system, time_step=10.0))
    assert is_minimum(problem, 1.1 * made.mesh.rest)
    assert not is_minimum(problem, 0.5 * made.mesh.rest)  # each spring would rather turn aside


def walked(made: Scene, judge: Judge, tolerance: float) -> list[dict]:
    prepared = Newton().prepare(made.system)
    steps = simulate(made, prepared, StopRule(200, tolerance), first_guess="current", frames=4)
    return [judge(step) for step in steps]


def test_the_doubt_of_a_curvature_is_four_roundings_of_its_sums():
    """Without springs the Hessian is m/dt^2: exact, the same everywhere, and so is |x|'|H||x|."""
    stated = first_problem(scene(Chain(), Gravity(), size=2, mass=6.0, time_step=0.1))
    found = curvature(stated, stated.current)
    np.testing.assert_allclose(found.smallest, 3.0 / 0.1**2, rtol=1e-12)
    np.testing.assert_allclose(found.doubt, 4.0 * EPS * 3.0 / 0.1**2, rtol=1e-9)


def test_a_converged_run_is_stationary_and_where_the_reference_is():
    made = cloth(4)
    known = reference(made, Newton(), first_guess="current", frames=4)
    assert np.isfinite(known).all()
    for row in walked(made, Judge(made, known, minimises=True), 1e-8):
        assert row["stationarity"] <= 1.1e-8
        assert row["minimum"]
        assert row["distance"] < 1e-6  # errors of 1e-8 of a step's motion, and what four steps make of them
    assert {"distance"} == set(walked(made, Judge(made, known, minimises=False), 1e-2)[0])


def test_a_reference_that_is_lost_is_no_reference():
    made = cloth(4)
    known = np.full((4, 16, 3), np.nan)
    assert walked(made, Judge(made, known, minimises=True), 1e-8)[2]["distance"] is None


OK = {"status": "ok", "frame": 1, "stationarity": 1e-7, "attainable": 1e-12, "beyond": 1e-7, "tolerance": 1e-6}
OK |= {"minimum": True, "flat": False, "distance": 1e-5, "stopped": "tolerance", "reason": None}
GRADES = {
    "right": ([OK, OK], RIGHT),
    "at round-off": ([OK | {"stationarity": 1e-3, "attainable": 1e-3, "beyond": 0.0}], RIGHT),
    "where the round-off of another part would hide it": ([OK | {"attainable": 1.0, "beyond": 1e-3}], WRONG),
    "in a valley": ([OK, OK | {"minimum": False, "flat": True}], VALLEY),
    "in a valley, and at a saddle": ([OK | {"minimum": False}, OK | {"minimum": False, "flat": True}], SADDLE),
    "no reference": ([OK | {"distance": None}], OTHER),
    "a reference that is lost": ([OK, OK | {"distance": None}], OTHER),
    "one step short": ([OK, OK | {"beyond": 2e-6, "stopped": "iterations"}], SHORT),
    "stuck": ([OK | {"beyond": 2e-6, "stopped": "stalled"}, OK], SHORT),
    "not a number": ([OK | {"beyond": float("nan"), "stopped": "iterations"}], SHORT),
    "short, and said not to be": ([OK, OK | {"beyond": 2e-6}, OK | {"minimum": False}], WRONG),
    "at round-off, and not": ([OK | {"beyond": 1e-2, "stopped": "floor"}], WRONG),
    "no tolerance asked": ([OK | {"tolerance": None}], RIGHT),
    "elsewhere": ([OK, OK | {"distance": 0.5}], OTHER),
    "a saddle": ([OK | {"minimum": False}], SADDLE),
    "a motion that is close": ([OK | {"stationarity": None, "distance": 0.04}], RIGHT),
    "a motion that is not": ([OK | {"stationarity": None, "distance": 0.06}], SHORT),
    "a motion that is close while there is a reference": (
        [OK | {"stationarity": None}, OK | {"stationarity": None, "distance": None}],
        SHORT,
    ),
    "a motion without a reference": ([OK | {"stationarity": None, "distance": None}], SHORT),
    "diverged": ([OK | {"status": "diverged", "reason": "not finite"}], DIVERGED),
    "disputed": ([OK | {"status": "disputed", "reason": "the second opinion disagrees: forces"}], DISPUTED),
    "refused": ([OK | {"status": "unsupported", "frame": None, "reason": "no mass"}], REFUSED),
}


@pytest.mark.parametrize("name", GRADES)
def test_a_run_is_graded_by_its_rows(name: str):
    run, outcome = GRADES[name]
    assert judged(run)[0] is outcome


FIGURES = {1e-6: "1e-6", 3.2e2: "1e3", 0.0: "0", float("inf"): "inf", float("nan"): "nan"}


@pytest.mark.parametrize("worst", FIGURES)
def test_a_residual_is_shown_as_a_power_of_ten(worst: float):
    assert Judged("a", "b", SHORT, worst, "stationarity", "").figure == FIGURES[worst]


def test_a_solver_is_scored_by_the_cases_that_it_does_not_refuse():
    outcomes = {"a": [RIGHT, DIVERGED, REFUSED, SHORT], "b": [REFUSED, REFUSED]}
    worst = {RIGHT: 1e-7, SHORT: 1e-2}
    cells = [
        Judged(f"case-{k}", solver, outcome, worst.get(outcome), "stationarity", "")
        for solver, own in outcomes.items()
        for k, outcome in enumerate(own)
    ]
    first, second = scores(cells)
    assert (first.right, first.finite, first.worst.worst) == (pytest.approx(1 / 3), pytest.approx(2 / 3), 1e-2)
    assert (second.right, second.finite, second.worst.worst) == (None, None, None)
    assert headline(cells, "hard") == "hard: 1 of 6 runs right, 0 silently wrong, 1 diverged or failed"


SCENE = "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 3\ndefault_size: 3\n"
SCENE += "effects: [{kind: gravity}, {kind: springs, stretch: 10}, {kind: pins, at: [first]}]\n"
SWEEP = "scenes: [scene.yaml]\nsolvers: [newton, xpbd, {name: numba, precision: float32}, numba]\n"
SWEEP += "options: {tolerance: 1e-6, rounds: 1, judge: true, pictures: false, record: %s}\n"


def test_a_judged_sweep_becomes_a_map_whose_cells_name_their_runs(tmp_path: Path):
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "sweep.yaml").write_text(SWEEP % "true")
    for spec in load_any(tmp_path / "sweep.yaml").runs():
        files = Files.of(spec, tmp_path)
        files.rows.parent.mkdir(exist_ok=True)
        execute(spec, files, lambda phase: None)
    cells = read_cells(tmp_path)
    assert [cell.solver for cell in cells] == ["numba float32", "numba float64", "newton", "xpbd"]
    newton = next(cell for cell in cells if cell.solver == "newton")
    assert newton.outcome is RIGHT
    assert newton.worst is not None
    assert newton.worst < 1.1e-6
    assert summary(cells).row_count == 4
    assert newton.run_id
    assert next((tmp_path / "recordings").glob(f"*-{newton.run_id}.rrd"))
    draw_map(cells, tmp_path / "map.png", "a map")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_results_that_were_not_judged_are_refused(tmp_path: Path):
    (tmp_path / "rows").mkdir()
    row = {"run_id": "x", "scene": "net", "size": 4, "solver": "sparse", "started": "2026", "phase": "step"}
    rows.write(tmp_path / "rows" / "x.parquet", [row | {"round": 0, "status": "ok"}])
    with pytest.raises(InputError, match="judge: true"):
        read_cells(tmp_path)


def test_runs_of_a_solver_from_outside_may_give_different_parameters(tmp_path: Path):
    (tmp_path / "rows").mkdir()
    base = {"scene": "net", "size": 4, "solver": "./own.py:Own", "started": "2026", "phase": "step", "round": 0}
    for run_id, given in (("x", "{}"), ("y", '{"momentum": 0.5}'), ("z", '{"momentum": 0.8}')):
        one = base | {"run_id": run_id, "parameters": given, "status": "ok", "distance": 0.0}
        rows.write(tmp_path / "rows" / f"{run_id}.parquet", [one])
    own = "./own.py:Own"
    assert [(cell.solver, cell.run_id) for cell in read_cells(tmp_path)] == [
        (own, "x"),
        (f"{own} 0.5", "y"),
        (f"{own} 0.8", "z"),
    ]


def test_a_run_that_fails_keeps_and_marks_its_recording_up_to_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "scene.yaml").write_text(SCENE)
    (spec,) = load_any(tmp_path / "scene.yaml", solvers=["sparse"]).runs()
    files = Files.of(spec, tmp_path)
    files.rows.parent.mkdir()
    before = execute(spec, files, lambda phase: None)
    assert before[0]["status"] == "ok"
    assert read_replay(files.recording).properties["status"] == "ok"

    def burst(scene, prepared, stop, *, first_guess, frames):
        for step in simulate(scene, prepared, stop, first_guess=first_guess, frames=frames):
            if step.index == 3:
                step.positions[1] = np.inf
            yield step

    monkeypatch.setattr("harness.simulation.measure.simulate", burst)
    (row,) = execute(spec, files, lambda phase: None)
    assert (row["status"], row["frame"]) == ("diverged", 3)
    assert "not finite" in row["reason"]
    replay = read_replay(files.recording)
    assert replay.frames.tolist() == [0, 1, 2]
    assert replay.properties["status"] == "diverged"
    assert replay.properties["failed_frame"] == 3

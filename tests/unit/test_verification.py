"""The verifier: what is stationary, what is a minimum, how far a motion is from the reference; and failures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.errors import InputError
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.reference.hessian_curvature import compute_curvature
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.harness.reference.step_verifier import StepVerifier, compute_reference_positions, is_minimum
from springbench.harness.report.charts.hard_case_chart import build_hard_case_chart
from springbench.harness.report.robustness import (
    CORRECT,
    DEGENERATE_MINIMUM,
    DIVERGED,
    NOT_CONVERGED,
    SADDLE_POINT,
    SILENTLY_WRONG,
    UNSUPPORTED,
    WRONG_GRADIENT,
    VerifiedRun,
    build_map_headline,
    build_score_table,
    classify_run,
    read_verified_runs,
    score_solvers,
)
from springbench.harness.report.sweep_sheets import draw_hard_case_sheets
from springbench.harness.results import parquet_rows
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem, build_test_scene


def build_random_step() -> StepProblem:
    return build_random_problem(3)


def solve_newton(problem: StepProblem, iterations: int = 200) -> Positions:
    return NewtonSolver().prepare(problem.system).solve(problem, StopRule(iterations)).positions


def test_the_residual_is_the_length_of_a_local_global_step():
    problem = build_random_step()
    p = problem.initial_guess.copy()
    exact = problem.system.pins.vertices[problem.system.pins.exact_mask]
    p[exact] = problem.pin_targets[problem.system.pins.exact_mask]
    step = SparseLocalGlobal().prepare(problem.system).solve(replace(problem, initial_guess=p), StopRule(1, 1e-30))
    # Both are |p - LG(p)|_Q, of two factors of one matrix of condition below 1e5.
    np.testing.assert_allclose(
        ReferenceEvaluator(problem.system).compute_residual(problem, p), step.residual, rtol=1e-10
    )


def test_a_heavy_pin_does_not_blind_the_stationarity():
    problem = build_first_problem(build_cloth(5, 1e16))
    oracle = ReferenceEvaluator(problem.system)
    assert oracle.measure_stationarity(problem, problem.current_positions)[0] == 1.0
    assert oracle.measure_stationarity(problem, solve_newton(problem))[0] < 1e-6
    moved = solve_newton(problem)
    moved[12] += 1e-3  # a millimetre at a free vertex
    assert oracle.measure_stationarity(problem, moved)[0] > 1e-3


def test_a_stretched_spring_is_a_minimum_and_a_compressed_one_is_not():
    made = build_cloth(3)
    problem = replace(build_first_problem(made), system=replace(made.system, time_step=10.0))
    assert is_minimum(problem, 1.1 * made.mesh.rest_positions)
    assert not is_minimum(problem, 0.5 * made.mesh.rest_positions)  # each spring would rather turn aside


def verify_steps(made: Scene, judge: StepVerifier, tolerance: float) -> list[dict]:
    prepared = NewtonSolver().prepare(made.system)
    steps = simulate_scene(made, prepared, StopRule(200, tolerance), initial_guess="previous", frames=4)
    return [judge(step) for step in steps]


def test_the_uncertainty_of_a_curvature_is_four_roundings_of_its_sums():
    """Without springs the Hessian is m/dt^2: exact, the same everywhere, and so is |x|'|H||x|."""
    stated = build_first_problem(build_test_scene(ChainMesh(), GravityEffect(), size=2, mass=6.0, time_step=0.1))
    found = compute_curvature(stated, stated.current_positions)
    np.testing.assert_allclose(found.min_eigenvalue, 3.0 / 0.1**2, rtol=1e-12)
    np.testing.assert_allclose(found.eigenvalue_uncertainty, 4.0 * EPS * 3.0 / 0.1**2, rtol=1e-9)


def test_a_converged_run_is_stationary_and_where_the_reference_is():
    made = build_cloth(4)
    known = compute_reference_positions(made, NewtonSolver(), initial_guess="previous", frames=4)
    assert np.isfinite(known).all()
    for row in verify_steps(made, StepVerifier(made, known, is_minimiser=True), 1e-8):
        assert row["stationarity"] <= 1.1e-8
        assert row["is_local_minimum"]
        assert row["reference_distance"] < 1e-6  # errors of 1e-8 of a step's motion, and what four steps make of them
    assert {"reference_distance"} == set(verify_steps(made, StepVerifier(made, known, is_minimiser=False), 1e-2)[0])


def test_a_reference_that_is_lost_is_no_reference():
    made = build_cloth(4)
    known = np.full((4, 16, 3), np.nan)
    assert verify_steps(made, StepVerifier(made, known, is_minimiser=True), 1e-8)[2]["reference_distance"] is None


OK = {
    "status": "ok",
    "frame": 1,
    "stationarity": 1e-7,
    "stationarity_roundoff_bound": 1e-12,
    "stationarity_above_roundoff": 1e-7,
    "residual_rtol": 1e-6,
}
OK |= {
    "is_local_minimum": True,
    "is_degenerate": False,
    "reference_distance": 1e-5,
    "termination_reason": "converged",
    "reason": None,
}
GRADES = {
    "right": ([OK, OK], CORRECT),
    "at round-off": (
        [OK | {"stationarity": 1e-3, "stationarity_roundoff_bound": 1e-3, "stationarity_above_roundoff": 0.0}],
        CORRECT,
    ),
    "where the round-off of another part would hide it": (
        [OK | {"stationarity_roundoff_bound": 1.0, "stationarity_above_roundoff": 1e-3}],
        SILENTLY_WRONG,
    ),
    "degenerate": ([OK, OK | {"is_local_minimum": False, "is_degenerate": True}], DEGENERATE_MINIMUM),
    "degenerate, and at a saddle": (
        [OK | {"is_local_minimum": False}, OK | {"is_local_minimum": False, "is_degenerate": True}],
        SADDLE_POINT,
    ),
    "no reference": ([OK | {"reference_distance": None}], CORRECT),
    "a reference that is lost": ([OK, OK | {"reference_distance": None}], CORRECT),
    "one step short": (
        [OK, OK | {"stationarity_above_roundoff": 2e-6, "termination_reason": "max-iter"}],
        NOT_CONVERGED,
    ),
    "stuck": ([OK | {"stationarity_above_roundoff": 2e-6, "termination_reason": "stalled"}, OK], NOT_CONVERGED),
    "not a number": (
        [OK | {"stationarity_above_roundoff": float("nan"), "termination_reason": "max-iter"}],
        NOT_CONVERGED,
    ),
    "short, and said not to be": (
        [OK, OK | {"stationarity_above_roundoff": 2e-6}, OK | {"is_local_minimum": False}],
        SILENTLY_WRONG,
    ),
    "at round-off, and not": (
        [OK | {"stationarity_above_roundoff": 1e-2, "termination_reason": "roundoff"}],
        SILENTLY_WRONG,
    ),
    "no tolerance asked": ([OK | {"residual_rtol": None}], CORRECT),
    "elsewhere": ([OK, OK | {"reference_distance": 0.5}], CORRECT),
    "a saddle": ([OK | {"is_local_minimum": False}], SADDLE_POINT),
    "a motion that is close": ([OK | {"stationarity": None, "reference_distance": 0.04}], CORRECT),
    "a motion that is not": ([OK | {"stationarity": None, "reference_distance": 0.06}], NOT_CONVERGED),
    "a motion that is close while there is a reference": (
        [OK | {"stationarity": None}, OK | {"stationarity": None, "reference_distance": None}],
        NOT_CONVERGED,
    ),
    "a motion without a reference": ([OK | {"stationarity": None, "reference_distance": None}], NOT_CONVERGED),
    "diverged": ([OK | {"status": "diverged", "reason": "not finite"}], DIVERGED),
    "wrong gradient": ([OK | {"status": "wrong-gradient", "reason": "a gradient differs"}], WRONG_GRADIENT),
    "refused": ([OK | {"status": "unsupported", "frame": None, "reason": "no mass"}], UNSUPPORTED),
}


@pytest.mark.parametrize("name", GRADES)
def test_a_run_is_graded_by_its_rows(name: str):
    run, outcome = GRADES[name]
    assert classify_run(run)[0] is outcome


FIGURES = {1e-6: "1e-6", 3.2e2: "1e3", 0.0: "0", float("inf"): "inf", float("nan"): "nan"}


@pytest.mark.parametrize("worst", FIGURES)
def test_a_residual_is_shown_as_a_power_of_ten(worst: float):
    assert VerifiedRun("a", "b", NOT_CONVERGED, worst, "stationarity", "").error_text == FIGURES[worst]


def test_a_solver_is_scored_by_the_cases_that_it_does_not_refuse():
    outcomes = {"a": [CORRECT, DIVERGED, UNSUPPORTED, NOT_CONVERGED], "b": [UNSUPPORTED, UNSUPPORTED]}
    worst = {CORRECT: 1e-7, NOT_CONVERGED: 1e-2}
    cells = [
        VerifiedRun(f"case-{k}", solver, outcome, worst.get(outcome), "stationarity", "")
        for solver, own in outcomes.items()
        for k, outcome in enumerate(own)
    ]
    first, second = score_solvers(cells)
    assert (first.correct_share, first.finite_share, first.worst_run.worst_error) == (
        pytest.approx(1 / 3),
        pytest.approx(2 / 3),
        1e-2,
    )
    assert (second.correct_share, second.finite_share, second.worst_run.worst_error) == (None, None, None)
    assert build_map_headline(cells, "hard") == "hard: 1 of 6 runs right, 0 silently wrong, 1 diverged or failed"


def test_runs_that_end_at_other_minima_are_right_counted_and_marked():
    step = OK | {"reference_distance": 0.5}
    verdict = classify_run([step])
    assert verdict.reason == "certified minima, by another motion: up to 50 % of the size from the reference"
    other = VerifiedRun("a", "b", *verdict, energy_excess=1e-3)
    same = VerifiedRun("c", "b", *classify_run([OK]), energy_excess=0.0)
    unknown = VerifiedRun("d", "b", *classify_run([OK | {"reference_distance": None}]), energy_excess=1e-12)
    cells = [cell for one in build_hard_case_chart([other, same, unknown]).maps for cell in one.cells]
    assert [cell.marked_text for cell in cells] == ["1e-7 \u2248", "1e-7", "1e-7"]
    (score,) = score_solvers([other, same, unknown])
    assert (score.correct_share, score.other_motion_count, score.lowest_energy_count) == (1.0, 1, 2)


SCENE = "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 3\ndefault_size: 3\n"
SCENE += "effects: [{kind: gravity}, {kind: springs, stretch: 10}, {kind: pins, parts: [first]}]\n"
SWEEP = "scenes: [scene.yaml]\nsolvers: [newton, xpbd, {name: numba, precision: float32}, numba]\n"
SWEEP += "options: {rtol: 1e-6, rounds: 1, verify: true, pictures: false, record: %s}\n"


def test_a_verified_sweep_becomes_a_map_whose_cells_name_their_runs(tmp_path: Path):
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "sweep.yaml").write_text(SWEEP % "true")
    for spec in load_config(tmp_path / "sweep.yaml").list_runs():
        files = RunFiles.for_run(spec, tmp_path)
        files.rows_path.parent.mkdir(exist_ok=True)
        execute_run(spec, files, lambda phase: None)
    cells = read_verified_runs(tmp_path)
    assert [cell.solver for cell in cells] == ["numba float32", "numba float64", "newton", "xpbd"]
    newton = next(cell for cell in cells if cell.solver == "newton")
    assert newton.outcome is CORRECT
    assert newton.worst_error is not None
    assert newton.worst_error < 1.1e-6
    assert newton.same_motion
    assert newton.has_lowest_energy
    assert [cell.energy_excess is None for cell in cells] == [False, False, False, True], "XPBD minimises nothing"
    assert build_score_table(cells).row_count == 4
    assert newton.run_id
    assert next((tmp_path / "recordings").glob(f"*-{newton.run_id}.rrd"))
    ((picture, drawn),) = draw_hard_case_sheets(tmp_path, lambda folder: ())
    assert drawn == cells
    assert picture == tmp_path / "pictures" / "robustness.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_results_that_were_not_verified_are_refused(tmp_path: Path):
    (tmp_path / "rows").mkdir()
    row = {"run_id": "x", "scene": "net", "size": 4, "solver": "sparse", "started_at": "2026", "phase": "step"}
    parquet_rows.write_rows(tmp_path / "rows" / "x.parquet", [row | {"round": 0, "status": "ok"}])
    with pytest.raises(InputError, match="verify: true"):
        read_verified_runs(tmp_path)


def test_runs_of_a_solver_from_outside_may_give_different_parameters(tmp_path: Path):
    (tmp_path / "rows").mkdir()
    base = {"scene": "net", "size": 4, "solver": "./own.py:Own", "started_at": "2026", "phase": "step", "round": 0}
    for run_id, given in (("x", "{}"), ("y", '{"momentum": 0.5}'), ("z", '{"momentum": 0.8}')):
        one = base | {"run_id": run_id, "parameters": given, "status": "ok", "reference_distance": 0.0}
        parquet_rows.write_rows(tmp_path / "rows" / f"{run_id}.parquet", [one])
    own = "./own.py:Own"
    assert [(cell.solver, cell.run_id) for cell in read_verified_runs(tmp_path)] == [
        (own, "x"),
        (f"{own} 0.5", "y"),
        (f"{own} 0.8", "z"),
    ]


def test_a_run_that_fails_retains_and_marks_its_recording_up_to_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "scene.yaml").write_text(SCENE)
    (spec,) = load_config(tmp_path / "scene.yaml", solvers=["sparse"]).list_runs()
    files = RunFiles.for_run(spec, tmp_path)
    files.rows_path.parent.mkdir()
    before = execute_run(spec, files, lambda phase: None)
    assert before[0]["status"] == "ok"
    assert read_replay(files.recording_path).properties["status"] == "ok"

    def burst(scene, prepared, stop, *, initial_guess, frames):
        for step in simulate_scene(scene, prepared, stop, initial_guess=initial_guess, frames=frames):
            if step.index == 3:
                step.positions[1] = np.inf
            yield step

    monkeypatch.setattr("springbench.harness.simulation.timing_pass.simulate_scene", burst)
    (row,) = execute_run(spec, files, lambda phase: None)
    assert (row["status"], row["frame"]) == ("diverged", 3)
    assert "not finite" in row["reason"]
    replay = read_replay(files.recording_path)
    assert replay.frames.tolist() == [0, 1, 2]
    assert replay.properties["status"] == "diverged"
    assert replay.properties["failed_frame"] == 3

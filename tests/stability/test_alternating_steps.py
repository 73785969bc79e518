"""Scenes whose steps differ in length, every second one: each is a step of its length from where the last one ended."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.recording.recording_reader import read_replay, summarise_recording
from springbench.harness.reference.step_verifier import StepVerifier
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import build_initial_state, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.time_stepping.symplectic_euler import PreparedSymplecticEuler, SymplecticEuler
from springbench.solvers.model.step_problem import StopRule, Unsupported
from springbench.solvers.registry import SOLVERS, load_target
from typer.testing import CliRunner

FILE = Path(__file__).resolve().parents[2] / "configs" / "hard" / "motion-alternating-steps.yaml"
LENGTHS = (1 / 3, 1 / 300)
FRAMES, STOP = 6, StopRule(30, 1e-6)


def build_alternating_scene(integrator: str = "implicit-euler") -> Scene:
    return build_scene(load_scene(FILE), 6, integrator)


@pytest.mark.parametrize("name", SOLVERS)
def test_each_step_is_one_of_its_length_from_where_the_last_one_ended(name: str):
    scene, solver = build_alternating_scene(), load_target(SOLVERS[name])()
    assert scene.alternate_scene is not None
    alone = [solver.prepare(part.system) for part in (scene, scene.alternate_scene)]
    state, time = build_initial_state(scene), 0.0  # added up here, multiplied there: some eps apart
    for step in simulate_scene(scene, prepare(scene, solver), STOP, initial_guess="previous", frames=FRAMES):
        dt, begun = LENGTHS[state.index % 2], step.problem.step_start
        assert (step.problem.system.time_step, begun.time) == (dt, pytest.approx(time, rel=1e-15))
        np.testing.assert_array_equal(step.problem.inertial_target, state.motion.positions + dt * state.motion.velocity)
        np.testing.assert_allclose(step.problem.pin_targets, scene.compute_pin_targets(time + dt), rtol=0, atol=1e-15)
        solution = alone[state.index % 2].solve(step.problem, STOP)
        np.testing.assert_array_equal(step.solution.positions, solution.positions)
        state, time = step.state, time + dt
    assert scene.compute_time(FRAMES) == pytest.approx(time, rel=1e-15)


def test_midpoint_falls_exactly_as_a_stone_does_whatever_the_steps():
    given = {"mesh": ChainMesh(), "effects": (GravityEffect(),), "time_step": 0.1, "alternate_time_step": 0.003}
    scene = build_scene(SceneSpec(mass=1.0, frames=9, path=Path("scene.yaml"), **given), 3, "midpoint")
    *_, last = simulate_scene(scene, prepare(scene, NewtonSolver()), STOP, initial_guess="inertial", frames=9)
    assert scene.compute_time(9) == pytest.approx(0.512, rel=1e-15)
    # Nine roundings of a fall of 1.3 m.
    np.testing.assert_allclose(last.positions[:, 1], -0.5 * 9.81 * 0.512**2, rtol=1e-14)


def test_an_integrator_of_two_steps_of_one_length_is_refused():
    with pytest.raises(Unsupported, match="constant step size"):
        prepare(build_alternating_scene("bdf2"), NewtonSolver())


def test_each_step_is_verified_with_the_matrix_of_its_length():
    scene = build_alternating_scene("midpoint")
    judge = StepVerifier(scene, None, is_minimiser=True)
    for step in simulate_scene(
        scene, prepare(scene, NewtonSolver()), StopRule(100), initial_guess="previous", frames=FRAMES
    ):
        found = judge(step)
        assert found["stationarity_above_roundoff"] == 0.0


def test_a_run_is_recorded_by_its_own_clock(tmp_path: Path):
    (run,) = load_config(FILE, solvers=["sparse"], frames=4, rounds=1).list_runs()
    files = RunFiles.for_run(run, tmp_path)
    files.rows_path.parent.mkdir()
    rows = execute_run(run, files, lambda phase: None)
    assert {row["status"] for row in rows} == {"ok"}
    ends = np.array([0.0, LENGTHS[0], sum(LENGTHS), 2 * LENGTHS[0] + LENGTHS[1], 2 * sum(LENGTHS)])
    np.testing.assert_allclose(read_replay(files.recording_path).times, ends, rtol=0, atol=1e-9)  # nanoseconds
    with_time = [
        row for row in summarise_recording(files.recording_path).scalars.to_pylist() if row["time"] is not None
    ]
    assert {row["frame"] for row in with_time} == set(range(5))
    for row in with_time:
        assert row["time"] == pytest.approx(ends[row["frame"]], abs=1e-9)


def test_a_sweeps_own_time_step_is_that_of_all_steps():
    (run,) = load_config(FILE, solvers=["sparse"], time_step=0.1).list_runs()
    scene = build_scene(run.scene, run.size)
    assert scene.alternate_scene is None
    assert scene.compute_time(7) == 7 * 0.1


def test_runs_of_other_steps_have_another_name():
    spec = load_scene(FILE)
    assert (
        len(
            {
                spec.scene_digest,
                spec.with_time_step(1 / 300).scene_digest,
                spec.with_time_step(1 / 300).with_time_step(1 / 3).scene_digest,
            }
        )
        == 3
    )


@pytest.mark.parametrize("command", ["ablate", "recommend", "accuracy"])
def test_what_measures_at_one_time_step_refuses_two_by_the_key(command: str, tmp_path: Path):
    config, options = FILE, ["--error", "0.1"] if command == "recommend" else []
    if command == "accuracy":
        config = tmp_path / "config.yaml"
        config.write_text(f"scenes: [{FILE}]\nsolvers: [newton]\nwork: [{{t_end: 1, time_step: [0.1]}}]\n")
    answer = CliRunner().invoke(app, [command, str(config), "--results", str(tmp_path / "results"), *options])
    assert answer.exit_code == 2, (answer.output, answer.exception)
    assert f"{FILE}:7: alternate_time_step: " in answer.output.replace("\n", "")


def test_symplectic_euler_takes_the_substeps_that_each_length_requires():
    scene = build_alternating_scene()
    assert scene.alternate_scene is not None
    prepared = [SymplecticEuler().prepare(part.system) for part in (scene, scene.alternate_scene)]
    counts = [one.num_substeps for one in prepared if isinstance(one, PreparedSymplecticEuler)]
    assert len(counts) == 2
    assert counts[0] == pytest.approx(100 * counts[1], rel=0.5)
    assert counts[1] >= 1

"""Work: errors against the reference trajectory, wall times, and what a simulation that fails leaves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from springbench.harness.config.accuracy_config import BenchmarkCase, MeasurementSettings, WorkSpec
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.experiments.accuracy.accuracy_units import load_reference_trajectory
from springbench.harness.experiments.accuracy.work_precision import build_work_rows
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, UnpredictableMotion
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation import stopwatch as clock_module
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import StopRule

from tests.preemption_retry import retry_if_preempted

CHAIN = SceneSpec(
    mesh=ChainMesh(length=2.0),
    mass=1.0,
    time_step=1 / 30,
    frames=1,
    effects=(SpringsEffect(stretch=500.0), GravityEffect(), PinsEffect.model_validate({"parts": ["ends"]})),
    path=Path("chain.yaml"),
)
HORIZON = 0.2
UNIT = WorkSpec(
    BenchmarkCase("chain", CHAIN, 5, "implicit-euler"),
    HORIZON,
    SolverSpec("sparse", {}),
    {"initial_guess": "previous", "max_iterations": 20, "rtol": None},
    measurement=MeasurementSettings(threads=1, rounds=2, time_limit=60.0),
)


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> ReferenceTrajectory:
    found = load_reference_trajectory(UNIT, ReferenceStore(tmp_path_factory.mktemp("references")))
    assert isinstance(found, ReferenceTrajectory)
    return found


def row(unit: WorkSpec, trajectory: ReferenceTrajectory | Exception) -> dict[str, Any]:
    (found,) = build_work_rows(unit, trajectory, lambda: None)
    return found


def test_the_error_is_that_of_the_last_positions(trajectory: ReferenceTrajectory) -> None:
    found = row(UNIT, trajectory)
    scene = build_exact_scene(CHAIN, 5)
    run = simulate_scene(scene, prepare(scene, SparseLocalGlobal()), StopRule(20), initial_guess="previous", frames=6)
    p = [step.positions.copy() for step in run][-1]
    away, moved = p - trajectory.positions[-1], trajectory.positions[-1] - scene.mesh.rest_positions
    # The pinned vertices are in place in all three; what is left is round-off of sums.
    assert found["error"] == pytest.approx(np.linalg.norm(away) / np.linalg.norm(moved), rel=1e-12)
    assert found["end_error_rms_m"] == pytest.approx(np.linalg.norm(away) / 3**0.5, rel=1e-12)
    assert found["num_iterations"] == 6 * 20


def test_a_smaller_step_and_a_better_integrator_err_less(trajectory: ReferenceTrajectory) -> None:
    smaller = replace(UNIT, case=replace(UNIT.case, scene=CHAIN.with_time_step(1 / 120)))
    better = replace(UNIT, case=replace(UNIT.case, integrator="midpoint"))
    error = row(UNIT, trajectory)["error"]
    # First order: a quarter of the step leaves about a quarter; second order is better still at this step.
    assert row(smaller, trajectory)["error"] < 0.4 * error
    assert row(better, trajectory)["error"] < 0.4 * error


def test_each_round_has_a_time_and_their_median_is_the_cost(trajectory: ReferenceTrajectory) -> None:
    found = row(replace(UNIT, measurement=replace(UNIT.measurement, rounds=3)), trajectory)
    assert len(found["seconds"]) == 3
    assert isinstance(found["preempted"], bool)
    assert found["seconds_per_simulated_second"] == np.median(found["seconds"]) / HORIZON


def test_seconds_that_another_clock_contradicts_are_a_failure(
    trajectory: ReferenceTrajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clock_module, "perf_counter", lambda: perf_counter() / 1000)
    (found,), _ = retry_if_preempted(lambda: ([row(UNIT, trajectory)], None))
    assert (found["status"], "seconds" in found) == ("failed", False)
    assert "the times of step add up to" in found["reason"]


FAILURES = [
    ({"measurement": replace(UNIT.measurement, time_limit=1e-9)}, "time-limit", "was reached in frame"),
    ({"solver": SolverSpec("symplectic-euler", {}), "case": replace(UNIT.case, integrator="bdf2")}, "unsupported", ""),
]


@pytest.mark.parametrize(("change", "status", "reason"), FAILURES, ids=[status for _, status, _ in FAILURES])
def test_a_failure_is_a_status_with_a_reason(
    trajectory: ReferenceTrajectory, change: dict[str, Any], status: str, reason: str
) -> None:
    found = row(replace(UNIT, **change), trajectory)
    assert (found["status"], "error" in found) == (status, False)
    assert found["reason"]
    assert reason in found["reason"]


def test_an_error_below_the_reference_s_own_is_no_error(trajectory: ReferenceTrajectory) -> None:
    doubtful = replace(trajectory, growth=np.array([10.0]))
    found = row(UNIT, doubtful)
    assert (found["status"], "error" in found) == ("uncertified", False)
    assert found["seconds_per_simulated_second"] > 0.0, "the time is known"


def test_without_a_reference_nothing_is_simulated() -> None:
    found = row(UNIT, UnpredictableMotion("after 9 s a perturbation has grown"))
    assert (found["status"], found["reason"]) == ("uncertified", "after 9 s a perturbation has grown")
    assert "seconds" not in found

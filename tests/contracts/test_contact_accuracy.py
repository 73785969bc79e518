"""Accuracy where there is contact: one model at all time steps, its self-converged reference, and its horizon."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.accuracy_loader import load_accuracy
from springbench.harness.config.config_loader import load_scene
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.accuracy.method_recommendation import RecommendationOptions, recommend_method
from springbench.harness.experiments.accuracy.recommendation_goal import RecommendationGoal
from springbench.harness.reference import reference_store
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.self_converged_trajectory import (
    CONTACT_MARGIN,
    LIMIT_INTEGRATORS,
    NotConverged,
)
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.results import parquet_rows
from springbench.harness.results.run_schema import RUN_SCHEMA
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.solvers.contact.contact_potential import ObstacleContact
from springbench.solvers.contact.obstacle_mesh import ObstacleCollisionMesh
from typer.testing import CliRunner

from tests.progress_displays import SilentDisplay

CONFIGS = Path(__file__).parents[2] / "configs"
DROP = """
mesh: {kind: chain}
mass: 0.3
time_step: 1/60
frames: 12
default_size: 3
effects:
  - {kind: springs, stretch: 40}
  - {kind: gravity}
  - {kind: ether-drag, decay_rate: 4.0}
  - {kind: surface-contact, min_distance: 0.05, obstacles: [{kind: plane, point: [0, -0.15, 0]}]}
"""


@pytest.fixture
def drop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three vertices that fall on a floor, and little time for their reference."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "drop.yaml"
    path.write_text(DROP)
    return path


def find_barrier_stiffness(spec: SceneSpec) -> float:
    energies = build_exact_scene(spec, 3, "bdf2").system.energies
    (mesh,) = (one.collision_mesh for one in energies if isinstance(one, ObstacleContact))
    assert isinstance(mesh, ObstacleCollisionMesh)
    return float(np.max(mesh.stiffness))


def test_a_barrier_retains_its_default_stiffness_at_other_time_steps(drop: Path) -> None:
    spec = load_scene(drop)
    finer = spec.with_time_step(1 / 480)
    assert find_barrier_stiffness(finer) == find_barrier_stiffness(spec)
    assert finer.with_time_step(1 / 60).scene_digest == spec.scene_digest
    drop.write_text(DROP.replace("1/60", "1/480"))
    assert find_barrier_stiffness(load_scene(drop)) > 10.0 * find_barrier_stiffness(spec)
    assert load_scene(drop).scene_digest != finer.scene_digest


@pytest.mark.slow
def test_the_horizon_is_the_longest_time_at_which_an_error_can_be_measured(
    drop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference_store, "MAX_SECONDS", 20.0)
    spec, store = load_scene(drop), ReferenceStore(tmp_path / "references")
    found, reason = store.load_contact_horizon(spec, 3, 0.2, error=0.5)
    assert 0.0 < found.times[-1] <= 0.2
    assert bool(reason) == (found.times[-1] < 0.2)
    assert found.get_error_bound(-1) <= CONTACT_MARGIN * 0.5
    monkeypatch.setattr(reference_store, "compute_self_converged", None)
    again = store.load_trajectory(spec, 3, found.times.tolist(), error=0.5)
    assert (again.positions == found.positions).all()


def test_an_error_that_cannot_be_measured_is_a_mistake_of_the_user(
    drop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference_store, "MAX_SECONDS", 0.6)
    with pytest.raises(
        NotConverged, match=r"self-converged motion is accurate to|two motions of solved steps"
    ) as refused:
        ReferenceStore(tmp_path).require_contact_horizon(load_scene(drop), 3, 0.2, error=1e-9)
    assert refused.value.exit_code == 2


@pytest.mark.long
def test_a_run_to_an_error_meets_it_relative_to_the_reference_whose_bound_counts(drop: Path, tmp_path: Path) -> None:
    answer = CliRunner().invoke(app, ["run", "drop.yaml", "--error", "0.05", "--verify"])
    assert answer.exit_code == 0, answer.output
    rows = parquet_rows.read_rows((tmp_path / "results" / "drop" / "accuracy").glob("*.parquet"), ACCURACY_SCHEMA)
    (row,) = (row for row in rows.to_pylist() if row["kind"] == "error-control")
    assert row["reference_kind"] == "self-converged"
    assert row["error"] < row["error"] + row["reference_error"] <= row["error_estimated"] * (1.0 + 1e-9) <= 0.05
    assert row["integrator"] in LIMIT_INTEGRATORS


@pytest.mark.long
def test_a_sweep_to_an_error_measures_it_by_the_reference_and_refuses_what_cannot_be_measured(
    drop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference_store, "MAX_SECONDS", 10.0)
    options = "options: {error_target: [0.05, 1e-8], frames: 12, record: false, pictures: false}"
    (drop.parent / "sweep.yaml").write_text(f"scenes: [drop.yaml]\nsolvers: [newton]\n{options}\n")
    answer = CliRunner().invoke(app, ["run", "sweep.yaml", "--in-process"])
    assert answer.exit_code == 1, "one of the runs failed"
    assert "an error of 1.0e-08 cannot be measured" in " ".join(answer.output.split())
    rows = parquet_rows.read_rows((tmp_path / "results" / "sweep" / "rows").glob("*.parquet"), RUN_SCHEMA).to_pylist()
    reached = [row for row in rows if row["error_requested"] == 0.05]
    assert {row["status"] for row in reached} == {"ok"}
    assert all(row["error_estimated"] <= 0.05 and row["integrator"] in LIMIT_INTEGRATORS for row in reached)
    (refused,) = (row for row in rows if row["error_requested"] == 1e-8)
    assert refused["status"] != "ok"
    assert "contact has no certified reference" in refused["reason"]


@pytest.mark.long
def test_the_recommended_method_meets_the_error_whatever_the_error_of_the_reference(drop: Path) -> None:
    lines, results = list[str](), drop.parent / "results"
    found = recommend_method(
        drop,
        RecommendationGoal(max_error=0.1),
        RecommendationOptions(size=None, t_end=None, time_limit=20.0, search_time=20.0),
        results,
        SilentDisplay(),
        lines.append,
    )
    assert found.checked_method.reference_kind == "self-converged"
    assert found.goal.max_error is not None
    assert found.checked_method.error <= found.goal.max_error < 0.1
    assert any("the reference has an error of up to" in line for line in lines)


@pytest.mark.long
@pytest.mark.parametrize("index", range(4))
def test_the_scenes_of_the_study_have_references_at_its_times(index: int, tmp_path: Path) -> None:
    plan = load_accuracy(CONFIGS / "contact-accuracy.yaml")
    spec = list({one.case.scene_name: one for one in plan.work}.values())[index]
    found = ReferenceStore(tmp_path).load_trajectory(spec.case.scene, spec.case.size, [spec.t_end], error=0.2)
    assert found.get_error_bound(-1) <= CONTACT_MARGIN * 0.2

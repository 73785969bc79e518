"""`run --error`: invalid requests, the files of a run, and its use of rows measured before."""

from __future__ import annotations

import re
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget
from springbench.harness.experiments.error_control.method_search import (
    compute_predictability_horizon,
    search_cheapest_method,
)
from springbench.harness.experiments.error_control.stored_trials import (
    build_trial_rows,
    format_problem_id,
    read_stored_trials,
    select_best_predicted,
)
from springbench.harness.experiments.error_control.third_party_integrators import THIRD_PARTY_INTEGRATORS
from springbench.harness.experiments.provenance import build_provenance_columns
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.results import parquet_rows
from springbench.harness.simulation.adaptive_stepping import StepObserver, Trajectory
from springbench.harness.simulation.substepping import AdaptiveSubstepper
from typer.testing import CliRunner

SCENES = Path(__file__).parents[2] / "configs" / "scenes"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--error", "2"), "--error: got 2; expected a number between 0 and 1"),
        (("--error", "nan"), "--error: got nan"),
        (("--error", "1e-3", "--t-end", "-1"), "--t-end: got -1; expected seconds above 0"),
        (("--error", "1e-3", "--solver", "newton"), "--solver: cannot be combined with --error"),
        (("--error", "1e-3", "--integrator", "bdf2"), "--integrator: cannot be combined with --error"),
        (("--t-end", "1"), "--t-end: applies only to a run with --error"),
        (("--verify",), "--verify: applies only to a run with --error"),
    ],
)
def test_an_impossible_request_is_the_users_mistake(options, message, tmp_path, capsys):
    given = ["run", str(SCENES / "chain.yaml"), "--results", str(tmp_path), *options]
    found = CliRunner().invoke(app, given)
    assert found.exit_code == 2
    assert message in " ".join((found.stderr + capsys.readouterr().err).split())


def rows_of(folder: Path, *options: str) -> list[dict[str, Any]]:
    """The rows that a run of a small chain to an error leaves."""
    given = ["run", str(SCENES / "chain.yaml"), "--size", "5", "--error", "1e-3", "--t-end", "0.2", *options]
    found = CliRunner().invoke(app, [*given, "--results", str(folder)])
    assert found.exit_code == 0, found.output
    return parquet_rows.read_rows((folder / "chain" / "accuracy").glob("*.parquet"), ACCURACY_SCHEMA).to_pylist()


def test_a_run_to_an_error_leaves_its_row_its_recording_and_its_positions(tmp_path):
    row, *tried = rows_of(tmp_path, "--verify", "--positions", str(tmp_path / "p.npz"))
    assert row["kind"] == "error-control"
    assert {"method"} == {one["kind"] for one in tried}
    assert all(one["predicted_seconds"] > 0.0 for one in tried)
    assert row["error"] <= row["error_estimated"] <= row["error_requested"] == 1e-3
    assert row["num_accepted_steps"] > 0
    assert read_replay(tmp_path / "chain" / row["recording_path"]).properties["prevents_self_intersection"] is False
    assert np.load(tmp_path / "p.npz")["positions"].shape == (6, 5, 3)


THROWN_CLOTH = """
mesh: {kind: grid}
mass: 1
time_step: 1/30
frames: 15
default_size: 6
velocity: [0, 0, 6]
effects:
  - {kind: springs, stretch: 500}
  - {kind: gravity}
  - {kind: air-drag, drag_law: quadratic, coefficient: 0.3}
  - {kind: pins, indices: [0, 5], weight: exact}
"""


@pytest.mark.long
@pytest.mark.parametrize("error", ["2e-2", "1e-2", "5e-3"])
def test_errors_in_quadratic_drag_are_reached_though_a_method_loses_its_order(error: str, tmp_path: Path):
    """Midpoint is of order 1 there, and another method has to take over from it."""
    (tmp_path / "net.yaml").write_text(THROWN_CLOTH)
    given = ["run", str(tmp_path / "net.yaml"), "--error", error, "--t-end", "0.5", "--verify"]
    found = CliRunner().invoke(app, [*given, "--results", str(tmp_path)])
    assert found.exit_code == 0, found.output
    row, *_ = parquet_rows.read_rows((tmp_path / "net" / "accuracy").glob("*.parquet"), ACCURACY_SCHEMA).to_pylist()
    assert row["error"] <= row["error_requested"] == float(error)


class Boosting(AdaptiveSubstepper):
    """Its positions are right, and its velocities three times those of the motion."""

    def integrate_motion(
        self, setting: float, *, cpu_limit: float = inf, observe: StepObserver | None = None
    ) -> Trajectory:
        found = super().integrate_motion(setting, cpu_limit=cpu_limit, observe=observe)
        return replace(found, velocities=3.0 * found.velocities)


def test_an_energy_gain_is_reported_in_the_row_and_the_exit_code(tmp_path, monkeypatch):
    few = [("substepping", SolverSpec("dormand-prince-8", {}))]
    module = "springbench.harness.experiments.error_control.candidate_methods"
    monkeypatch.setattr(f"{module}.list_candidate_methods", lambda: few)
    monkeypatch.setattr(f"{module}.AdaptiveSubstepper", Boosting)
    given = ["run", str(SCENES / "single-spring.yaml"), "--error", "1e-3", "--t-end", "0.5"]
    found = CliRunner().invoke(app, [*given, "--results", str(tmp_path)])
    assert found.exit_code == 1, found.output
    said = "energy has grown .* without a source, from frame 1 on: dormand-prince-8 does not follow the motion"
    folder = tmp_path / "single-spring"
    rows = parquet_rows.read_rows((folder / "accuracy").glob("*.parquet"), ACCURACY_SCHEMA).to_pylist()
    assert rows[0]["status"] == "energy-growth"
    assert re.match(said, rows[0]["reason"])
    assert read_replay(folder / rows[0]["recording_path"]).properties["status"] == "energy-growth"


def test_the_rows_of_a_sweep_to_an_error_have_the_energy_of_each_frame(tmp_path, monkeypatch):
    (tmp_path / "scene.yaml").write_text((SCENES / "single-spring.yaml").read_text())
    options = "options: {frames: 5, error_target: 1e-3, record: %s, pictures: false, timing: shared}\n"
    (tmp_path / "sweep.yaml").write_text(f"scenes: [scene.yaml]\nsolvers: [dormand-prince-8]\n{options % 'true'}")
    (spec,) = load_config(tmp_path / "sweep.yaml").list_runs()
    files = RunFiles.for_run(spec, tmp_path)
    files.rows_path.parent.mkdir()
    rows = execute_run(spec, files, lambda phase: None)
    assert {row["status"] for row in rows} == {"ok"}, rows[0]
    assert all(row["energy_gain"] <= 1e-3 * row["energy_available"] for row in rows)
    assert all(row["energy_available"] > 0.0 for row in rows)
    assert read_replay(files.recording_path).properties["status"] == "ok"
    monkeypatch.setattr("springbench.harness.experiments.error_control.candidate_methods.AdaptiveSubstepper", Boosting)
    rows = execute_run(spec.replace_options(record=False), files, lambda phase: None)
    assert {row["status"] for row in rows} == {"energy-growth"}


def test_a_method_that_stored_rows_show_to_be_expensive_is_not_tried_again(tmp_path, monkeypatch):
    few = [
        ("substepping", SolverSpec(name, {})) for name in ("velocity-verlet", "blanes-moan-4", "rodas")
    ]  # the last is dear
    monkeypatch.setattr(
        "springbench.harness.experiments.error_control.candidate_methods.list_candidate_methods", lambda: few
    )
    monkeypatch.setattr(
        "springbench.harness.experiments.error_control.stored_trials.list_candidate_methods", lambda: few
    )
    error_target = ErrorTarget.from_scene(load_scene(SCENES / "single-spring.yaml"), 2, 0.2)
    seen = compute_predictability_horizon(error_target, 1e-3, lambda line: None)
    answer = search_cheapest_method(error_target, 1e-3, seen, lambda line: None)
    promises: dict[str, float] = {"velocity-verlet": 1.0, "blanes-moan-4": 1.9, "rodas": 2.1}
    answer = replace(answer, trials=tuple((one, promises[one.method.solver]) for one, _ in answer.trials))
    shared = {"problem_digest": format_problem_id(error_target), "error_requested": 1e-3} | build_provenance_columns()
    parquet_rows.write_rows(
        tmp_path / "s-2-error-0.001.parquet",
        [shared | row for row in build_trial_rows(answer, [], 1e-3)],
        ACCURACY_SCHEMA,
    )

    found = read_stored_trials(tmp_path, error_target)
    assert select_best_predicted(found, 4e-3) == (1e-3, few[:2])
    assert select_best_predicted(found, 2e-2) == (1e-3, [])
    assert select_best_predicted([], 1e-3)[1] == []
    again = build_trial_rows(replace(answer, trials=answer.trials[:1]), found, 1e-3)
    assert {row["solver"] for row in again} == set(promises), "what is not tried again is not forgotten"
    assert not read_stored_trials(tmp_path, replace(error_target, num_frames=error_target.num_frames + 1))
    monkeypatch.setattr("springbench.harness.execution.machine_info.hash_sources", lambda: "other")
    assert not read_stored_trials(tmp_path, error_target)


@pytest.mark.long
def test_third_party_integrators_have_rows_of_their_own(tmp_path):
    other = [row for row in rows_of(tmp_path, "--compare") if row["kind"] == "third-party"]
    assert [peer["solver"] for peer in other] == list(THIRD_PARTY_INTEGRATORS)
    assert all(peer["reason"] or peer["error_estimated"] <= 1e-3 for peer in other)
    assert [peer["status"] for peer in other][:2] == ["ok", "ok"]

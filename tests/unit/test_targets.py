"""Goals: what they are held against, their verdicts, their rows, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.performance_targets import load_targets
from springbench.harness.errors import InputError
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.error_control import target_baseline
from springbench.harness.experiments.error_control.target_measurement import TargetResult
from springbench.harness.experiments.error_control.third_party_integrators import THIRD_PARTY_INTEGRATORS
from springbench.harness.results import parquet_rows
from springbench.solvers.registry import SOLVER_TABLE
from typer.testing import CliRunner

SPRING = """
mesh: {kind: chain}
mass: 1
time_step: 1/20
frames: 4
default_size: 3
effects:
  - {kind: springs, stretch: 20}
  - {kind: gravity}
  - {kind: pins, at: [first], weight: exact}
"""
CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def config(folder: Path, goals: str) -> Path:
    (folder / "spring.yaml").write_text(SPRING)
    (folder / "mine.yaml").write_text(f"scenes: [spring.yaml]\ngoals: {goals}\n")
    return folder / "mine.yaml"


def test_the_shipped_goals_are_sound_and_name_their_schema() -> None:
    goals = load_targets(CONFIGS / "goals.yaml", list(THIRD_PARTY_INTEGRATORS), list(SOLVER_TABLE)).goals
    assert [(one.scene, one.size) for one in goals][:4] == [
        ("chain", 9),
        ("net", 9),
        ("hanging-cloth", 9),
        ("hanging-cloth", 17),
    ]
    controlled = load_targets(CONFIGS / "controlled.yaml", list(THIRD_PARTY_INTEGRATORS), list(SOLVER_TABLE)).goals
    assert len({one.scene for one in controlled}) == 11
    assert len(controlled) == 3 * 11
    assert all(one.target.graded for one in controlled)
    for name in ("goals", "controlled"):
        first = (CONFIGS / f"{name}.yaml").read_text().splitlines()[0]
        assert first == "# yaml-language-server: $schema=schema.json"


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ("scene: sprung, error: 1e-3, peer: scipy-rk45", "came 'sprung'; wanted one of spring"),
        ("scene: spring, error: 1e-3, peer: lsode", "came 'lsode'; wanted one of"),
        ("scene: spring, error: 1e-3", "wants either a `peer`, or `integrator` and `solver`"),
        ("scene: spring, error: 1e-3, integrator: midpoint", "wants either a `peer`, or `integrator` and `solver`"),
        ("scene: spring, error: 2, peer: scipy-rk45", "goals[0].error"),
        ("scene: spring, error: 1e-3, integrator: midpoint, solver: newtons", "came 'newtons'; wanted one of"),
    ],
)
def test_what_cannot_be_a_goal_is_refused(tmp_path: Path, goal: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        load_targets(
            config(tmp_path, f"[{{{goal}, horizon: 0.2, wanted: 0.5}}]"),
            list(THIRD_PARTY_INTEGRATORS),
            list(SOLVER_TABLE),
        )
    assert said in str(refused.value)


def test_other_commands_name_the_one_for_goals(tmp_path: Path) -> None:
    path = config(tmp_path, "[{scene: spring, horizon: 0.2, error: 1e-3, peer: scipy-rk45, wanted: 1}]")
    with pytest.raises(InputError, match="springbench targets"):
        load_config(path)


def test_goals_are_timed_beside_a_peer_and_steps_of_one_length(tmp_path: Path) -> None:
    against = (
        "peer: scipy-dop853-numpy, wanted: 1000",
        "integrator: midpoint, solver: newton, wanted: 1e-9, graded: true",
    )
    path = config(
        tmp_path, "[" + ", ".join(f"{{scene: spring, horizon: 0.2, error: 1e-3, {a}}}" for a in against) + "]"
    )
    done = CliRunner().invoke(app, ["targets", str(path), "--results", str(tmp_path / "results")])
    assert done.exit_code == 1, done.output
    assert "does not hold" in done.output
    found = parquet_rows.read_rows(
        [tmp_path / "results" / "mine" / "accuracy" / "goals.parquet"], ACCURACY_SCHEMA
    ).to_pylist()
    assert [row["against"].split(",")[0] for row in found] == ["scipy-dop853-numpy", "midpoint with newton"]
    for row in found:
        assert row["kind"] == "goal"
        assert max(row["estimated"], row["against_error"]) <= row["asked"] == 1e-3
        assert min(row["cpu_seconds"], row["against_seconds"]) > 0.0
    ungraded, graded = found
    assert ungraded["error"] is None
    assert 0.0 < graded["error"] <= graded["estimated"]


def test_what_takes_too_long_is_a_bound_of_the_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(target_baseline, "MAX_SIMULATION_SECONDS", 0.0)
    path = config(
        tmp_path, "[{scene: spring, horizon: 0.2, error: 1e-3, integrator: midpoint, solver: newton, wanted: 1e-9}]"
    )
    done = CliRunner().invoke(app, ["targets", str(path), "--results", str(tmp_path / "results")])
    assert done.exit_code == 1, done.output
    assert "an error of" in done.output
    assert "at most" in done.output
    (row,) = parquet_rows.read_rows(
        [tmp_path / "results" / "mine" / "accuracy" / "goals.parquet"], ACCURACY_SCHEMA
    ).to_pylist()
    assert "given up after" in row["against"]
    assert row["against_error"] is None
    assert row["against_seconds"] > 0.0


def test_a_graded_error_is_near_the_one_asked_or_it_is_said_why_not() -> None:
    (one, *_) = load_targets(CONFIGS / "controlled.yaml", list(THIRD_PARTY_INTEGRATORS), list(SOLVER_TABLE)).goals
    cases = {(2.1, ""): False, (2.0, ""): True, (0.3, ""): False, (0.3, "unstable"): True}
    for (part, note), holds in cases.items():
        assert (
            TargetResult(one, 9, error=part * one.error, seconds=1.0, baseline_seconds=1.0, note=note).is_met == holds
        )
    assert not TargetResult(one, 9, error=one.error, seconds=1.6, baseline_seconds=1.0).is_met

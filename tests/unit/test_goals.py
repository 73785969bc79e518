"""Goals: what they are held against, their verdicts, their rows, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from harness.base import rows
from harness.base.errors import InputError
from harness.cli import app
from harness.config.goals import load_goals
from harness.config.load import load_any
from harness.experiments.accuracy.accuracy_rows import SCHEMA
from harness.experiments.asked.peers import PEERS
from solvers.registry import EVERY

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
SHIPPED = Path(__file__).resolve().parents[2] / "configs" / "goals.yaml"


def config(folder: Path, goals: str) -> Path:
    (folder / "spring.yaml").write_text(SPRING)
    (folder / "mine.yaml").write_text(f"scenes: [spring.yaml]\ngoals: {goals}\n")
    return folder / "mine.yaml"


def test_the_shipped_goals_are_sound_and_name_their_schema() -> None:
    goals = load_goals(SHIPPED, list(PEERS), list(EVERY)).goals
    assert [(name, size) for _, name, size in goals][:4] == [
        ("chain", 9),
        ("net", 9),
        ("hanging-cloth", 9),
        ("hanging-cloth", 17),
    ]
    assert SHIPPED.read_text().splitlines()[0] == "# yaml-language-server: $schema=schema.json"


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ("scene: sprung, error: 1e-3, peer: scipy-rk45", "came 'sprung'; wanted one of spring"),
        ("scene: spring, error: 1e-3, peer: cvode", "came 'cvode'; wanted one of"),
        ("scene: spring, error: 1e-3", "wants either a `peer`, or `integrator` and `solver`"),
        ("scene: spring, error: 1e-3, integrator: midpoint", "wants either a `peer`, or `integrator` and `solver`"),
        ("scene: spring, error: 2, peer: scipy-rk45", "goals[0].error"),
        ("scene: spring, error: 1e-3, integrator: midpoint, solver: newtons", "came 'newtons'; wanted one of"),
    ],
)
def test_what_cannot_be_a_goal_is_refused(tmp_path: Path, goal: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        load_goals(config(tmp_path, f"[{{{goal}, horizon: 0.2, wanted: 0.5}}]"), list(PEERS), list(EVERY))
    assert said in str(refused.value)


def test_other_commands_name_the_one_for_goals(tmp_path: Path) -> None:
    path = config(tmp_path, "[{scene: spring, horizon: 0.2, error: 1e-3, peer: scipy-rk45, wanted: 1}]")
    with pytest.raises(InputError, match="springbench goals"):
        load_any(path)


def test_goals_are_timed_beside_a_peer_and_steps_of_one_length(tmp_path: Path) -> None:
    against = ("peer: scipy-dop853-numpy, wanted: 1000", "integrator: midpoint, solver: newton, wanted: 1e-9")
    path = config(
        tmp_path, "[" + ", ".join(f"{{scene: spring, horizon: 0.2, error: 1e-3, {a}}}" for a in against) + "]"
    )
    done = CliRunner().invoke(app, ["goals", str(path), "--results", str(tmp_path / "results")])
    assert done.exit_code == 1, done.output
    assert "does not hold" in done.output
    found = rows.read([tmp_path / "results" / "mine" / "accuracy" / "goals.parquet"], SCHEMA).to_pylist()
    assert [row["against"].split(",")[0] for row in found] == ["scipy-dop853-numpy", "midpoint with newton"]
    for row in found:
        assert row["kind"] == "goal"
        assert max(row["estimated"], row["against_error"]) <= row["asked"] == 1e-3
        assert min(row["cpu_seconds"], row["against_seconds"]) > 0.0

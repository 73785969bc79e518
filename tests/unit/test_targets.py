"""Performance targets: their configs, baselines, verdicts and rows."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.errors import InputError
from springbench.harness.results import parquet_rows

from tests.bench import target_baseline, targets
from tests.bench.target_config import load_targets

SPRING = """
mesh: {kind: chain}
mass: 1
time_step: 1/20
frames: 4
default_size: 3
effects:
  - {kind: springs, stretch: 20}
  - {kind: gravity}
  - {kind: pins, parts: [first], weight: exact}
"""
BENCH = Path(targets.__file__).parent


def write_config(folder: Path, *items: str) -> Path:
    (folder / "spring.yaml").write_text(SPRING)
    listed = "".join(f"  - {{{item}}}\n" for item in items)
    (folder / "mine.yaml").write_text(f"scenes: [spring.yaml]\ntargets:\n{listed}")
    return folder / "mine.yaml"


def run(config: Path) -> tuple[int, list[dict]]:
    """The exit code of the script, and its rows."""
    results = config.parent / "results"
    code = targets.main([str(config), "--results", str(results)])
    return code, parquet_rows.read_rows([results / "mine" / "targets.parquet"], targets.TARGET_SCHEMA).to_pylist()


def test_the_shipped_configs_are_valid() -> None:
    cases = load_targets(BENCH / "targets.yaml").cases
    assert [(one.scene, one.size) for one in cases][:4] == [
        ("chain", 9),
        ("net", 9),
        ("hanging-cloth", 9),
        ("hanging-cloth", 17),
    ]
    controlled = load_targets(BENCH / "controlled.yaml").cases
    assert len({one.scene for one in controlled}) == 11
    assert len(controlled) == 3 * 11
    assert all(one.target.verify for one in controlled)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("scene: sprung, error: 1e-3, third_party: scipy-rk45", "unknown name 'sprung'; expected one of spring"),
        ("scene: spring, error: 1e-3, third_party: lsode", "unknown name 'lsode'; expected one of"),
        ("scene: spring, error: 1e-3", "either `third_party`, or `integrator` and `solver`"),
        ("scene: spring, error: 1e-3, integrator: midpoint", "either `third_party`, or `integrator` and `solver`"),
        ("scene: spring, error: 2, third_party: scipy-rk45", "targets[0].error"),
        ("scene: spring, error: 1e-3, integrator: midpoint, solver: newtons", "unknown name 'newtons'"),
    ],
)
def test_a_mistake_is_one_message(
    tmp_path: Path, target: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_config(tmp_path, f"{target}, t_end: 0.2, target_ratio: 0.5")
    with pytest.raises(InputError) as refused:
        load_targets(path)
    assert message in str(refused.value)
    assert targets.main([str(path), "--results", str(tmp_path)]) == 2


def test_a_scene_is_no_config_of_targets(tmp_path: Path) -> None:
    write_config(tmp_path)
    with pytest.raises(InputError, match="has no `targets`"):
        load_targets(tmp_path / "spring.yaml")


def test_a_method_is_timed_against_a_third_party_and_against_fixed_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shared = "scene: spring, t_end: 0.2, error: 1e-3"
    code, rows = run(
        write_config(
            tmp_path,
            f"{shared}, third_party: scipy-dop853-numpy, target_ratio: 1000",
            f"{shared}, integrator: midpoint, solver: newton, target_ratio: 1e-9, verify: true",
        )
    )
    assert code == 1
    assert "missed" in capsys.readouterr().out
    assert [row["baseline"].split(",")[0] for row in rows] == ["scipy-dop853-numpy", "midpoint with newton"]
    for row in rows:
        assert max(row["error_estimated"], row["baseline_error"]) <= row["error_requested"] == 1e-3
        assert min(row["cpu_seconds"], row["baseline_seconds"]) > 0.0
    unverified, verified = rows
    assert unverified["error"] is None
    assert 0.0 < verified["error"] <= verified["error_estimated"]


def test_a_baseline_that_takes_too_long_is_a_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(target_baseline, "MAX_SIMULATION_SECONDS", 0.0)
    target = "scene: spring, t_end: 0.2, error: 1e-3, integrator: midpoint, solver: newton, target_ratio: 1e-9"
    code, (row,) = run(write_config(tmp_path, target))
    assert code == 1
    assert "at most" in capsys.readouterr().out
    assert "stopped after" in row["baseline"]
    assert row["baseline_error"] is None
    assert row["baseline_seconds"] > 0.0


def test_a_verified_error_is_near_the_requested_one_or_a_note_states_why_not() -> None:
    (one, *_) = load_targets(BENCH / "controlled.yaml").cases

    def is_met(error: float, seconds: float = 1.0, note: str = "") -> bool:
        result = targets.TargetResult(one, 9, error=error * one.error, seconds=seconds, baseline_seconds=1.0, note=note)
        return result.is_met

    cases = {(2.1, ""): False, (2.0, ""): True, (0.3, ""): False, (0.3, "unstable"): True}
    assert {case: is_met(case[0], note=case[1]) for case in cases} == cases
    assert not is_met(1.0, seconds=1.6)

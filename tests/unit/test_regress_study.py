"""The study of regression tests: recorded blocks, replayed tests, and real ones."""

from pathlib import Path

import numpy as np
import pytest
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest
from springbench.harness.results import parquet_rows
from typer.testing import CliRunner

from tests.bench.live_study import summarise_live_study
from tests.bench.regress_study import app
from tests.bench.replay_study import (
    OTHER_COMPARISONS,
    RECORD_SCHEMA,
    RecordedBlocks,
    read_recorded_blocks,
    replay_comparison,
    replay_tests,
)
from tests.scene_builders import CLOTH_SCENE_YAML


def starts(biases: tuple[float, ...] = (1.0, 1.0, 1.0), noise: float = 0.02, turns: int = 500) -> list[RecordedBlocks]:
    """Recorded starts of the same code, whose second process is slower by the factor, on a machine with bursts."""
    found = []
    for seed, bias in enumerate(biases):
        rng = np.random.default_rng(seed)
        a, b = np.exp(noise * rng.standard_normal((2, turns, 2)))
        burst = np.repeat(rng.random(turns // 10) < 0.2, 10)
        a[burst] *= rng.uniform(1, 2, (burst.sum(), 2))
        b[burst] *= rng.uniform(1, 2, (burst.sum(), 2))
        found.append(
            RecordedBlocks(
                np.log(bias * a.sum(axis=1) / b.sum(axis=1)), bias * a, b, wall_seconds=0.1, load_average=1.0
            )
        )
    return found


@pytest.mark.parametrize(
    ("slower", "limit", "fails", "holds"),
    [
        (1.0, 1.03, (0.0, 0.001), (0.99, 1.0)),
        (1.05, 1.03, (0.95, 1.0), (0.0, 0.001)),
        (1.1, 1.03, (0.99, 1.0), (0.0, 0.0)),
    ],
)
def test_a_replay_finds_slowdowns_without_false_alarms(
    slower: float, limit: float, fails: tuple[float, float], holds: tuple[float, float]
):
    found = replay_tests(starts(), slower, SequentialTest(limit), budget=120.0, num_replays=1000)
    assert fails[0] <= found.fail_rate <= fails[1]
    assert holds[0] <= found.pass_rate <= holds[1]
    assert found.fail_rate + found.pass_rate + found.inconclusive_rate == pytest.approx(1.0)
    assert 1.6 <= found.median_seconds <= 120  # 16 turns of .1 s, the fewest that decide


def test_one_deviating_process_pair_hardly_causes_a_false_alarm():
    # One of ten pairs of processes is 5 % apart: a tenth of first races fails, a tenth of those a second time.
    found = replay_tests(starts((1.05, *([1.0] * 9))), 1.0, SequentialTest(1.03), budget=120.0, num_replays=2000)
    assert 0.0 < found.fail_rate < 0.02
    assert found.inconclusive_rate > 0.05


def test_process_pairs_are_drawn_again_in_a_long_test(monkeypatch: pytest.MonkeyPatch):
    # A third of the pairs is .8 % apart: alone it does not show that the code is 2 % slower and not 1 %.
    recorded = starts((1.0, 1.0, 0.992), noise=0.04)
    several = replay_tests(recorded, 1.02, SequentialTest(1.01), budget=300.0, num_replays=300)
    monkeypatch.setattr("tests.bench.replay_study.RESTART_SECONDS", 300.0)
    alone = replay_tests(recorded, 1.02, SequentialTest(1.01), budget=300.0, num_replays=300)
    assert several.pass_rate == 0.0
    assert several.fail_rate > alone.fail_rate + 0.2  # .90 and .54


def test_other_tools_compare_successive_sessions():
    same = starts()
    for rule in OTHER_COMPARISONS.values():
        assert replay_comparison(rule, same, 1.5, duration=20.0, num_replays=100) > 0.9
        assert replay_comparison(rule, same, 0.7, duration=20.0, num_replays=100) == 0.0


@pytest.mark.long
def test_blocks_are_recorded_and_replayed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "cloth.yaml").write_text(CLOTH_SCENE_YAML)
    (tmp_path / ".git").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("springbench.harness.experiments.regression.git_worktrees.find_checkout", lambda folder: folder)
    samples = tmp_path / "samples.parquet"
    given = [
        "record",
        str(samples),
        "cloth.yaml",
        "--solver",
        "sparse",
        "--duration",
        "1",
        "--injected-slowdown",
        "0.1",
    ]
    for starts in ("2", "1"):  # what is stored already remains
        done = CliRunner().invoke(app, [*given, "--process-pairs", starts])
        assert done.exit_code == 0, done.output
    recorded = parquet_rows.read_rows([samples], RECORD_SCHEMA).to_pylist()
    assert {row["process_pair"] for row in recorded} == {0, 1, 2}
    assert {row["injected_slowdown"] for row in recorded} == {0.1}
    ((key, found),) = read_recorded_blocks([samples]).items()
    assert key == ("cloth, size 4, sparse, 500 iterations, implicit-euler, dt 0.03333", "nothing")
    assert sum(len(start.log_ratios) for start in found) == len(recorded)
    done = CliRunner().invoke(app, ["replay", str(samples), "--replays", "20"])
    assert done.exit_code == 0, done.output
    assert "asv continuous" in done.output


@pytest.mark.long
def test_real_tests_are_counted_and_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "cloth.yaml").write_text(CLOTH_SCENE_YAML)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("springbench.harness.experiments.regression.git_worktrees.find_checkout", lambda folder: folder)
    given = [
        "live",
        "held.parquet",
        "cloth.yaml",
        "--solver",
        "sparse",
        "--budget",
        "20",
        "--max-ratio",
        "2",
    ]
    assert CliRunner().invoke(app, [*given, "--repeats", "2"]).exit_code == 0
    done = CliRunner().invoke(app, [*given, "--repeats", "1", "--injected-slowdown", "4"])
    assert done.exit_code == 0, done.output
    (same, slower) = summarise_live_study(tmp_path / "held.parquet")
    # On a busy machine a test may be inconclusive, and nothing else.
    assert same[3:7] == ("0%", "100%", "2", "0")
    assert int(same[7]) + int(same[8]) == 2
    assert slower[3:6] == ("400%", "100%", "1")
    assert slower[7] == "0"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ("record", "new.parquet", "cloth.yaml", "--background-load", "windy"),
            "--background-load: got windy; expected one of nothing",
        ),
        (("replay", "nowhere.parquet"), "nowhere.parquet: no such file; `record` writes one"),
    ],
)
def test_a_mistake_is_one_message(
    arguments: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "cloth.yaml").write_text(CLOTH_SCENE_YAML)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("springbench.harness.experiments.regression.git_worktrees.find_checkout", lambda folder: folder)
    done = CliRunner().invoke(app, list(arguments))
    assert done.exit_code == 2, done.output
    assert said in " ".join(done.output.split())

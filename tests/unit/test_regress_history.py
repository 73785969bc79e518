"""`springbench regress --history`: changes of level over commits."""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.cli.main import app
from springbench.harness.report.change_detection import (
    BenchmarkPoint,
    detect_changes,
    find_stored_files,
    partition_series,
    read_histories,
)
from typer.testing import CliRunner

from tests.synthetic_benchmarks import build_ratio_series, write_benchmark_files


def points(values: Any) -> list[BenchmarkPoint]:
    return [BenchmarkPoint(f"{k:07x}", float(v), float(v) * 0.985, float(v) * 1.015) for k, v in enumerate(values)]


def test_a_step_of_five_percent_in_noise_of_one_is_found_within_a_commit():
    found = [detect_changes(points(build_ratio_series(seed, 30, (18, 1.05)))) for seed in range(100)]
    hits = [starts for starts in found if len(starts) == 2 and abs(starts[1] - 18) <= 1]
    assert len(hits) >= 95


def test_noise_seldom_causes_a_change_and_an_outlier_never_does():
    alarms = sum(len(detect_changes(points(build_ratio_series(seed, 30)))) > 1 for seed in range(200))
    assert alarms <= 4
    lone = np.ones(30)
    lone[12] = 1.03
    assert detect_changes(points(lone)) == (0,)


def test_changes_have_a_commit_and_a_size_the_largest_first(tmp_path: Path):
    gates = {"test_same": build_ratio_series(1, 24), "test_slower": build_ratio_series(2, 24, (8, 1.1), (16, 0.8))}
    found = read_histories(find_stored_files([write_benchmark_files(tmp_path / "bench", gates)]))
    assert [one.benchmark_name for one in found] == ["test_slower", "test_same"]
    assert [point.commit for point in found[0].points] == [f"{k:07x}" for k in range(24)]
    (first, up), (second, down) = found[0].level_changes
    assert (first, second) == (8, 16)
    assert (up, down) == pytest.approx((1.1, 0.8), abs=0.02)  # the means of eight results each, with noise of 1 %
    assert found[1].level_changes == []


def find_history(*arguments: str | Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["regress", "--history", *map(str, arguments)])
    return done.exit_code, " ".join(done.output.split())


@pytest.mark.parametrize("ratio", [True, False], ids=["ratios", "minima"])
def test_the_command_prints_the_changes(tmp_path: Path, ratio: bool):
    folder = write_benchmark_files(
        tmp_path / "bench",
        {"test_slower": build_ratio_series(2, 12, (6, 1.2)), "test_same": build_ratio_series(3, 12)},
        is_ratio=ratio,
    )
    code, output = find_history(folder)
    assert code == 0, output
    assert "% at 0000006" in output
    assert f"`springbench figure history {folder}` draws them" in output


def test_too_few_results_are_inconclusive(tmp_path: Path):
    folder = write_benchmark_files(tmp_path / "bench", {"test_slower": build_ratio_series(2, 5, (3, 2.0))})
    code, output = find_history(folder)
    assert code == 3
    assert "inconclusive: at most 5 results of a benchmark, expected 6; `pytest tests/bench" in output


def test_a_mistake_is_one_message(tmp_path: Path):
    (tmp_path / "x.json").write_text("{}")
    (tmp_path / "empty").mkdir()
    for arguments, message in (
        ((tmp_path,), "x.json"),
        ((tmp_path / "empty",), "no stored results"),
        ((tmp_path / "no",), "does not exist"),
        ((tmp_path, "--baseline", "HEAD"), "--history: compares all stored results"),
        ((tmp_path, "--budget", "3"), "--budget: does not apply to --history"),
    ):
        code, output = find_history(*arguments)
        assert (code, message in output) == (2, True), output


@pytest.mark.parametrize("seed", range(6))
def test_the_partition_is_the_best_of_all(seed: int):
    rng = np.random.default_rng(seed)
    y, penalty = rng.normal(size=10), 2.0
    y[4:] += 4 * rng.normal()

    def cost(starts: tuple[int, ...]) -> float:
        pairs = zip(starts, (*starts[1:], len(y)), strict=True)
        return sum(float(((y[a:b] - y[a:b].mean()) ** 2).sum()) for a, b in pairs) + penalty * (len(starts) - 1)

    every = [(0, *some) for count in range(5) for some in combinations(range(2, 9), count)]
    allowed = [starts for starts in every if min(np.diff((*starts, len(y)))) >= 2]
    assert cost(partition_series(y, penalty)) == pytest.approx(min(map(cost, allowed)), abs=1e-12)  # round-off

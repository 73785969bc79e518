"""A gates file: the limits and the error probability of its tests, without timing any."""

from pathlib import Path
from typing import Any

import pytest
from springbench.harness.experiments.regression import gates_file
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest

from tests.contracts.hostile import scene

GATES = """
gates:
  - {scene: cloth.yaml, solver: sparse, baseline: dense, max_ratio: 1.5}
  - {scene: cloth.yaml, solver: dense, baseline: sparse, max_ratio: 2, budget: 7}
"""


def test_gates_share_the_error_probability_and_each_may_have_a_budget_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "cloth.yaml").write_text(scene())
    (tmp_path / "gates.yaml").write_text(GATES)
    calls: list[tuple[SequentialTest, float]] = []

    def run_confirmed_benchmark(start: Any, rule: SequentialTest, *, time_budget: float) -> str:
        calls.append((rule, time_budget))
        return "pass"

    monkeypatch.setattr(gates_file, "run_confirmed_benchmark", run_confirmed_benchmark)
    gates_file.run_gates_file(tmp_path / "gates.yaml", 60.0, lambda line: None, alpha=0.01)
    assert calls == [(SequentialTest(1.5, 0.005), 60.0), (SequentialTest(2.0, 0.005), 7.0)]

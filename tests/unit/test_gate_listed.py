"""A table of gates: what each gate is asked, without timing one."""

from pathlib import Path
from typing import Any

import pytest
from springbench.harness.experiments.regression import regression_table
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest

from tests.contracts.hostile import scene

TABLE = """
gates:
  - {scene: cloth.yaml, solver: sparse, against: dense, limit: 1.5}
  - {scene: cloth.yaml, solver: dense, against: sparse, limit: 2, budget: 7}
"""


def test_the_gates_of_a_table_share_its_error_and_each_may_have_a_budget_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "cloth.yaml").write_text(scene())
    (tmp_path / "gates.yaml").write_text(TABLE)
    asked: list[tuple[SequentialTest, float]] = []

    def confirmed(start: Any, rule: SequentialTest, *, time_budget: float) -> str:
        asked.append((rule, time_budget))
        return "holds"

    monkeypatch.setattr(regression_table, "run_confirmed_benchmark", confirmed)
    regression_table.run_regression_table(tmp_path / "gates.yaml", 60.0, lambda line: None, alpha=0.01)
    assert asked == [(SequentialTest(1.5, 0.005), 60.0), (SequentialTest(2.0, 0.005), 7.0)]

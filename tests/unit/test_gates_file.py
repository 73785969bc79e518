"""A gates file: the limits and the error probability of its tests, without timing any."""

from pathlib import Path
from typing import Any

import pytest
from springbench.harness.experiments.regression import gates_file
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest
from springbench.harness.experiments.regression.solver_pair import prepare_solver_pair

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


def test_a_gate_compares_a_solver_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal\n\n\n"
        "class Mine(SparseLocalGlobal):\n    pass\n"
    )
    (tmp_path / "chain.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.01\nframes: 2\ndefault_size: 4\n"
        "effects: [{kind: springs, stretch: 100}, {kind: gravity}, {kind: pins, parts: [ends]}]\n"
    )
    mine, baseline = prepare_solver_pair(tmp_path / "chain.yaml", "./mine.py:Mine", "sparse", max_iterations=3)
    assert (mine() == baseline()).all()

"""What sweeps cost besides their timed passes is measured on runs that configs of today describe."""

from __future__ import annotations

from pathlib import Path

from tests.sweep_overhead import MESH_SIZES, SOLVER_NAMES, list_short_runs


def test_short_runs_differ_in_what_is_given(tmp_path: Path):
    runs = list_short_runs(tmp_path, max_iterations=[1, 2])
    assert len(runs) == 2 * len(SOLVER_NAMES) * len(MESH_SIZES)
    assert {run.max_iterations for run in runs} == {1, 2}

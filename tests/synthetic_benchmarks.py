"""Invented results of gates: their noise and their changes are known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

NOISE_LEVEL = 0.01


def build_ratio_series(seed: int, count: int, *steps: tuple[int, float]) -> Any:
    """Ratios with noise of 1 %, which from some result on are larger by a factor."""
    values = np.exp(NOISE_LEVEL * np.random.default_rng(seed).standard_normal(count))
    for at, factor in steps:
        values[at:] *= factor
    return values


def write_benchmark_files(folder: Path, series_by_benchmark: dict[str, Any], *, is_ratio: bool = True) -> Path:
    """Results as pytest-benchmark stores them, a file a commit; in the names' order they are shuffled."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(len(next(iter(series_by_benchmark.values())))):
        records = [
            {
                "fullname": f"tests/bench/test_gates.py::{gate}",
                "extra_info": {"ratio": {"median": v[k], "low": 0.98 * v[k], "high": 1.02 * v[k]}} if is_ratio else {},
                "stats": {"min": 1e-3 * v[k]},
            }
            for gate, v in series_by_benchmark.items()
        ]
        commit = {"id": f"{k:07x}" * 5, "time": f"2026-01-{k + 1:02}T12:00:00+00:00", "dirty": False}
        stored = {"machine_info": {"cpu": {"brand_raw": "A processor", "count": 2}, "affinity": 2}}
        stored |= {"commit_info": commit, "datetime": "2026-03-01T00:00:00", "benchmarks": records}
        (folder / f"{k * 7 % 31:04}_gates.json").write_text(json.dumps(stored))
    return folder

"""Inputs of gates that are damaged or made up: tables, records, histories, and tests that use the plug-in."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

from tests.contracts.hostile import BOMB
from tests.contracts.hostile_more import build_benchmark_file

TABLE = "gates:\n  - {scene: good.yaml, solver: sparse, baseline: dense, max_ratio: 1}\n"


def build_gate_table(**values: str) -> str:
    """A table of one gate with these keys."""
    keys = {"scene": "good.yaml", "solver": "sparse", "baseline": "dense", "max_ratio": "1"} | values
    return "gates:\n  - {" + ", ".join(f"{key}: {value}" for key, value in keys.items()) + "}\n"


TABLES: dict[str, str | bytes | Callable[[Path], object]] = {
    "an empty table": "",
    "a list": "- a\n",
    "no gates": "gates: []\n",
    "gates of a word": "gates: fast\n",
    "gates of gates": "gates: [[[]]]\n",
    "an unknown key": build_gate_table(maxratio="1"),
    "a scene that is missing": build_gate_table(scene="none.yaml"),
    "a scene of a device": build_gate_table(scene="/dev/zero"),
    "a scene of a pipe": build_gate_table(scene="pipe"),
    "a scene that is a sweep": build_gate_table(scene="sweep.yaml"),
    "a scene of code": build_gate_table(scene="'!!python/name:os.system'"),
    "a solver that is missing": build_gate_table(solver="fastest-of-all"),
    "a solver of a list": build_gate_table(solver="[sparse]"),
    "a solver without a name": build_gate_table(solver="{max_iterations: 3}"),
    "a parameter that is missing": build_gate_table(solver="{name: sparse, speed: 9}"),
    "code that is missing": build_gate_table(solver="./none.py:Solver"),
    "code elsewhere": build_gate_table(solver="./../../etc/passwd.py:Solver"),
    "a limit of zero": build_gate_table(max_ratio="0"),
    "a limit of NaN": build_gate_table(max_ratio=".nan"),
    "a limit of 1e999": build_gate_table(max_ratio="1e999"),
    "an agreement of 2": build_gate_table(agreement_rtol="2"),
    "an agreement of NaN": build_gate_table(agreement_rtol=".nan"),
    "a size of 1e9": build_gate_table(size="1e9"),
    "a size of zero": build_gate_table(size="0"),
    "no iterations": build_gate_table(max_iterations="0"),
    "a tolerance below zero": build_gate_table(rtol="-1"),
    "frames of 1e9": build_gate_table(frames="1e9"),
    "a clock of another kind": build_gate_table(clock="sun"),
    "a budget of NaN": build_gate_table(budget=".nan"),
    "a budget of infinity": build_gate_table(budget=".inf"),
    "an integrator of another program": build_gate_table(integrator="rk4"),
    "aliases": BOMB + TABLE,
    "brackets": "gates: " + "[" * 100_000,
    "text of another coding": TABLE.encode("utf-16"),
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a folder": Path.mkdir,
}

RECORDS: dict[str, str | bytes | Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a folder": Path.mkdir,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a machine of lists": json.dumps(
        build_benchmark_file() | {"machine_info": {"cpu": {"brand_raw": ["a"], "count": {}}}}
    ),
    "a commit of a number": json.dumps(build_benchmark_file() | {"commit_info": {"id": 3, "time": 7}}),
    "a date of a list": json.dumps(build_benchmark_file() | {"datetime": []}),
    "names of markup": json.dumps(build_benchmark_file(fullname="[/bold][link=file:///etc/passwd]\x1b[2J")),
    "a name of a lone surrogate": json.dumps(build_benchmark_file(fullname="\ud800")),
    "a name of 1 MB": json.dumps(build_benchmark_file(fullname="x" * 1_000_000)),
    "a time of 1e308": json.dumps(build_benchmark_file(stats={"min": 1e308})),
    "a time of 1e-308": json.dumps(build_benchmark_file(stats={"min": 1e-308})),
}

PLUGIN = """
import pytest
WRONG = [
    {"max_ratio": float("nan")}, {"max_ratio": 0.0}, {"max_ratio": -1.0}, {"max_ratio": float("inf")},
    {"max_ratio": "fast"}, {"max_ratio": 1.0, "clock": "sun"}, {"max_ratio": 1.0, "agreement_rtol": -1.0},
    {"max_ratio": 1.0, "agreement_rtol": float("nan")}, {"max_ratio": 1.0, "alpha": 2.0},
    {"max_ratio": 1.0, "alpha": -1.0},
]
@pytest.mark.parametrize("given", WRONG)
def test_race(paired_benchmark, given):
    paired_benchmark(lambda: 1.0, lambda: 1.0, **given)
@pytest.mark.parametrize("scene", ["none.yaml", "/dev/zero", "pipe", "sweep.yaml", ""])
def test_solvers(paired_benchmark, scene):
    paired_benchmark.compare_solvers(scene, "sparse", "dense", max_ratio=1.0)
def test_wrong_answer(paired_benchmark):
    paired_benchmark(lambda: 1.0, lambda: 2.0, max_ratio=1.0)
def test_no_answer(paired_benchmark):
    paired_benchmark(lambda: None, lambda: None, max_ratio=1.0)
"""
"""Tests that use the plug-in wrongly: each of them fails, and none breaks pytest."""

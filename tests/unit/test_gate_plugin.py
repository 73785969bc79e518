"""The fixture `paired_benchmark` and tables of gates, as somebody uses them in a folder of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.cli.main import app
from springbench.harness.experiments.regression.answer_agreement import describe_difference
from typer.testing import CliRunner

SCENE = """
mesh: {kind: grid}
mass: 0.3
time_step: 1/30
frames: 30
default_size: 6
effects: [{kind: springs, stretch: 300}, {kind: gravity}, {kind: pins, at: [top_corners]}]
"""

SPIN = """
def spin(rounds, answer=1.0):
    def work():
        total = 0
        for k in range(rounds):
            total += k
        return answer
    return work
"""


def session(folder: Path, test: str, *options: str) -> tuple[int, str, list[dict[str, Any]]]:
    """The exit code of a session of pytest, what it printed, and the benchmarks that it stored."""
    (folder / "test_mine.py").write_text(f"{SPIN}\n{test}\n")
    stored = folder / "stored.json"
    # The plugin as a module, whether or not the package is installed with it.
    plugin = [
        "-p",
        "no:springbench",
        "-p",
        "springbench.harness.experiments.regression.pytest_plugin",
        "-p",
        "no:cacheprovider",
    ]
    command = [sys.executable, "-m", "pytest", "-q", *plugin, f"--benchmark-json={stored}", *options]
    # Beside other workers of one session pytest-benchmark times nothing; this session is one of its own.
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
    told = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=alone)
    found = json.loads(stored.read_text())["benchmarks"] if stored.exists() and stored.stat().st_size else []
    return told.returncode, told.stdout + told.stderr, found


def test_a_race_has_three_answers_and_stores_what_it_found(tmp_path: Path):
    # Nothing depends on the machine's speed: limits lie far from the true ratios of 1 and 3, and there is time enough.
    test = """
def test_holds(paired_benchmark): paired_benchmark(spin(50_000), spin(50_000), max_ratio=20)
def test_fails(paired_benchmark): paired_benchmark(spin(300_000), spin(100_000), max_ratio=1.2)
def test_inconclusive(paired_benchmark): paired_benchmark(spin(100_000), spin(100_000), max_ratio=1, budget=1e-3)
"""
    code, said, stored = session(tmp_path, test, "--paired-benchmark-budget=500")
    assert code == 1
    assert "1 failed, 1 passed, 1 inconclusive" in said
    assert "FAILED test_mine.py::test_fails - Failed: ratio" in said
    assert "INCONCLUSIVE test_mine.py::test_inconclusive: cannot tell within" in said
    assert [b["extra_info"]["answer"] for b in stored] == ["pass", "fail", "inconclusive"]
    for benchmark in stored:
        extra = benchmark["extra_info"]
        assert extra["ratio"]["low"] <= extra["ratio"]["median"] <= extra["ratio"]["high"]
        assert benchmark["stats"]["rounds"] == 2 * extra["turns"]


def test_a_session_without_failures_that_cannot_tell_has_an_exit_code_of_its_own(tmp_path: Path):
    test = (
        "def test_it(paired_benchmark): paired_benchmark(spin(100_000), spin(100_000), "
        "max_ratio=1, budget=1e-3)\ndef test_other(): pass"
    )
    code, said, _ = session(tmp_path, test)
    assert code == 13, said
    assert "1 passed, 1 inconclusive" in said


def test_answers_that_differ_fail_and_nothing_is_timed(tmp_path: Path):
    test = "def test_it(paired_benchmark): paired_benchmark(spin(10, [0.0, 2.0]), spin(10, [0.0, 4.0]), max_ratio=9)"
    code, said, stored = session(tmp_path, test)
    assert code == 1
    assert "the answers differ, so nothing was timed: they lie 5.0e-01 of the answer's size apart, wanted 0" in said
    assert not stored


def test_where_benchmarks_are_disabled_only_the_answers_are_compared(tmp_path: Path):
    test = """
def test_same(paired_benchmark): assert paired_benchmark(spin(10), spin(10), max_ratio=1e-6) is None
def test_other(paired_benchmark): paired_benchmark(spin(10, 1.0), spin(10, 2.0), max_ratio=9)
"""
    code, said, stored = session(tmp_path, test, "--benchmark-disable")
    assert code == 1
    assert "1 failed, 1 passed" in said
    assert "FAILED test_mine.py::test_other - Failed: the answers differ" in said
    assert not stored


def test_solvers_race_on_a_scene_and_one_of_them_may_be_ones_own(tmp_path: Path):
    (tmp_path / "cloth.yaml").write_text(SCENE)
    test = """
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
def test_named(paired_benchmark):
    paired_benchmark.compare_solvers("cloth.yaml", "sparse", {"name": "dense"}, max_ratio=1e6, iterations=20)
def test_own(paired_benchmark):
    paired_benchmark.compare_solvers("cloth.yaml", SparseLocalGlobal(), "sparse", max_ratio=1e6, agreement_rtol=0.0)
def test_other_answers(paired_benchmark):
    paired_benchmark.compare_solvers("cloth.yaml", "xpbd", "sparse", max_ratio=1e6)
"""
    code, said, stored = session(tmp_path, test, "--paired-benchmark-budget=500")
    assert code == 1
    assert "2 passed" in said
    assert "FAILED test_mine.py::test_other_answers - Failed: the answers differ" in said
    assert [b["extra_info"]["answer"] for b in stored] == ["pass", "pass"]


def gate(path: Path, *options: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["regress", str(path), *options])
    return done.exit_code, " ".join(done.output.split())


def table(folder: Path, *gates: str) -> Path:
    (folder / "cloth.yaml").write_text(SCENE)
    path = folder / "gates.yaml"
    path.write_text("gates:\n" + "".join(f"  - {{{gate}}}\n" for gate in gates))
    return path


def test_a_table_of_gates_is_run_without_python(tmp_path: Path):
    path = table(
        tmp_path,
        "scene: cloth.yaml, solver: sparse, against: dense, limit: 1e6",
        "scene: cloth.yaml, size: 5, solver: dense, against: {name: sparse}, limit: 1e-6",
        "scene: cloth.yaml, solver: sparse, against: dense, limit: 1, budget: 1e-3",
    )
    code, said = gate(path, "--budget", "500")
    assert code == 1
    assert "cloth, sparse against dense: ratio" in said
    assert "holds (limit 1e+06)" in said
    assert "cloth 5, dense against sparse: ratio" in said
    assert "fails (limit 1e-06)" in said
    assert "cannot tell within" in said
    undecided = table(tmp_path, "scene: cloth.yaml, solver: sparse, against: dense, limit: 1, budget: 1e-3")
    assert gate(undecided)[0] == 3


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (
            "scene: nowhere.yaml, solver: sparse, against: dense, limit: 1",
            "gates.yaml:2: gates[0].scene: there is no file",
        ),
        (
            "scene: cloth.yaml, solver: sparce, against: dense, limit: 1",
            'gates.yaml:2: gates[0]: unknown name "sparce"; expected',
        ),
        ("scene: cloth.yaml, solver: sparse, against: dense", "gates.yaml:2: gates[0].limit: is missing"),
        (
            "scene: cloth.yaml, solver: sparse, against: dense, limit: -1",
            "gates[0].limit: came -1; should be greater than 0",
        ),
        (
            "scene: cloth.yaml, solver: xpbd, against: sparse, limit: 9",
            "gates[0]: the answers differ, so nothing was timed",
        ),
        ("scene: cloth.yaml, solver: sparse, against: dense, limit: 1, clock: sun", 'gates[0].clock: came "sun"'),
    ],
)
def test_a_mistake_in_a_table_is_told_with_its_line(tmp_path: Path, line: str, said: str):
    code, told = gate(table(tmp_path, line))
    assert code == 2, told
    assert said in told


def test_options_that_a_table_states_itself_are_refused(tmp_path: Path):
    code, said = gate(table(tmp_path, "scene: cloth.yaml, solver: sparse, against: dense, limit: 1"), "--limit", "2")
    assert code == 2
    assert "--limit: a table of gates says so itself" in said


@pytest.mark.parametrize(
    ("new", "old", "tolerance", "said"),
    [
        ([[0.0, 1.0], [4.0, 2.0]], [[0.0, 1.0], [4.0, 2.0]], 0.0, ""),
        ([[0.0, 1.0], [4.1, 2.0]], [[0.0, 1.0], [4.0, 2.0]], 0.03, ""),
        ([[0.0], [4.1]], [[0.0], [4.0]], 0.02, "they lie 2.5e-02 of the answer's size apart, wanted 0.02"),
        ([[996.0], [1000.1]], [[996.0], [1000.0]], 0.02, "they lie 2.5e-02 of the answer's size apart, wanted 0.02"),
        (3.0, 2.0, 0.1, "they lie 5.0e-01 of the answer's size apart, wanted 0.1"),
        (float("nan"), 2.0, 0.1, "they lie nan of the answer's size apart, wanted 0.1"),
        ([0.0], [0.0], 0.0, ""),
        ([1.0, 2.0], [1.0], 0.1, "arrays of (2,) and (1,)"),
    ],
)  # fmt: skip
def test_answers_are_compared_in_their_own_size(new: Any, old: Any, tolerance: float, said: str):
    assert describe_difference(new, old, tolerance) == said

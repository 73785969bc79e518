"""The fixture `paired_benchmark` and gates files, in a folder of the user's own."""

import json
import os
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config
from springbench.harness.errors import InputError
from springbench.harness.experiments.regression.program_pair import AnswersDiffer, require_agreement
from typer.testing import CliRunner

SCENE = """
mesh: {kind: grid}
mass: 0.3
time_step: 1/30
frames: 30
default_size: 6
effects: [{kind: springs, stretch: 300}, {kind: gravity}, {kind: pins, parts: [top_corners]}]
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
    # Next to other workers of one session pytest-benchmark times nothing; this session is one of its own.
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
    completed = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=alone)
    found = json.loads(stored.read_text())["benchmarks"] if stored.exists() and stored.stat().st_size else []
    return completed.returncode, completed.stdout + completed.stderr, found


def test_a_paired_benchmark_has_three_verdicts_and_stores_its_result(tmp_path: Path):
    # Nothing depends on the machine's speed: limits lie far from the true ratios of 1 and 3, and there is time enough.
    test = """
def test_holds(paired_benchmark): paired_benchmark(spin(50_000), spin(50_000), max_ratio=20)
def test_fails(paired_benchmark): paired_benchmark(spin(300_000), spin(100_000), max_ratio=1.2)
def test_inconclusive(paired_benchmark): paired_benchmark(spin(100_000), spin(100_000), max_ratio=1, budget=1e-3)
"""
    code, said, stored = session(tmp_path, test, "--paired-benchmark-budget=500")
    assert code == 1
    assert "1 failed, 1 passed, 1 inconclusive" in said
    assert "FAILED test_mine.py::test_fails - Failed: fail: ratio" in said
    assert re.search(r"INCONCLUSIVE test_mine.py::test_inconclusive: .* \(limit 1\) after", said)
    assert [b["extra_info"]["verdict"] for b in stored] == ["pass", "fail", "inconclusive"]
    for benchmark in stored:
        extra = benchmark["extra_info"]
        assert extra["ratio"]["low"] <= extra["ratio"]["median"] <= extra["ratio"]["high"]
        assert benchmark["stats"]["rounds"] == 2 * extra["num_blocks"]


def test_an_inconclusive_session_has_an_exit_code_of_its_own(tmp_path: Path):
    test = (
        "def test_it(paired_benchmark): paired_benchmark(spin(100_000), spin(100_000), "
        "max_ratio=1, budget=1e-3)\ndef test_other(): pass"
    )
    code, said, _ = session(tmp_path, test)
    assert code == 13, said
    assert "1 passed, 1 inconclusive" in said


def test_solutions_that_differ_fail_and_nothing_is_timed(tmp_path: Path):
    test = "def test_it(paired_benchmark): paired_benchmark(spin(10, [0.0, 2.0]), spin(10, [0.0, 4.0]), max_ratio=9)"
    code, said, stored = session(tmp_path, test)
    assert code == 1
    assert "the answers differ by 5.0e-01 of their size, at most 0 is allowed; nothing was timed" in said
    assert not stored


def test_with_benchmarks_disabled_only_solutions_are_compared(tmp_path: Path):
    test = """
def test_same(paired_benchmark): assert paired_benchmark(spin(10), spin(10), max_ratio=1e-6) is None
def test_other(paired_benchmark): paired_benchmark(spin(10, 1.0), spin(10, 2.0), max_ratio=9)
"""
    code, said, stored = session(tmp_path, test, "--benchmark-disable")
    assert code == 1
    assert "1 failed, 1 passed" in said
    assert "FAILED test_mine.py::test_other - Failed: the answers differ" in said
    assert not stored


def test_solvers_are_compared_on_a_scene_and_one_may_be_the_users_own(tmp_path: Path):
    (tmp_path / "cloth.yaml").write_text(SCENE)
    test = """
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
def test_named(paired_benchmark):
    paired_benchmark.compare_solvers("cloth.yaml", "sparse", {"name": "dense"}, max_ratio=1e6, max_iterations=20)
def test_own(paired_benchmark):
    paired_benchmark.compare_solvers("cloth.yaml", SparseLocalGlobal(), "sparse", max_ratio=1e6, agreement_rtol=0.0)
def test_other_answers(paired_benchmark):
    paired_benchmark.compare_solvers("cloth.yaml", "xpbd", "sparse", max_ratio=1e6)
"""
    code, said, stored = session(tmp_path, test, "--paired-benchmark-budget=500")
    assert code == 1
    assert "2 passed" in said
    assert "FAILED test_mine.py::test_other_answers - Failed: the answers differ" in said
    assert [b["extra_info"]["verdict"] for b in stored] == ["pass", "pass"]


def test_an_error_probability_of_zero_is_no_default(tmp_path: Path):
    (tmp_path / "cloth.yaml").write_text(SCENE)
    test = """
def test_it(paired_benchmark): paired_benchmark(spin(10), spin(10), max_ratio=9, alpha=0)
def test_solvers(paired_benchmark):
    paired_benchmark.compare_solvers("cloth.yaml", "sparse", "sparse", max_ratio=9, max_iterations=2, alpha=2.0)
"""
    code, said, stored = session(tmp_path, test)
    assert code == 1
    assert "ValueError: alpha: got 0; expected a probability" in said
    assert "ValueError: alpha: got 2.0; expected a probability" in said
    assert not stored


def regress(path: Path, *options: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["regress", str(path), *options])
    return done.exit_code, " ".join(done.output.split())


def write_gates(folder: Path, *gates: str) -> Path:
    (folder / "cloth.yaml").write_text(SCENE)
    path = folder / "gates.yaml"
    path.write_text("gates:\n" + "".join(f"  - {{scene: cloth.yaml, {gate}}}\n" for gate in gates))
    return path


def test_a_gates_file_is_run_without_python(tmp_path: Path):
    path = write_gates(
        tmp_path,
        "solver: sparse, baseline: dense, max_ratio: 1e6",
        "size: 5, solver: dense, baseline: {name: sparse}, max_ratio: 1e-6",
        "solver: sparse, baseline: dense, max_ratio: 1, budget: 1e-3",
    )
    code, output = regress(path, "--budget", "500")
    assert code == 1
    assert "cloth, sparse vs dense: pass: ratio" in output
    assert "(limit 1e+06)" in output
    assert "cloth 5, dense vs sparse: fail: ratio" in output
    assert "(limit 1e-06)" in output
    assert "cloth, sparse vs dense: inconclusive: " in output
    inconclusive = write_gates(tmp_path, "solver: sparse, baseline: dense, max_ratio: 1, budget: 1e-3")
    assert regress(inconclusive)[0] == 3


@pytest.mark.parametrize(
    ("gate", "message"),
    [
        ("solver: sparce, baseline: dense, max_ratio: 1", 'gates.yaml:2: gates[0]: unknown name "sparce"; expected'),
        ("solver: sparse, baseline: dense", "gates.yaml:2: gates[0].max_ratio: is missing"),
        ("solver: sparse, baseline: dense, max_ratio: -1", "gates[0].max_ratio: got -1; should be greater than 0"),
        ("solver: xpbd, baseline: sparse, max_ratio: 9", "gates.yaml:2: gates[0]: the answers differ by"),
        ("solver: sparse, baseline: dense, max_ratio: 1, clock: sun", 'gates[0].clock: got "sun"'),
    ],
)
def test_a_mistake_in_a_gates_file_is_reported_with_its_line(tmp_path: Path, gate: str, message: str):
    code, output = regress(write_gates(tmp_path, gate))
    assert code == 2, output
    assert message in output


def test_a_missing_scene_is_reported_with_its_line(tmp_path: Path):
    path = write_gates(tmp_path, "solver: sparse, baseline: dense, max_ratio: 1")
    (tmp_path / "cloth.yaml").unlink()
    code, output = regress(path)
    assert code == 2, output
    assert "gates.yaml:2: gates[0].scene: there is no file" in output


def test_a_scene_is_no_gates_file_and_a_gates_file_is_no_scene(tmp_path: Path):
    path = write_gates(tmp_path, "solver: sparse, baseline: dense, max_ratio: 1")
    code, output = regress(tmp_path / "cloth.yaml")
    assert code == 2
    assert "is a scene (with `mesh`), for `springbench run`, or `springbench regress` with --baseline" in output
    assert "expected a gates file (with `gates`)" in output
    with pytest.raises(InputError, match=r"is a gates file .* `springbench regress` without --baseline; expected a sc"):
        load_config(path)


def test_options_that_a_gates_file_sets_are_refused(tmp_path: Path):
    path = write_gates(tmp_path, "solver: sparse, baseline: dense, max_ratio: 1")
    code, output = regress(path, "--max-ratio", "2")
    assert code == 2
    assert "--max-ratio: does not apply to a gates file, which sets the options of each gate" in output


@pytest.mark.parametrize(
    ("new", "old", "rtol", "message"),
    [
        ([[0.0, 1.0], [4.0, 2.0]], [[0.0, 1.0], [4.0, 2.0]], 0.0, None),
        ([[0.0, 1.0], [4.1, 2.0]], [[0.0, 1.0], [4.0, 2.0]], 0.03, None),
        ([[0.0], [4.1]], [[0.0], [4.0]], 0.02, "differ by 2.5e-02 of their size, at most 0.02"),
        ([[996.0], [1000.1]], [[996.0], [1000.0]], 0.02, "differ by 2.5e-02 of their size, at most 0.02"),
        (3.0, 2.0, 0.1, "differ by 5.0e-01 of their size, at most 0.1"),
        (float("nan"), 2.0, 0.1, "differ by nan of their size, at most 0.1"),
        ([0.0], [0.0], 0.0, None),
        ([1.0, 2.0], [1.0], 0.1, r"shapes \(2,\) and \(1,\)"),
    ],
)
def test_solutions_are_compared_relative_to_their_size(new: Any, old: Any, rtol: float, message: str | None):
    with pytest.raises(AnswersDiffer, match=message) if message else nullcontext():
        require_agreement(new, old, rtol)

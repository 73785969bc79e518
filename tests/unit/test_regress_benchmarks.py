"""`springbench regress`: regressions between two files of pytest-benchmark."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from springbench.harness.cli.main import app
from springbench.harness.errors import InputError
from springbench.harness.report.benchmark_comparison import compare_benchmarks
from springbench.harness.results.regression_verdict import RegressionVerdict
from typer.testing import CliRunner

ROOT = Path(__file__).resolve().parents[2]
HERE = {"cpu": {"brand_raw": "Fast 9000", "count": 2}, "affinity": 2}
ELSEWHERE = {"cpu": {"brand_raw": "Slow 100", "count": 2}, "affinity": 2}

MINIMUM = 0.010


def ratio(median: float, spread: float = 0.01) -> dict[str, float]:
    return {"median": median, "low": median - spread, "high": median + spread}


def benchmark(name: str = "numba", minimum: float = MINIMUM, **extra: Any) -> dict[str, Any]:
    return {"fullname": f"tests/bench/test_gates.py::test_gate[{name}]", "stats": {"min": minimum}, "extra_info": extra}


def write_benchmarks(path: Path, *benchmarks: dict[str, Any], machine: dict[str, Any] = HERE) -> Path:
    path.write_text(json.dumps({"machine_info": machine, "benchmarks": benchmarks, "version": "5.3.1"}))
    return path


def compare(base: Path, new: Path) -> tuple[RegressionVerdict, str]:
    console = Console(file=io.StringIO(), width=200)
    verdict = compare_benchmarks(base, new, console)
    assert isinstance(console.file, io.StringIO)
    return verdict, console.file.getvalue()


WIDE = ratio(1.2, spread=0.12)  # from 1.08 to 1.32: above 1.00 +- 0.01, but not by the margin of 10 %


@pytest.mark.parametrize(
    ("old", "new", "machine", "words"),
    [
        pytest.param({"ratio": ratio(1.0)}, {"ratio": ratio(1.0)}, HERE, "pass", id="the same ratio"),
        pytest.param({"ratio": ratio(1.0)}, {"ratio": ratio(1.2)}, HERE, "fail: slower", id="a higher ratio"),
        pytest.param({"ratio": ratio(1.0)}, {"ratio": ratio(0.8)}, HERE, "pass: faster", id="a lower ratio"),
        pytest.param({"ratio": ratio(1.0)}, {"ratio": WIDE}, HERE, "pass", id="an uncertain ratio"),
        pytest.param({"ratio": ratio(1.0)}, {"ratio": ratio(1.2)}, ELSEWHERE, "pass", id="ratio elsewhere"),
        pytest.param({"ratio": ratio(1.0)}, {"ratio": ratio(1.5)}, ELSEWHERE, "fail: slower", id="far ratio elsewhere"),
        pytest.param({"ratio": ratio(1.0)}, {}, HERE, "fail: its ratio is missing", id="a ratio that is missing"),
        pytest.param({}, {"minimum": 1.4 * MINIMUM}, HERE, "pass", id="a minimum within the margin"),
        pytest.param({}, {"minimum": 1.6 * MINIMUM}, HERE, "fail: slower", id="a minimum beyond the margin"),
        pytest.param({}, {"minimum": 0.5 * MINIMUM}, HERE, "pass: faster", id="a lower minimum"),
        pytest.param(
            *({}, {"minimum": 9 * MINIMUM}, ELSEWHERE, "inconclusive: another machine"), id="a minimum elsewhere"
        ),
    ],
)
def test_a_benchmark_is_compared(old: dict, new: dict, machine: dict, words: str, tmp_path: Path):
    base = write_benchmarks(tmp_path / "base.json", benchmark(**old))
    verdict, text = compare(base, write_benchmarks(tmp_path / "new.json", benchmark(**new), machine=machine))
    assert verdict == words.partition(":")[0]
    (row,) = [line for line in text.splitlines() if "test_gate[numba]" in line]
    assert row.rstrip().endswith(words)
    assert f"{verdict}: 1 {verdict}" in text
    assert ("different machines" in text) == (machine is ELSEWHERE)


def test_a_ratio_is_compared_whatever_the_times_were(tmp_path: Path):
    base = write_benchmarks(tmp_path / "base.json", benchmark(ratio=ratio(1.0)))
    verdict, _ = compare(
        base, write_benchmarks(tmp_path / "new.json", benchmark(minimum=5 * MINIMUM, ratio=ratio(1.0)))
    )
    assert verdict == "pass"


def test_a_missing_benchmark_fails_and_a_new_one_has_no_verdict(tmp_path: Path):
    one, both = write_benchmarks(tmp_path / "one.json", benchmark("a")), tmp_path / "both.json"
    write_benchmarks(both, benchmark("a"), benchmark("b"))
    verdict, text = compare(both, one)
    assert verdict == "fail"
    assert [line.split()[-2:] for line in text.splitlines() if "[b]" in line] == [["fail:", "missing"]]
    verdict, text = compare(one, both)
    assert verdict == "pass"
    assert [line.split()[-1] for line in text.splitlines() if "[b]" in line] == ["new"]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        pytest.param(None, "No such file", id="missing"),
        pytest.param("no JSON", "Invalid JSON", id="no JSON"),
        pytest.param("[1, 2]", "object", id="another shape"),
        pytest.param('{"runs": []}', "machine_info: Field required", id="another program's JSON"),
        pytest.param('{"machine_info": {}, "benchmarks": []}', "benchmarks", id="no benchmarks"),
        pytest.param(
            json.dumps({"machine_info": {}, "benchmarks": [benchmark(minimum=-1.0)]}),
            "benchmarks.0.stats.min",
            id="a negative time",
        ),
        pytest.param(
            json.dumps({"machine_info": {}, "benchmarks": [benchmark(ratio={"median": 1.0})]}),
            "benchmarks.0.extra_info.ratio.low",
            id="a ratio without its interval",
        ),
    ],
)
def test_a_foreign_file_is_the_users_mistake(content: str | None, problem: str, tmp_path: Path):
    good, bad = write_benchmarks(tmp_path / "good.json", benchmark()), tmp_path / "bad.json"
    if content is not None:
        bad.write_text(content)
    for pair in ((good, bad), (bad, good)):
        with pytest.raises(InputError) as caught:
            compare(*pair)
        message = str(caught.value)
        assert message.startswith(f"{bad}: ")
        assert problem in message
        assert "expected a file that pytest-benchmark stored" in message


def test_files_without_a_common_benchmark_are_inconclusive(tmp_path: Path):
    verdict, text = compare(
        write_benchmarks(tmp_path / "a.json", benchmark("a")), write_benchmarks(tmp_path / "b.json", benchmark("b"))
    )
    assert verdict == "inconclusive"
    assert "no benchmark in common" in " ".join(text.split())  # long paths wrap


@pytest.mark.parametrize(("new", "code"), [(1.0, 0), (1.5, 1), (None, 2)])
def test_the_verdict_is_the_exit_code(new: float | None, code: int, tmp_path: Path):
    base = write_benchmarks(tmp_path / "base.json", benchmark(ratio=ratio(1.0)))
    other = write_benchmarks(tmp_path / "new.json", benchmark(ratio=ratio(new))) if new else tmp_path / "missing.json"
    assert CliRunner().invoke(app, ["regress", str(other), "--baseline", str(base)]).exit_code == code


BENCHMARK = """
def count():
    return sum(range(1000))

def test_counts(paired_benchmark):
    paired_benchmark(count, count, max_ratio=9, budget=500)
"""


def test_stored_gates_can_be_compared_and_name_no_host(tmp_path: Path):
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = --benchmark-disable\n")
    (tmp_path / "test_counts.py").write_text(BENCHMARK)
    command = [
        sys.executable,
        "-m",
        "pytest",
        *(
            "-p",
            "no:springbench",
            "-p",
            "springbench.harness.experiments.regression.pytest_plugin",
            "-p",
            "tests.bench.conftest",
        ),
        "--benchmark-only",
        "--all-gates",
        "-p",
        "no:cacheprovider",
    ]
    # Benchmarks measure nothing in a process that shares its machine with other tests, and this one says it does.
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
    environment = alone | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (file,) = (tmp_path / "results" / "bench").glob("*/0001_gates.json")
    content = json.loads(file.read_text())
    assert "node" not in content["machine_info"]
    found = content["benchmarks"][0]
    assert len(found["stats"]["data"]) == 2 * found["extra_info"]["num_blocks"]
    verdict, text = compare(file, file)
    assert verdict == "pass"
    assert "test_counts" in text

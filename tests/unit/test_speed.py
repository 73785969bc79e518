"""The speed report: who takes turns with whom, what is left out and why, and what is said of a time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from harness.load import load_any, load_sweep
from harness.rows import SCHEMA
from harness.spec import RunSpec, SolverSpec
from harness.speed import candidates, limits, yardstick
from harness.speed.candidates import Reading, average
from harness.speed.figures import Machine, figures, interval
from harness.speed.report import run_speed
from harness.speed.table import exponents, remarks, speed_table
from harness.speed.turns import PREPARES, Past, measure, name, predicted
from harness.speed.work import count
from solvers.problem import Unsupported

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "configs" / "scenes" / "yardstick-cloth.yaml"
COUNTS = {"vertices": 16, "springs": 42}
ROUNDS = 3


def run(solver: str, **parameters: Any) -> RunSpec:
    """A run of the yardstick cloth under another solver's name."""
    (made,) = load_any(SCENE, solvers=["sparse"], sizes=[4], rounds=ROUNDS).runs()
    return replace(made, solver=SolverSpec(solver, parameters))


class Scripted:
    """A candidate that writes down when it is called, and does what it is told."""

    def __init__(self, solver: str, calls: list[str], *, at: float = 0.0, fails: Exception | None = None) -> None:
        self.run, self.calls, self.at, self.fails = run(solver), calls, at, fails
        self.columns: dict[str, Any] = {"choice": solver}

    def prepare(self) -> float | None:
        self.calls.append(f"prepare {self.run.solver.name}")
        if self.fails:
            raise self.fails
        return 0.5

    def turn(self) -> list[Reading]:
        self.calls.append(self.run.solver.name)
        return [Reading("step", 0.25, {"iterations": 50})]

    def close(self):
        # The second coordinate gives the scene a size of 1.
        return np.array([[self.at, 0.0, 0.0], [self.at, 1.0, 0.0]])


def test_candidates_take_turns():
    calls: list[str] = []
    found = measure([Scripted("a", calls), Scripted("b", calls)], COUNTS, {}, budget=1.0)
    assert calls == ["prepare a", "prepare b"] * PREPARES + ["a", "b"] * ROUNDS
    for rows, solver in zip(found, "ab", strict=True):
        assert [row["round"] for row in rows if row["phase"] == "prepare"] == list(range(PREPARES))
        assert [row["seconds"] for row in rows if row["phase"] == "step"] == [0.25] * ROUNDS
        assert {row["status"] for row in rows} == {"ok"}
        assert {(row["solver"], row["choice"], row["vertices"]) for row in rows} == {(solver, solver, 16)}


@pytest.mark.parametrize(
    ("error", "status"), [(Unsupported("not for chains"), "unsupported"), (ZeroDivisionError("oh"), "failed")]
)
def test_one_that_fails_says_why_and_the_others_go_on(error: Exception, status: str):
    calls: list[str] = []
    bad, good = measure([Scripted("a", calls, fails=error), Scripted("b", calls)], COUNTS, {}, budget=1.0)
    assert [(row["phase"], row["status"]) for row in bad] == [("run", status)]
    assert str(error) in bad[0]["reason"]
    assert calls.count("b") == ROUNDS
    assert {row["status"] for row in good} == {"ok"}


def test_no_time_is_believed_of_one_that_ends_elsewhere():
    first, near, far = measure(
        [Scripted("a", []), Scripted("b", [], at=1e-10), Scripted("c", [], at=1e-8)], COUNTS, {}, budget=1.0
    )
    assert first[-1]["status"] == near[-1]["status"] == "ok"
    assert [row["status"] for row in far] == ["failed"]
    assert "1.0e-08" in far[0]["reason"]
    assert "seconds" not in far[0]


def test_one_that_would_take_too_long_is_left_out_with_a_row_that_says_so():
    calls: list[str] = []
    slow = Scripted("a", calls)
    past = {name(slow.run): [Past(4, prepare=1.0, iteration=1.0)]}
    (rows,) = measure([slow], COUNTS, past, budget=10.0)
    assert calls == []
    assert [(row["status"], row["phase"]) for row in rows] == [("skipped", "run")]
    assert "budget of each candidate is 10 s" in rows[0]["reason"]


@pytest.mark.parametrize("power", [1.0, 1.5, 3.0])
def test_a_power_law_is_predicted_exactly(power: float):
    past = [Past(n, prepare=2.0 * n**power, iteration=0.1 * n**power) for n in (10, 40)]
    seconds = PREPARES * 2.0 * 90**power + ROUNDS * 50 * 0.1 * 90**power
    # Logarithms and back: a few units in the last place.
    assert predicted(past, 90, run("a")) == pytest.approx(seconds, rel=1e-12)
    assert predicted([], 90, run("a")) == 0.0
    # What is known of larger sizes says nothing about smaller ones.
    assert predicted(past, 10, run("a")) == 0.0


def test_a_short_call_is_repeated_after_a_first_one_and_a_long_one_is_not():
    asked: list[int] = []

    def seconds(number: int) -> float:
        asked.append(number)
        return number * 1e-3

    assert average(seconds, 0.02) == pytest.approx(1e-3, rel=1e-12)
    assert average(seconds, 1e-4) == pytest.approx(1e-3, rel=1e-12)
    assert asked == [1, 20, 1]


def test_an_entry_that_is_read_is_a_multiply_and_an_add_for_each_of_three_sides():
    facts = {"nnz_factor": 100.0, "panel_bytes": 960.0, "flops_per_solve": 1440.0}
    work = count(facts, vertices=10, springs=20)
    assert work["global"].flops == 1440
    assert work["global"].bytes == 240 * 8 + 176 * 10
    assert work["global"].working_set == 960 + 176 * 10
    assert work["iteration"].bytes == work["global"].bytes + work["local"].bytes
    # L alone is read once in each pass.
    assert count({"nnz_factor": 100.0}, 10, 20, "float32")["global"].bytes == 2 * 100 * 4 + 176 * 10
    assert set(count({}, 10, 20)) == {"local"}


def test_the_probes_do_what_they_count():
    found = list(limits.probes((1 << 14, 1 << 16)))
    assert [p.name for p in found] == ["read", "triad"] * 2 + ["fma float64", "fma float32"]
    assert all(p.bytes % p.working_set == 0 for p in found if p.name == "read")
    total = found[0].call()
    # The array holds ones: every entry that was counted was read.
    assert 8 * total == found[0].bytes
    b, c, a = np.full(8, 2.0), np.full(8, 5.0), np.empty(8)
    limits._triad(a, b, c, 1, 1)
    assert (a == 17.0).all()
    assert found[4].flops == found[5].flops / 2


def machine_row(phase: str, seconds: float, *, bytes: float = 0.0, flops: float = 0.0, working_set: float = 0.0):
    """A row of the machine's own limits, one thread."""
    return {
        "run_id": "m",
        "scene": "cloth",
        "size": 4,
        "solver": "machine",
        "parameters": "{}",
        "threads": 1,
        "phase": phase,
        "seconds": seconds,
        "bytes": bytes,
        "flops": flops,
        "working_set": working_set,
        "status": "ok",
    }


LIMITS = [
    machine_row("read", 1.0, bytes=100.0, working_set=1e2),
    machine_row("read", 2.0, bytes=100.0, working_set=1e2),  # a disturbed round
    machine_row("read", 1.0, bytes=1.0, working_set=1e8),
    machine_row("fma float64", 1.0, flops=1000.0),
    machine_row("fma float32", 1.0, flops=2000.0),
]


def test_bandwidth_is_read_off_between_the_measured_working_sets():
    machine = Machine(LIMITS)
    # 100 bytes a second at 1e2 and 1 at 1e8: on logarithmic scales a straight line, level beyond its ends.
    assert machine.bandwidth(1, 1e5) == pytest.approx(10.0, rel=1e-12)
    assert machine.bandwidth(1, 1.0) == pytest.approx(100.0, rel=1e-12)
    assert machine.flops(1, "float16") == machine.flops(1, "float32") == 2000.0


def timed(solver: str, parameters: str, seconds: list[float], **columns: Any) -> list[dict[str, Any]]:
    """Rows of a candidate on the cloth, with these seconds in each of its phases."""
    shared = {
        "run_id": solver + parameters,
        "scene": "cloth",
        "size": 4,
        "solver": solver,
        "parameters": parameters,
        "threads": 1,
        "vertices": 16,
        "springs": 42,
        "status": "ok",
        "load": 0.5,
    }
    done = {"step": 10, "local": 1, "global": 1}
    return [
        shared | columns | {"phase": phase, "seconds": s * done.get(phase, 1), "iterations": done.get(phase)}
        for phase in ("prepare", "local", "global", "step")
        for s in seconds
    ]


def test_figures_say_how_near_the_binding_limit_is():
    rows = [
        *LIMITS,
        *timed("eigen", '{"temporaries": "default"}', [9.0, 8.0, 8.0]),
        *timed("eigen", '{"temporaries": "cheap"}', [4.0, 4.0, 4.0]),
        *timed("numba", '{"linear": "cholespy"}', [3.0, 3.0, 3.0]),
        *timed("numba", '{"linear": "supernodal"}', [1.0, 2.0, 1.0], nnz_factor=100, flops_per_solve=2400),
    ]
    found = {f.label: f for f in figures(pa.Table.from_pylist(rows, schema=SCHEMA))}
    assert list(found) == ["eigen default", "eigen cheap", "numba cholespy", "numba supernodal"]
    ours = found["numba supernodal"]
    assert ours.iterations == 10
    # 1 s an iteration at best, so a step of 50 takes 50 s.
    assert (ours.cold, ours.warm, ours.local, ours.step) == (1e3, 1e3, 1e3, 5e4)
    assert ours.faster is not None
    assert ours.faster.median == 8.0
    assert ours.cheap_faster is not None
    assert ours.cheap_faster.median == 4.0
    assert ours.solves_faster is not None
    assert (ours.solves_faster.median, ours.solves_faster.high) == (3.0, 3.0)
    work = count({"nnz_factor": 100, "flops_per_solve": 2400}, 16, 42)["iteration"]
    bandwidth = Machine(LIMITS).bandwidth(1, work.working_set)
    assert (ours.binds, ours.touched) == ("bandwidth", work.bytes)
    assert ours.reached == pytest.approx(work.bytes / bandwidth, rel=1e-12)
    assert ours.reached is not None
    assert ours.least is not None
    assert ours.least < ours.reached
    assert found["numba cholespy"].reached is None


def test_the_interval_of_ratios_holds_their_median_and_is_the_same_each_time():
    ratios = np.exp(0.1 * np.random.default_rng(1).standard_normal(15))
    assert interval(ratios).low < np.median(ratios) == interval(ratios).median < interval(ratios).high
    assert interval(ratios) == interval(ratios)
    assert interval(np.full(5, 2.0)) == (2.0, 2.0, 2.0)


SWEEP = """
scenes: [yardstick-cloth.yaml]
sizes: [5, 4]
solvers: [dense, sparse]
options: {iterations: 4, rounds: 2, record: false, pictures: false}
"""


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A small sweep on a machine without a compiler, with few and short probes and no repetitions."""
    (tmp_path / "small.yaml").write_text(SWEEP)
    (tmp_path / SCENE.name).write_bytes(SCENE.read_bytes())
    monkeypatch.setattr(yardstick.shutil, "which", lambda _: None)
    monkeypatch.setattr(limits, "WORKING_SETS", (1 << 14, 1 << 16))
    monkeypatch.setattr(limits.probes, "__defaults__", ((1 << 14, 1 << 16),))
    monkeypatch.setattr(candidates.average, "__defaults__", (0.0,))
    return load_sweep(tmp_path / "small.yaml")


def test_a_report_is_complete_and_done_once(sweep, tmp_path: Path):
    said: list[str] = []
    table = run_speed(sweep, tmp_path / "out", said.append)
    assert said == [f"yardstick-cloth {size}: 5 candidates take turns" for size in (4, 5)]
    found = figures(table)
    assert [(f.size, f.label, f.status) for f in found] == [
        (size, label, status)
        for size in (4, 5)
        for label, status in (
            ("dense", "ok"),
            ("sparse", "ok"),
            ("eigen default", "unsupported"),
            ("eigen cheap", "unsupported"),
        )
    ]
    assert "there is no C++ compiler" in (found[2].reason or "")
    assert all(f.reached and f.local and f.global_ and f.step and f.warm for f in found if f.status == "ok")
    assert speed_table(found).row_count == len(found)
    assert len(remarks(found)) == 4
    # A new size is measured; what is there is not.
    again = run_speed(sweep, tmp_path / "out", said.append)
    assert len(said) == 2
    assert again.equals(table)
    assert all((tmp_path / "out" / "rows").glob("*.parquet"))


def test_the_growth_of_a_solve_is_the_power_in_its_times():
    rows = []
    for size in (100, 200, 400):
        for row in timed("sparse", "{}", [1e-9 * size ** (2 * 1.25)]):
            rows.append(row | {"run_id": f"s{size}", "size": size, "vertices": size**2})
    found = figures(pa.Table.from_pylist(rows, schema=SCHEMA))
    assert exponents(found) == {"sparse": pytest.approx(1.25, rel=1e-9)}  # the fit's round-off

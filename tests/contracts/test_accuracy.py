"""An accuracy config becomes rows: their content, what is done twice (nothing), and what a failure leaves."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from springbench.harness.cli.main import main
from springbench.harness.config.accuracy_loader import load_accuracy
from springbench.harness.execution.progress_display import ProgressDisplay
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.accuracy.accuracy_study import run_accuracy_study
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.reference import reference_store
from springbench.harness.reference.certified_minimum import INACCURATE, KnownMinima, certify_minimum
from springbench.harness.report import accuracy_report
from springbench.harness.report.charts.chart_description import ChartDescription
from springbench.harness.report.charts.chart_table import CHART_NAMES
from springbench.harness.results import parquet_rows
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import Positions, PreparedSolver, System
from springbench.solvers.registry import SOLVERS

from tests.progress_displays import SilentDisplay

SCENE = """
mesh: {kind: grid}
mass: 1.0
time_step: 1/30
frames: 8
effects: [{kind: springs, stretch: 100}, {kind: gravity}, {kind: pins, parts: [top_corners]}]
"""
CONFIG = """
scenes: [cloth.yaml]
solvers: [sparse, newton, symplectic-euler]
curves:
  - {size: 4, snapshot: [early, peak], max_iterations: 60, rounds: 2, time_limit: 100, recordings: true}
work:
  - {size: 4, t_end: 0.2, time_step: [1/30, 1/60], max_iterations: 20, rounds: 2, time_limit: 100}
"""
UNITS = 2 * 2 + 2 * 3
TIMES = (
    "seconds",
    "cpu_seconds",
    "preempted",
    "cold_seconds",
    "seconds_per_simulated_second",
    "started_at",
    "commit",
    "source_fingerprint",
)
"""Columns that state how long something took, and when and by which state of the code it was done."""


class Home:
    """A config and its results."""

    def __init__(self, folder: Path, config: str = CONFIG) -> None:
        folder.mkdir(exist_ok=True)
        (folder / "cloth.yaml").write_text(SCENE)
        self.config, self.folder = folder / "config.yaml", folder / "results" / "config"
        self.config.write_text(config)

    def run(self, display: ProgressDisplay | None = None, *, isolated: bool = False) -> int:
        """How many units were done. isolated: in workers."""
        display = display or SilentDisplay()
        run_accuracy_study(load_accuracy(self.config), self.folder, display, lambda line: None, isolated=isolated)
        return getattr(display, "finished_units", 0)

    def rows(self, kind: str, **values: Any) -> list[dict[str, Any]]:
        """The rows of a kind that have these values, file by file."""
        table = parquet_rows.read_rows(
            sorted((self.folder / "accuracy").glob("*.parquet")), ACCURACY_SCHEMA
        ).to_pylist()
        return [row for row in table if row["kind"] == kind and all(row[key] == v for key, v in values.items())]

    def list_untimed_rows(self) -> list[str]:
        """All rows, less their times; as text, because what is not a number equals nothing."""
        table = parquet_rows.read_rows(sorted((self.folder / "accuracy").glob("*.parquet")), ACCURACY_SCHEMA)
        return list(map(repr, table.drop_columns(list(TIMES)).to_pylist()))

    def read_write_times(self) -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in self.units()}

    def units(self) -> Iterator[Path]:
        for path in sorted((self.folder / "accuracy").glob("*.parquet")):
            if parquet_rows.read_rows([path], ACCURACY_SCHEMA)["kind"][0].as_py() != "snapshot":
                yield path


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    made = Home(tmp_path_factory.mktemp("accuracy") / "home")
    assert made.run(isolated=True) == UNITS
    return made


@dataclass(frozen=True)
class FailingAtOnce:
    """A solver that fails in its first iteration."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True

    def prepare(self, system: System) -> PreparedSolver:
        prepared: Any = SparseLocalGlobal().prepare(system)

        class Failing:
            def iterates(self, problem: Any) -> Iterator[Positions]:
                raise ArithmeticError("it slipped")

            def __getattr__(self, name: str) -> Any:
                return getattr(prepared, name)

        failing: Any = Failing()
        return failing


@dataclass(frozen=True)
class Crashing(FailingAtOnce):
    """A solver that takes its process along."""

    def prepare(self, system: System) -> PreparedSolver:
        os.abort()


def test_a_solver_that_crashes_is_a_row_and_the_others_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The first that runs anything in this process: its workers are forks, which import nothing again.
    monkeypatch.setitem(SOLVERS, "crashing", f"{__name__}:Crashing")
    config = CONFIG.partition("work:")[0].replace("[sparse,", "[crashing,").replace("[early, peak]", "early")
    made = Home(tmp_path, config)
    assert made.run(isolated=True) == 2
    (problem,) = made.rows("snapshot")
    lost = made.rows("curve", solver="crashing")
    assert [(row["problem_digest"], row["initial_guess"]) for row in lost] == [
        (problem["problem_digest"], guess) for guess in ("previous", "inertial")
    ]
    for row in lost:
        assert row["status"] == "failed"
        assert "crashed by SIGABRT" in row["reason"]
    assert {row["status"] for row in made.rows("curve", solver="newton")} == {"ok"}
    assert made.run(isolated=True) == 0


def test_each_curve_is_of_a_problem_whose_minimum_is_certified(home: Home) -> None:
    problems = {row["problem_digest"]: row for row in home.rows("snapshot")}
    assert {row["snapshot"] for row in problems.values()} == {"early", "peak"}
    minima = {(row["problem_digest"], row["minimum_id"]): row for row in home.rows("minimum")}
    curves = home.rows("curve")
    assert {(row["solver"], row["initial_guess"]) for row in curves} == {
        (solver, guess) for solver in ("sparse", "newton") for guess in ("previous", "inertial")
    }
    for row in curves:
        minimum = minima[row["problem_digest"], row["minimum_id"]]
        assert minimum["is_certified"]
        assert minimum["min_eigenvalue"] > 0.0
        assert len(row["seconds"]) == 2
        assert row["position_error_max_m"] >= row["position_error_rms_m"]


def test_newton_s_method_reaches_the_minimum_by_energy_and_by_position(home: Home) -> None:
    lowest = {row["problem_digest"]: row["objective"] for row in home.rows("minimum", minimum_index=0)}
    start = {row["problem_digest"]: row["objective_initial"] for row in home.rows("snapshot")}
    length = {row["problem_digest"]: row["mean_rest_length"] for row in home.rows("snapshot")}
    for guess in ("previous", "inertial"):
        for problem, g in lowest.items():
            curve = home.rows("curve", solver="newton", initial_guess=guess, problem_digest=problem)
            first, last = curve[0], curve[-1]
            assert last["status"] == "ok"
            assert last["minimum_index"] == 0
            assert last["objective"] - g <= 1e-9 * (start[problem] - g)  # where a curve ends
            # An energy gap of 1e-9 is an error of its root, 3e-5 of the way that is to go.
            assert last["position_error_max_m"] < 1e-3 * length[problem]
            if guess == "previous":
                assert (first["iteration"], first["objective"]) == (0, start[problem])
                assert first["stationarity"] == pytest.approx(1.0, rel=1e-12)  # by its definition, but for round-off


def test_a_recording_shows_the_mesh_at_each_graded_iterate(home: Home) -> None:
    curve = home.rows("curve", solver="sparse", initial_guess="previous", snapshot="peak")
    replay = read_replay(home.folder / curve[0]["recording_path"])
    assert replay.frames.tolist() == [row["iteration"] for row in curve]
    assert np.isfinite(replay.positions).all()


def test_methods_that_do_not_minimise_have_work_and_no_curves(home: Home) -> None:
    assert not home.rows("curve", solver="symplectic-euler")
    work = home.rows("work")
    assert {(row["solver"], row["time_step"]) for row in work} == {
        (solver, dt) for solver in ("sparse", "newton", "symplectic-euler") for dt in (1 / 30, 1 / 60)
    }
    assert {(row["status"], row["reason"]) for row in work} == {("ok", None)}
    assert all(row["error"] > 0.0 for row in work)


def test_completed_measurements_are_not_repeated(home: Home) -> None:
    before = home.read_write_times()
    assert home.run() == 0
    assert home.read_write_times() == before


@pytest.mark.parametrize("after", [1, 4, 7])
def test_an_interrupted_config_resumes_where_it_was(home: Home, tmp_path: Path, after: int) -> None:
    stopped = Home(tmp_path / "home")
    with pytest.raises(KeyboardInterrupt):
        stopped.run(SilentDisplay(stop_after=after))
    there = stopped.read_write_times()
    assert len(there) == after
    assert stopped.run() == UNITS - after
    assert there.items() <= stopped.read_write_times().items()
    assert stopped.list_untimed_rows() == home.list_untimed_rows()


def test_a_changed_request_replaces_the_earlier_one(tmp_path: Path) -> None:
    made = Home(tmp_path, CONFIG.partition("work:")[0].replace("[early, peak]", "early"))
    assert made.run() == 2
    files = set(made.read_write_times())
    made.config.write_text(made.config.read_text().replace("rounds: 2", "rounds: 1"))
    assert made.run() == 2
    assert set(made.read_write_times()) == files
    assert {len(row["seconds"]) for row in made.rows("curve")} == {1}


def test_results_no_longer_requested_remain_and_are_not_counted(tmp_path: Path) -> None:
    made = Home(tmp_path, CONFIG.partition("work:")[0])
    made.run()
    before = set(made.read_write_times())
    made.config.write_text(made.config.read_text().replace("[early, peak]", "early"))
    files = run_accuracy_study(
        load_accuracy(made.config), made.folder, SilentDisplay(), lambda line: None, isolated=False
    )
    assert set(made.read_write_times()) == before
    moments = parquet_rows.read_rows(files, ACCURACY_SCHEMA)["snapshot"].to_pylist()
    assert set(moments) == {"early"}
    assert "snapshot" in parquet_rows.read_rows(files, ACCURACY_SCHEMA)["kind"].to_pylist()


def test_snapshots_of_one_step_are_measured_once(tmp_path: Path) -> None:
    made = Home(tmp_path, CONFIG.partition("work:")[0].replace("[early, peak]", "[2, early, middle]"))
    (tmp_path / "cloth.yaml").write_text(SCENE.replace("frames: 8", "frames: 2"))
    made.run()
    assert {row["snapshot"] for row in made.rows("curve")} == {"frame-2"}
    assert len(made.rows("snapshot")) == 1


def test_a_minimum_that_is_not_certified_is_reported_and_nothing_is_graded_by_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference_store, "find_minima", lambda problem, solver: KnownMinima((), "it ended on a saddle"))
    monkeypatch.setattr(
        reference_store,
        "refine_minimum",
        lambda problem, p, solver: replace(certify_minimum(problem, p), kind=INACCURATE),
    )
    made = Home(tmp_path, CONFIG.partition("work:")[0].replace("[early, peak]", "early"))
    made.run()
    (problem,) = made.rows("snapshot")
    assert (problem["status"], problem["reason"]) == ("uncertified", "it ended on a saddle")
    ended = made.rows("curve", solver="sparse")
    assert {row["status"] for row in ended} == {"uncertified"}
    assert all(row["position_error_max_m"] is None and row["objective"] is not None for row in ended)


def test_a_solver_that_fails_is_a_row_and_the_others_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SOLVERS, "broken", f"{__name__}:FailingAtOnce")
    made = Home(tmp_path, CONFIG.partition("work:")[0].replace("[sparse,", "[broken, sparse,"))
    made.run()
    for row in made.rows("curve", solver="broken"):
        assert row["status"] == "failed"
        assert "ArithmeticError: it slipped" in row["reason"]
    assert {row["status"] for row in made.rows("curve", solver="newton")} == {"ok"}


def run_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str
) -> tuple[int, str]:
    monkeypatch.setattr("sys.argv", ["springbench", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    captured = capsys.readouterr()
    return int(ended.value.code or 0), captured.out + captured.err


def test_the_command_measures_and_draws(
    home: Home, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is drawn of rows is tested with the reports; here, that each chart is drawn of these."""
    drawn: dict[str, ChartDescription] = {}

    def note_sheets(chart: ChartDescription, stem: Path) -> list[Path]:
        drawn[stem.name] = chart
        return [stem.with_suffix(".png")]

    monkeypatch.setattr(accuracy_report, "draw_chart_sheets", note_sheets)
    code, printed = run_command(
        capsys, monkeypatch, "accuracy", str(home.config), "--results", str(home.folder.parent), "--in-process"
    )
    assert code == 0, printed
    assert f"{UNITS} of {UNITS} units are there already" in printed
    assert set(drawn) == set(CHART_NAMES)
    assert drawn["convergence"].frames
    assert drawn["work"].frames
    assert (home.folder.parent / "index.html").is_file()
    assert (home.folder.parent / "site" / "data" / home.folder.name / "convergence.js").is_file()

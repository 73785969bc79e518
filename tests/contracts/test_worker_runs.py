"""A solver that crashes, hangs, swells or leaves is a row with its reason; the sweep goes on, and resumes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from time import sleep
from typing import Any, NamedTuple

import psutil
import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.results import parquet_rows
from typer.testing import CliRunner, Result

from tests.plugin_solvers import SWEEP_OPTIONS, PluginSweep, write_plugin_solver
from tests.rare_cases import mark_rare_cases

ROOT = Path(__file__).resolve().parents[2]


class Case(NamedTuple):
    """What a solver does while it solves, the status of its run, what is said of it, and the limit it runs into."""

    does: str
    status: str
    said: str
    limit: str = ""


CASES = {
    "a crash": Case("import ctypes; ctypes.string_at(0)", "failed", "crashed by SIGSEGV at {line} in solve"),
    "an abort": Case(
        "import os; print('out of luck', file=__import__('sys').stderr); os.abort()",
        "failed",
        "crashed by SIGABRT at {line} in solve, before its first step; it said: out of luck",
    ),
    "an exit by the system": Case("import os; os._exit(3)", "failed", "ended its process with exit code 3"),
    "an exit by Python": Case("raise SystemExit(0)", "failed", "raised SystemExit: 0 ({line})"),
    "the end of a generator": Case("raise GeneratorExit", "failed", "raised GeneratorExit ({line})"),
    "a kill": Case("import os; os.kill(os.getpid(), 9)", "killed", "was killed by SIGKILL"),
    "a loop": Case("while True: hang = 1", "time-limit", "did not end within 8 s", "time_limit: 8"),
    "too much memory": Case(
        "swollen = [bytes(2**20) for _ in range(2**12)]", "failed", "MemoryError ({line})", "memory_limit: 0.5"
    ),
}


def limit_run_time(made: PluginSweep, limit: str) -> int:
    """Limit the solver's run, and leave the other out, which a busy machine might keep as long; how many remain."""
    if limit:
        config_text = (
            made.sweep_path.read_text()
            .replace("[mine, sparse]", "[mine]")
            .replace("options: {", f"options: {{{limit}, ")
        )
        made.sweep_path.write_text(config_text)
    return 1 if limit else 2


def run_sweep_command(made: PluginSweep, *more: str) -> Result:
    return CliRunner().invoke(app, ["run", str(made.sweep_path), "--results", str(made.sweep_path.parent / "r"), *more])


def first_rows(made: PluginSweep) -> dict[str, dict[str, Any]]:
    """By solver, the first row of its run."""
    folder = made.sweep_path.parent / "r" / "sweep"
    found = (
        parquet_rows.read_first_row(RunFiles.for_run(run, folder).rows_path)
        for run in load_config(made.sweep_path).list_runs()
    )
    return {row["solver"]: row for row in found if isinstance(row, dict)}


@pytest.mark.parametrize("name", mark_rare_cases(CASES, ["a crash", "an exit by Python", "a loop", "too much memory"]))
def test_a_sweep_survives_its_solvers(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    case = CASES[name]
    made = write_plugin_solver(tmp_path, monkeypatch, solve_code=case.does)
    runs = limit_run_time(made, case.limit)
    result = run_sweep_command(made)
    assert result.exit_code == 1, result.output
    assert "Traceback" not in result.output
    found = first_rows(made)
    others = [row for solver, row in found.items() if solver != "mine"]
    assert [(row["status"], row["reason"]) for row in others] == [("ok", None)] * (runs - 1)
    mine = found["mine"]
    assert mine["status"] == case.status, mine["reason"]
    assert case.said.format(line=made.source_line(case.does)) in mine["reason"]
    assert mine["solver"] == "mine"
    again = run_sweep_command(made)
    assert again.exit_code == 1
    assert f"{runs} of {runs} runs are there already" in re.sub(r"\s+", " ", again.output)
    assert first_rows(made) == found


@pytest.mark.long
def test_a_run_that_took_too_long_is_done_again_with_another_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    flag = tmp_path / "quick"
    hangs = f"import pathlib\n        while not pathlib.Path({str(flag)!r}).exists(): hang = 1"
    made = write_plugin_solver(tmp_path, monkeypatch, solve_code=hangs)
    limit_run_time(made, "time_limit: 8")
    assert run_sweep_command(made).exit_code == 1
    flag.touch()
    assert "1 of 1 runs are there already" in re.sub(r"\s+", " ", run_sweep_command(made).output)
    made.sweep_path.write_text(made.sweep_path.read_text().replace("time_limit: 8", "time_limit: 800"))
    assert (result := run_sweep_command(made)).exit_code == 0, result.output
    assert {row["status"] for row in first_rows(made).values()} == {"ok"}


LONG = (
    "scenes: [scene.yaml]\nsolvers: [sparse]\noptions: {frames: 100000, rounds: 1, max_iterations: 50, record: false}\n"
)


@pytest.mark.parametrize("how", mark_rare_cases([signal.SIGKILL, signal.SIGTERM, signal.SIGINT], [signal.SIGKILL]))
def test_no_worker_stays_behind(how: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = write_plugin_solver(tmp_path, monkeypatch)
    made.sweep_path.write_text(LONG)
    process = subprocess.Popen(
        [sys.executable, "-m", "springbench", "run", str(made.sweep_path), "--results", str(tmp_path / "r")],
        cwd=ROOT,
        stderr=subprocess.DEVNULL,
        # A shell that started these tests in the background has made its children deaf to Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        parent, workers = psutil.Process(process.pid), []
        while not workers and process.poll() is None:
            sleep(0.01)
            workers = [child for child in parent.children(recursive=True) if is_busy_worker(child, parent)]
        assert workers, "it ended before it had a worker"
        process.send_signal(how)
        process.wait()
    finally:
        process.kill()  # else its run retains the timing lock for the tests that follow
    assert process.returncode == (130 if how == signal.SIGINT else -how)
    gone, alive = psutil.wait_procs(workers, timeout=60.0)
    assert gone
    assert not alive


def is_busy_worker(process: psutil.Process, parent: psutil.Process) -> bool:
    """Whether it is a fork of its parent that has computed for a while."""
    try:
        return process.name() == parent.name() and process.cpu_times().user > 0.3
    except psutil.NoSuchProcess:  # others come and go
        return False


def test_a_worker_stays_from_run_to_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    note = tmp_path / "note"
    does = f"import os; open({str(note)!r}, 'a').write(str(os.getpid()) + ' ')"
    made = write_plugin_solver(
        tmp_path, monkeypatch, solve_code=does, options=SWEEP_OPTIONS + ", rtol: [1e-2, 1e-3, 1e-4]"
    )
    assert (result := run_sweep_command(made, "--workers", "1")).exit_code == 0, result.output
    workers = set(note.read_text().split())
    assert len(workers) == 1
    assert str(os.getpid()) not in workers


def test_a_lost_drawing_process_fails_the_command_and_preserves_the_measurements(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from springbench.harness.experiments import sweep_runner
    from springbench.harness.report import sweep_pictures

    monkeypatch.setattr(sweep_runner, "preload_drawing", int)
    monkeypatch.setattr(
        sweep_pictures, "draw_sweep_pictures", leave
    )  # where it draws: that process is a fork of this one
    made = write_plugin_solver(tmp_path, monkeypatch, options="frames: 1, rounds: 1, max_iterations: 5")
    result = run_sweep_command(made)
    assert result.exit_code == 1
    assert "the process that draws ended its process with exit code 3" in " ".join(result.output.split())
    assert len([*(tmp_path / "r").rglob("*.parquet")]) == 2


def leave(*_: Any, **__: Any) -> None:
    """End the process."""
    os._exit(3)


# The last ones, which run in this process: after that no worker is a fork of it, and each takes seconds to begin.


def test_a_debugger_can_have_the_runs_in_its_own_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = write_plugin_solver(tmp_path, monkeypatch, solve_code="import os; globals()['seen'] = os.getpid()")
    assert (result := run_sweep_command(made)).exit_code == 0, result.output
    module = made.solver_path.stem
    assert not hasattr(sys.modules.get(module), "seen")
    assert run_sweep_command(made, "--rerun", "--in-process").exit_code == 0
    assert sys.modules[module].seen == os.getpid()


def test_the_plot_of_times_has_the_name_of_its_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from springbench.harness.report import timing_plot

    def write_title(table: Any, path: Path, title: str, *_: Any) -> None:
        (tmp_path / "title.txt").write_text(title)

    monkeypatch.setattr(timing_plot, "draw_timing_plot", write_title)
    made = write_plugin_solver(tmp_path, monkeypatch, options="frames: 1, rounds: 1, max_iterations: 5, record: false")
    assert (result := run_sweep_command(made, "--in-process")).exit_code == 0, result.output
    assert (tmp_path / "title.txt").read_text() == "sweep"

"""A solver is checked once a run, off the clock, and what it did wrong is said of its own line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pytest
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.reference.residual_audit import AuditedSolver
from springbench.harness.report.sweep_summary import SOLVED_RESIDUAL, summarise_sweep
from springbench.harness.report.timing_table import read_run_times as runs_of
from springbench.harness.results.run_schema import RUN_SCHEMA
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation import timing_pass
from springbench.harness.simulation.solver_contract import DelegatingSolver
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Solution, StepProblem, StopRule

from tests.plugin_solvers import SWEEP_OPTIONS, PluginSweep, write_plugin_solver

CONFIGS = Path(__file__).parents[2] / "configs"


def rows_of(made: PluginSweep, folder: Path) -> list[dict[str, Any]]:
    (folder / "rows").mkdir()
    spec = made.plugin_run()
    return execute_run(spec, RunFiles.for_run(spec, folder), lambda phase: None)


def test_a_correct_solver_is_ok_and_verified_by_the_reference_evaluator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    found = rows_of(write_plugin_solver(tmp_path, monkeypatch), tmp_path)
    assert {row["status"] for row in found} == {"ok"}
    graded = {row["frame"]: row["stationarity_audit"] for row in found if row["phase"] == "step"}
    assert all(0.0 < graded[frame] < 1.0 for frame in (1, 2, 3))  # it descends in five iterations


def test_a_solver_with_only_what_the_readme_requires_is_verified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    found = rows_of(write_plugin_solver(tmp_path, monkeypatch, options=SWEEP_OPTIONS + ", verify: true"), tmp_path)
    steps = [row for row in found if row["phase"] == "step"]
    assert len(steps) == 3
    for row in steps:
        assert row["stationarity"] >= 0.0
        assert np.isfinite(row["reference_distance"])


class Wrong(NamedTuple):
    """What a solver does, the line that is blamed (its code; "" for none), and what is said."""

    does: str
    line: str
    said: str


NOTHING = "return Solution(problem.initial_guess.copy(), 1, 0.0, 0.0, 'tolerance')"
WRONG = {
    "does nothing and says that nothing is left": Wrong(NOTHING, "", "Mine: reports a residual of 0 J^(1/2); expected"),
    "says that it reached the tolerance": Wrong(
        "return replace(found, termination_reason='converged')", "", "and the reason `converged`; expected"
    ),
    "says a residual that is too small": Wrong("return replace(found, residual=found.residual / 100)", "", "reports a"),
    "says no residual": Wrong("return replace(found, residual=float('nan'))", "", "reports a residual of nan"),
    "float32": Wrong(
        "return replace(found, positions=found.positions.astype(np.float32))",
        "def solve",
        "gave positions as float32 of shape (16, 3); expected float64 of shape (16, 3)",
    ),
    "another shape": Wrong(
        "return replace(found, positions=found.positions.ravel())",
        "def solve",
        "gave positions as float64 of shape (48,); expected float64 of shape (16, 3)",
    ),
    "a list": Wrong("return replace(found, positions=[])", "def solve", "gave positions as a list; expected float64"),
    "no answer": Wrong(
        "return None", "def solve", "gave a NoneType; expected a springbench.solvers.model.step_problem.Solution"
    ),
    "writes to the target": Wrong(
        "problem.inertial_target[:] += 0.1", "problem.inertial_target", "wrote to problem.inertial_target"
    ),
    "writes to the velocity": Wrong(
        "problem.step_start.velocity[0] = 3.0", "problem.step_start", "wrote to problem.step_start.velocity"
    ),
    "writes to the springs": Wrong(
        "e = self.sound.system.energies[0]; e.stiffness.flags.writeable = True; e.stiffness[:] *= 2",
        "def solve",
        "wrote to Springs.stiffness",
    ),
    "not finite": Wrong("return replace(found, positions=found.positions * np.nan)", "", "not finite from frame 1"),
    "an error of its own": Wrong("raise LookupError('mine')", "raise LookupError", "LookupError: mine"),
    "an error of ours": Wrong(
        "problem.gradient(found.positions.ravel())", "problem.gradient", "ValueError: operands could not be broadcast"
    ),
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_what_a_solver_does_wrong_while_it_solves_is_reported(
    wrong: Wrong, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = write_plugin_solver(tmp_path, monkeypatch, solve_code=wrong.does)
    (row,) = rows_of(made, tmp_path)
    assert row["status"] == ("diverged" if "not finite" in wrong.said else "failed")
    assert row["frame"] == 1
    assert wrong.said in row["reason"]
    if wrong.line:
        assert made.source_line(wrong.line) in row["reason"]


def test_what_a_solver_writes_to_while_it_prepares_itself_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    does = "system.mass.flags.writeable = True; system.mass[:] *= 2"
    made = write_plugin_solver(tmp_path, monkeypatch, prepare_code=does)
    (row,) = rows_of(made, tmp_path)
    assert row["status"] == "failed"
    assert "wrote to system.mass" in row["reason"]
    assert made.source_line("def prepare") in row["reason"]


def test_a_solver_that_cannot_write_is_reported_with_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = write_plugin_solver(
        tmp_path, monkeypatch, prepare_code="system.mass.flags.writeable = False; system.mass[:] = 2"
    )
    (row,) = rows_of(made, tmp_path)
    assert f"({made.source_line('system.mass')})" in row["reason"]


def test_checks_take_no_timed_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The solver that the timed passes use is the one that was prepared, without anything around it."""
    seen = []

    def spy_measurement(*arguments: Any) -> Any:
        measured = sound(*arguments)
        seen.append(type(measured.prepared).__module__)
        return measured

    sound = timing_pass.measure_run
    monkeypatch.setattr(timing_pass, "measure_run", spy_measurement)
    made = write_plugin_solver(tmp_path, monkeypatch)
    rows_of(made, tmp_path)
    assert seen == [made.solver_path.stem]


TURNING = """
mesh:
  kind: network
  positions: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
  springs: [[0, 1], [1, 3], [3, 2], [2, 0], [0, 3], [1, 2]]
mass: 1
time_step: 1/10
frames: 3
velocity: [0.0, 0.0, 10.0]
effects:
  - {kind: springs, stretch: 1000}
  - {kind: pins, indices: [0], weight: exact}
"""


PRESTRESSED_SCENE = """
mesh:
  kind: network
  positions: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
  springs: [[0, 1], [1, 3], [3, 2], [2, 0], [0, 3], [1, 2]]
  force_density: [100, 100, 100, 100, -100, -100]
  stiffness: [10000, 10000, 10000, 10000, 1000000, 1000000]
mass: 1
time_step: 1/10
frames: 3
effects: [{kind: springs}]
"""
"""Four cables and two struts in self-stress: the start is an equilibrium."""


class ClaimsNothingLeft(DelegatingSolver):
    """A prepared solver that reports a residual of zero."""

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        return replace(self._prepared.solve(problem, stop), residual=0.0)


def test_a_reported_residual_is_not_compared_where_the_gradient_is_round_off():
    """At 3e12 N m round-off leaves a thousandth of the initial residual, which evaluations of it disagree about."""
    scene = build_scene(load_scene(CONFIGS / "hard" / "effects-bending-1e12.yaml"), 6)
    audited = AuditedSolver(ClaimsNothingLeft(prepare(scene, NewtonSolver())), NewtonSolver(), {1})
    step = next(simulate_scene(scene, audited, StopRule(300, 1e-6), initial_guess="previous", frames=1))
    assert step.solution.termination_reason == "roundoff"
    assert audited.found[1]["stationarity_audit"] > 1e-4


@pytest.mark.parametrize(
    ("scene", "newton"), [(TURNING, 1e-6), (PRESTRESSED_SCENE, 1.0)], ids=["springs that turn", "prestress"]
)  # of an equilibrium round-off is left, of what was round-off before
def test_the_stationarity_of_a_solver_that_does_not_minimise_is_reported(scene: str, newton: float, tmp_path: Path):
    """XPBD ends elsewhere than at the minimum, however many iterations it takes."""
    (tmp_path / "scene.yaml").write_text(scene)
    (tmp_path / "rows").mkdir()
    options: dict[str, Any] = {"solvers": ["xpbd", "newton"], "rounds": 1, "record": False, "max_iterations": 2000}
    found = list[dict[str, Any]]()
    for spec in load_config(tmp_path / "scene.yaml", **options).list_runs():
        found += execute_run(spec, RunFiles.for_run(spec, tmp_path), lambda phase: None)
    left = {row["solver"]: row["stationarity_audit"] for row in found if row["phase"] == "step" and row["frame"] == 3}
    assert left["newton"] < newton
    assert left["xpbd"] > SOLVED_RESIDUAL
    assert all(row.get("residual") is None for row in found if row["solver"] == "xpbd")
    said = " ".join(summarise_sweep(runs_of(pa.Table.from_pylist(found, RUN_SCHEMA))))
    assert "xpbd on scene does not converge to the minimum of a step's objective" in said
    assert "newton on scene does not" not in said

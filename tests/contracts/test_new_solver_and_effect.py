"""A new solver and a new effect are one file each: nothing else names any of them."""

from __future__ import annotations

import ast
import json
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from springbench.harness.config.accuracy_loader import load_accuracy
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.json_schema import build_json_schema
from springbench.harness.experiments.ablation.ablation_unit import build_evidence, suggest_effects
from springbench.harness.experiments.accuracy.accuracy_study import run_accuracy_study
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.report.accuracy_report import draw_accuracy_report
from springbench.harness.report.plot_style import assign_solver_styles
from springbench.harness.report.robustness import CORRECT, read_verified_runs
from springbench.harness.report.site import update_page
from springbench.harness.report.timing_plot import draw_timing_plot
from springbench.harness.report.timing_table import build_summary_table, read_run_times
from springbench.harness.scenes.effects.effect_interface import EffectContribution, ObservedMotion, build_constant_force
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.registry import SOLVERS

from tests.progress_displays import SilentDisplay
from tests.scene_builders import build_cloth

ROOT = Path(__file__).resolve().parents[2]

DEFAULTS = {"numba", "hybrid", "newton"}
"""Solvers that run by default, or that verify others: all that are named in code, and in no report."""

SCENE = """
mesh: {kind: chain, length: 2.0}
mass: 1.0
time_step: 1/30
frames: 2
default_size: 4
effects: [{kind: springs, stretch: 200}, {kind: hum, force: 0.5}, {kind: pins, parts: [ends]}]
"""
SWEEP = """
scenes: [chain.yaml]
solvers: [mine, sparse]
options: {rtol: 1e-8, max_iterations: 3000, record: false, pictures: false, verify: true, rounds: 1}
"""
ACCURACY = """
scenes: [chain.yaml]
solvers: [mine, sparse]
curves: [{snapshot: 1, initial_guess: previous, rounds: 1, max_iterations: 200}]
work: [{t_end: 0.1, rounds: 1}]
"""


@dataclass(frozen=True)
class OwnSolver(SparseLocalGlobal):
    """A method from user code."""

    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "of my own", Citation("Noether, Emmy", 1918, "Invariante Variationsprobleme")
    )


class Hum(ConfigModel):
    """A force on every vertex, and what calls for it."""

    kind: Literal["hum"] = "hum"
    force: float

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        return EffectContribution(forces=build_constant_force(np.full_like(mesh.rest_positions, self.force)))

    @classmethod
    def find_evidence(cls, seen: ObservedMotion) -> str:
        return f"nothing is heard in {len(seen.positions)} frames"


@pytest.fixture(autouse=True)
def registered_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SOLVERS, "mine", f"{__name__}:OwnSolver")
    monkeypatch.setitem(EFFECT_CLASSES, "hum", f"{__name__}:Hum")


@pytest.fixture
def configs(tmp_path: Path) -> Path:
    for name, text in (("chain", SCENE), ("sweep", SWEEP), ("accuracy", ACCURACY)):
        (tmp_path / f"{name}.yaml").write_text(text)
    return tmp_path


def constants(folder: str) -> set[str]:
    """All strings in the code of a folder, documentation apart where it says more than a name.

    Type checkers need the names as literals: `typed_keys.py` has them, and a test compares them to the tables.
    """
    trees = (ast.parse(path.read_text()) for path in (ROOT / folder).rglob("*.py") if path.name != "typed_keys.py")
    return {
        n.value for tree in trees for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)
    }


def test_no_report_and_little_else_refers_to_a_solver_by_name():
    assert not constants("harness/report") & set(SOLVERS)
    # `sparse` is an option of a peer's, for its own linear solver.
    assert constants("harness") & set(SOLVERS) - {"sparse"} == DEFAULTS


@pytest.mark.parametrize("folder", ["report", "experiments"])
def test_no_report_and_no_experiment_refers_to_an_effect_by_name(folder: str):
    # `springs` is a column of rows: how many a mesh has.
    assert constants(f"harness/{folder}") & set(EFFECT_CLASSES) <= {"springs"}


def test_a_sweep_and_its_reports_take_a_new_solver_and_effect(configs: Path):
    import pyarrow as pa
    from springbench.harness.results.run_schema import RUN_SCHEMA

    found = []
    (configs / "rows").mkdir()
    for run in load_config(configs / "sweep.yaml").list_runs():
        found += execute_run(run, RunFiles.for_run(run, configs), lambda phase: None)
    mine = next(row for row in found if row["solver"] == "mine")
    assert (mine["status"], mine["family"], mine["is_minimiser"]) == ("ok", "of my own", True)
    assert json.loads(mine["citation"])["year"] == 1918
    cells = {cell.solver: cell for cell in read_verified_runs(configs)}
    assert cells["mine"].outcome == cells["sparse"].outcome == CORRECT
    table = pa.Table.from_pylist(found, schema=RUN_SCHEMA)
    draw_timing_plot(table, configs / "timing.png", "Time")
    assert "mine: Noether 1918" in str(build_summary_table(read_run_times(table), table).caption)


def test_the_accuracy_report_takes_a_new_solver_and_effect(configs: Path):
    requested = load_accuracy(configs / "accuracy.yaml")
    files = run_accuracy_study(requested, configs / "results", SilentDisplay(), lambda line: None, isolated=False)
    drawn = {path.name: path for path in draw_accuracy_report(configs / "results", files)}
    assert "@misc{noether1918," in drawn["references.bib"].read_text()
    assert "mine: Noether 1918, Invariante Variationsprobleme" in drawn["findings.md"].read_text()
    update_page(configs / "results")
    script_text = (configs / "results" / "site" / "data" / "this" / "work.js").read_text()
    assert "Noether 1918" in script_text


def test_a_new_solver_has_a_style_of_its_own():
    looks = assign_solver_styles()
    assert looks["mine"] not in [look for name, look in looks.items() if name != "mine"]
    assert looks["mine"].color not in {look.color for name, look in looks.items() if name != "mine"}
    assert looks["mine"] == assign_solver_styles(["yours", "one more"])["mine"]


def test_a_motion_calls_for_a_new_effect():
    made = build_cloth(3)
    still = np.tile(made.mesh.rest_positions, (2, 1, 1))
    found = {s.effect_kind: s.evidence for s in suggest_effects(build_evidence(made, set(), still, 0.0 * still), set())}
    assert found["hum"] == "nothing is heard in 2 frames"
    assert "hum" not in {
        s.effect_kind for s in suggest_effects(build_evidence(made, {"hum"}, still, 0.0 * still), {"hum"})
    }


def test_the_schema_has_both():
    text = json.dumps(build_json_schema())
    assert '"mine"' in text
    assert '"hum"' in text

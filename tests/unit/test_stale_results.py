"""Rows of other code are never shown as today's without a note, and can be repeated."""

from __future__ import annotations

import os
import re
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from springbench.harness.cli.main import app
from springbench.harness.config import solver_parameters
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments import run_pipeline as run_module
from springbench.harness.experiments.provenance import (
    collect_source_parts,
    compute_source_fingerprint,
    list_source_files,
)
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.solvers.iteration import device_interface
from springbench.solvers.jit import source_digest
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, load_target
from typer.testing import CliRunner

from tests.plugin_solvers import SCENE_SOURCE, SWEEP_OPTIONS, PluginSweep, write_plugin_solver


@pytest.fixture
def changed_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PluginSweep:
    """A sweep of two solvers that was run, and one of them changed since."""
    made = write_plugin_solver(tmp_path, monkeypatch)
    result = run_command(made)
    assert "other code" not in result
    made.solver_path.write_text(made.solver_path.read_text() + "\n# changed\n")
    return made


def run_command(made: PluginSweep, *options: str) -> str:
    """What the command says, in lines without breaks."""
    result = CliRunner().invoke(
        app, ["run", str(made.sweep_path), "--in-process", "--results", str(made.sweep_path.parent / "r"), *options]
    )
    assert result.exit_code == 0, result.output
    return re.sub(r"\s+", " ", result.output)


def read_write_times(made: PluginSweep) -> dict[str, int]:
    """When each solver's rows were written [ns]."""
    folder = made.sweep_path.parent / "r" / "sweep"
    return {
        run.solver.name: RunFiles.for_run(run, folder).rows_path.stat().st_mtime_ns
        for run in load_config(made.sweep_path).list_runs()
    }


def test_a_run_names_rows_of_other_code_and_the_table_marks_them(changed_sweep: PluginSweep):
    before = read_write_times(changed_sweep)
    result = run_command(changed_sweep)
    assert "2 of 2 runs are there already" in result
    assert "1 of them by other code than today's: scene 4 mine --rerun-stale does these again" in result
    assert re.search(r" 4 mine [^a-z]+ max-iter† ", result)
    assert "† by other code than today's" in result
    assert re.search(r" 4 sparse [^a-z]+ max-iter [^†]", result)
    assert read_write_times(changed_sweep) == before


@pytest.mark.parametrize(("option", "redone"), [("--rerun-stale", {"mine"}), ("--rerun", {"mine", "sparse"})])
def test_other_code_s_rows_are_done_again_on_request(changed_sweep: PluginSweep, option: str, redone: set[str]):
    before = read_write_times(changed_sweep)
    assert "other code" not in run_command(changed_sweep, option)
    after = read_write_times(changed_sweep)
    assert {name for name in after if after[name] != before[name]} == redone
    assert "other code" not in run_command(changed_sweep)


def test_the_code_of_a_row_covers_the_solver_s_module_wherever_it_lives(changed_sweep: PluginSweep):
    for path in (changed_sweep.sweep_path.parent / "r" / "sweep" / "rows").iterdir():
        row = pq.read_table(path).slice(0, 1).to_pylist()[0]
        (run,) = (run for run in load_config(changed_sweep.sweep_path).list_runs() if run.solver.name == row["solver"])
        assert (row["source_fingerprint"] == compute_source_fingerprint(collect_source_parts(run))) == (
            row["solver"] == "sparse"
        )


def test_a_run_depends_on_its_own_solver_and_effects_and_on_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = write_plugin_solver(tmp_path, monkeypatch)
    run = made.plugin_run()
    reached = {
        path
        for part in collect_source_parts(run)
        for file in list_source_files(part)
        for path in source_digest.find_dependencies(str(file))
    }
    reached |= source_digest.find_dependencies(str(Path(run_module.__file__).resolve()))
    names = {"/".join(Path(path).parts[-2:]) for path in reached}
    assert str(made.solver_path) in reached
    assert {
        "local_global/reference_local_global.py",
        "effects/springs_effect.py",
        "effects/gravity_effect.py",
        "mesh/grid_mesh.py",
    } <= names
    others = {
        str(file)
        for name in ("xpbd", "vbd", "newton")
        for file in source_digest.find_class_sources(load_target(SOLVERS[name]))
    }
    assert reached & others <= {
        str(Path(device_interface.__file__).resolve())
    }  # which all query whether a solver is on one
    assert not names & {
        "effects/wind_effect.py",
        "effects/gas_effect.py",
        "mesh/chain_mesh.py",
        "cli/main.py",
        "error_control/method_search.py",
    }
    to_error = collect_source_parts(run.model_copy(update={"error_target": 0.1}))
    assert {"error_controlled_run.py"} == {
        file.name for part in to_error - collect_source_parts(run) for file in list_source_files(part)
    }


def test_the_code_of_a_run_covers_what_its_solver_compiles_in_another_language(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = write_plugin_solver(tmp_path, monkeypatch)
    for name in ("another", made.solver_path.stem):
        before = compute_source_fingerprint(collect_source_parts(made.plugin_run()))
        made.solver_path.with_name(f"{name}.hpp").write_text("import what;\n")
        source_digest.find_dependencies.cache_clear()
        source_digest._find_imports.cache_clear()
        source_digest._sorted_dependencies.cache_clear()
        assert (compute_source_fingerprint(collect_source_parts(made.plugin_run())) != before) == (
            name == made.solver_path.stem
        )
    (eigen,) = source_digest.find_class_sources(load_target(OPTIONAL_SOLVERS["eigen"]))
    assert {str(eigen.with_suffix(ending)) for ending in (".cpp", ".hpp")} <= source_digest.find_dependencies(
        str(eigen)
    )


def test_pictures_are_drawn_later_without_a_run_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = write_plugin_solver(tmp_path, monkeypatch, options=SWEEP_OPTIONS.replace("record: false", "record: true"))
    run_command(made)
    before = read_write_times(made)
    made.sweep_path.write_text(made.sweep_path.read_text().replace("pictures: false", "pictures: true"))
    result = run_command(made)
    assert "2 of 2 runs are there already" in result
    assert read_write_times(made) == before
    assert len([*(tmp_path / "r" / "sweep" / "pictures").glob("scene-4-*-????????????.png")]) == 2


def test_parameters_by_other_sources_coexist_for_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "scene.yaml").write_text(SCENE_SOURCE)
    (tmp_path / "sweep.yaml").write_text("scenes: [scene.yaml]\nsolvers: [sparse]\n")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder, saved = tmp_path / "springbench" / "parameters", dict[str, Path]()
    for checkout in "abc":
        monkeypatch.setattr(solver_parameters, "_hash_solver_sources", lambda checkout=checkout: 16 * checkout)
        load_config(tmp_path / "sweep.yaml", imports_code=False)
        (saved[checkout],) = set(folder.iterdir()) - set(saved.values())
        if checkout == "b":
            assert set(folder.iterdir()) == set(saved.values())
            os.utime(saved["a"], (0, 0))
    assert set(folder.iterdir()) == {saved["b"], saved["c"]}


def test_the_file_of_a_class_is_known_however_its_module_was_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "by_hand.py"
    path.write_text("class Mine:\n    def prepare(self, system):\n        return None\n")
    by_hand = spec_from_file_location("by_hand", path)
    assert by_hand
    assert by_hand.loader
    module = module_from_spec(by_hand)
    by_hand.loader.exec_module(module)
    assert source_digest.find_class_sources(module.Mine) == {path}
    monkeypatch.setitem(sys.modules, "by_hand", module)
    monkeypatch.setattr(source_digest, "_LIBRARY_FOLDERS", {str(tmp_path)})  # as a package that brings a solver is
    source_digest.find_class_sources.cache_clear()
    assert source_digest.find_class_sources(module.Mine) == {path}

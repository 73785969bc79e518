"""Rows of other code are never shown as today's without a word, and can be made anew."""

from __future__ import annotations

import os
import re
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from harness.cli import app
from harness.config import solvers
from harness.config.load import load_any
from harness.experiments import run as run_module
from harness.experiments.code import code, files, parts
from harness.experiments.plan import Files
from solvers import device, sources
from solvers.registry import OPTIONAL, SOLVERS, load
from tests.own_solvers import OPTIONS, SCENE, Own, own


@pytest.fixture
def done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Own:
    """A sweep of two solvers that was run, and one of them changed since."""
    made = own(tmp_path, monkeypatch)
    told = ran(made)
    assert "other code" not in told
    made.solver.write_text(made.solver.read_text() + "\n# changed\n")
    return made


def ran(made: Own, *options: str) -> str:
    """What the command says, in lines without breaks."""
    told = CliRunner().invoke(
        app, ["run", str(made.sweep), "--here", "--results", str(made.sweep.parent / "r"), *options]
    )
    assert told.exit_code == 0, told.output
    return re.sub(r"\s+", " ", told.output)


def started(made: Own) -> dict[str, int]:
    """When each solver's rows were written [ns]."""
    folder = made.sweep.parent / "r" / "sweep"
    return {run.solver.name: Files.of(run, folder).rows.stat().st_mtime_ns for run in load_any(made.sweep).runs()}


def test_run_says_which_rows_are_of_other_code_and_the_table_marks_them(done: Own):
    before = started(done)
    told = ran(done)
    assert "2 of 2 runs are there already" in told
    assert "1 of them by other code than today's: scene 4 mine --changed does these again" in told
    assert re.search(r" 4 mine [^a-z]+ iterations† ", told)
    assert "† by other code than today's" in told
    assert re.search(r" 4 sparse [^a-z]+ iterations [^†]", told)
    assert started(done) == before


@pytest.mark.parametrize(("option", "redone"), [("--changed", {"mine"}), ("--again", {"mine", "sparse"})])
def test_other_code_s_rows_are_done_again_on_request(done: Own, option: str, redone: set[str]):
    before = started(done)
    assert "other code" not in ran(done, option)
    after = started(done)
    assert {name for name in after if after[name] != before[name]} == redone
    assert "other code" not in ran(done)


def test_the_code_of_a_row_covers_the_solver_s_module_wherever_it_lives(done: Own):
    for path in (done.sweep.parent / "r" / "sweep" / "rows").iterdir():
        row = pq.read_table(path).slice(0, 1).to_pylist()[0]
        (run,) = (run for run in load_any(done.sweep).runs() if run.solver.name == row["solver"])
        assert (row["code"] == code(parts(run))) == (row["solver"] == "sparse")


def test_a_run_depends_on_its_own_solver_and_effects_and_on_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = own(tmp_path, monkeypatch)
    run = made.run()
    reached = {path for part in parts(run) for file in files(part) for path in sources.reached(str(file))}
    reached |= sources.reached(run_module.__file__)
    names = {"/".join(Path(path).parts[-2:]) for path in reached}
    assert str(made.solver) in reached
    assert {"methods/local_global.py", "effects/springs.py", "effects/gravity.py", "mesh/grid.py"} <= names
    others = {str(file) for name in ("xpbd", "vbd", "newton") for file in sources.of_class(load(SOLVERS[name]))}
    assert reached & others <= {device.__file__}  # which all ask whether a solver is on one
    assert not names & {"effects/wind.py", "effects/gas.py", "mesh/chain.py", "harness/cli.py", "asked/search.py"}
    to_error = parts(run.model_copy(update={"accuracy": 0.1}))
    assert {"kept.py"} == {file.name for part in to_error - parts(run) for file in files(part)}


def test_the_code_of_a_run_covers_what_its_solver_compiles_in_another_language(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = own(tmp_path, monkeypatch)
    for name in ("another", made.solver.stem):
        before = code(parts(made.run()))
        made.solver.with_name(f"{name}.hpp").write_text("import what;\n")
        sources.reached.cache_clear()
        sources._imported.cache_clear()
        sources._reached_by.cache_clear()
        assert (code(parts(made.run())) != before) == (name == made.solver.stem)
    (eigen,) = sources.of_class(load(OPTIONAL["eigen"]))
    assert {str(eigen.with_suffix(ending)) for ending in (".cpp", ".hpp")} <= sources.reached(str(eigen))


def test_pictures_are_drawn_later_without_a_run_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = own(tmp_path, monkeypatch, options=OPTIONS.replace("record: false", "record: true"))
    ran(made)
    before = started(made)
    made.sweep.write_text(made.sweep.read_text().replace("pictures: false", "pictures: true"))
    told = ran(made)
    assert "2 of 2 runs are there already" in told
    assert started(made) == before
    assert len([*(tmp_path / "r" / "sweep" / "pictures").glob("scene-4-*-????????????.png")]) == 2


def test_parameters_by_other_sources_are_kept_beside_each_other_for_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "sweep.yaml").write_text("scenes: [scene.yaml]\nsolvers: [sparse]\n")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for checkout in "ab":
        monkeypatch.setattr(solvers, "_of_sources", lambda checkout=checkout: 16 * checkout)
        load_any(tmp_path / "sweep.yaml", opens=False)
    kept = {path.stem: path for path in (tmp_path / "springbench" / "parameters").iterdir()}
    assert set(kept) == {f"sparse-{16 * checkout}" for checkout in "ab"}

    os.utime(kept.pop(f"sparse-{16 * 'a'}"), (0, 0))
    monkeypatch.setattr(solvers, "_of_sources", lambda: 16 * "c")
    load_any(tmp_path / "sweep.yaml", opens=False)
    assert {path.stem[-1] for path in (tmp_path / "springbench" / "parameters").iterdir()} == {"b", "c"}


def test_the_file_of_a_class_is_known_however_its_module_was_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "by_hand.py"
    path.write_text("class Mine:\n    def prepare(self, system):\n        return None\n")
    by_hand = spec_from_file_location("by_hand", path)
    assert by_hand
    assert by_hand.loader
    module = module_from_spec(by_hand)
    by_hand.loader.exec_module(module)
    assert sources.of_class(module.Mine) == {path}
    monkeypatch.setitem(sys.modules, "by_hand", module)
    monkeypatch.setattr(sources, "_INSTALLED", {str(tmp_path)})  # as a package that brings a solver is
    sources.of_class.cache_clear()
    assert sources.of_class(module.Mine) == {path}

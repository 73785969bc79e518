"""`springbench new` writes a study that loads as it is, and overwrites nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config
from typer.testing import CliRunner

TEMPLATE = Path(__file__).resolve().parents[2] / "configs" / "templates" / "new-study"


@pytest.fixture
def study(tmp_path: Path) -> Path:
    answer = CliRunner().invoke(app, ["new", str(tmp_path / "my-study")])
    assert answer.exit_code == 0, answer.output
    assert "springbench run compare.yaml" in answer.output
    return tmp_path / "my-study"


def test_a_new_study_has_the_files_of_the_template_and_the_schema(study: Path):
    assert {path.name for path in study.iterdir()} == {path.name for path in TEMPLATE.iterdir()} | {"schema.json"}
    assert (study / "README.md").read_text().startswith("# my-study\n")
    for name in ("cloth.yaml", "compare.yaml"):
        assert (study / name).read_text().startswith("# yaml-language-server: $schema=schema.json\n")


def test_the_sweep_of_a_new_study_names_its_solver(study: Path):
    runs = load_config(study / "compare.yaml", imports_code=False).list_runs()
    assert [run.solver.name for run in runs if run.size == 6] == ["sparse", "./own_solver.py:HeavyBall", "newton"]


def test_a_folder_with_files_is_left_as_it_is(study: Path):
    (study / "cloth.yaml").write_text("mine")
    answer = CliRunner().invoke(app, ["new", str(study)])
    assert (answer.exit_code, (study / "cloth.yaml").read_text()) == (2, "mine")
    assert "exists and is not an empty folder" in answer.output


def test_an_empty_folder_is_filled(tmp_path: Path):
    assert CliRunner().invoke(app, ["new", str(tmp_path)]).exit_code == 0
    assert (tmp_path / "compare.yaml").is_file()

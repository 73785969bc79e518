"""`springbench list` distinguishes runs, and names what ships; `--version` and `-h`."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.cli import source_texts
from springbench.harness.cli.early_start import start_early
from springbench.harness.cli.main import app
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.mesh.mesh_table import MESH_CLASSES
from springbench.solvers.model.integrators import INTEGRATORS
from springbench.solvers.registry import SOLVERS
from typer.testing import CliRunner

SWEEP = """
scenes: [{scene}]
sizes: [5, 6]
solvers: [sparse, {{name: lbfgs, history_size: 3}}, {{name: lbfgs, history_size: 5}}]
options: {{rtol: [1e-2, 1e-3], frames: 2}}
"""
SCENE = Path(__file__).resolve().parents[2] / "configs" / "scenes" / "hanging-cloth.yaml"


def test_runs_are_listed_with_the_settings_in_which_they_differ(tmp_path: Path):
    (tmp_path / SCENE.name).write_text(SCENE.read_text())
    (tmp_path / "sweep.yaml").write_text(SWEEP.format(scene=SCENE.name))
    listed = CliRunner().invoke(app, ["list", str(tmp_path / "sweep.yaml"), "--results", str(tmp_path)])
    heading, _, *lines = listed.stdout.splitlines()[:-1]
    columns = ["run", "scene", "size", "solver", "max_iterations", "rtol", "threads", "frames", "history_size", "state"]
    assert heading.split() == columns
    without_hash = {line.split(maxsplit=1)[1] for line in lines}
    assert len(without_hash) == len(lines) == 2 * 3 * 2


def test_everything_that_ships_is_listed_with_a_sentence():
    lines = CliRunner().invoke(app, ["list"]).stdout.splitlines()
    for table in (SOLVERS, INTEGRATORS, EFFECT_CLASSES, MESH_CLASSES):
        for name in table:
            (line,) = [line for line in lines if line.startswith(f"  {name} ")]
            assert line.removeprefix(f"  {name}").strip()


@pytest.mark.parametrize("command", ["list", "schema"])
def test_a_command_without_arguments_prints_the_same_before_typer_is_imported(
    command: str, capsys: pytest.CaptureFixture[str]
):
    assert start_early([command])
    assert capsys.readouterr().out == CliRunner().invoke(app, [command]).stdout
    assert not start_early([command, "--help"])
    assert capsys.readouterr() == ("", "")


def test_an_early_error_is_reported_as_that_of_a_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail(*_: object) -> str:
        raise InputError("a plug-in is odd")

    monkeypatch.setattr(source_texts, "read_cached_text", fail)
    with pytest.raises(SystemExit) as early:
        start_early(["list"])
    assert early.value.code == CliRunner().invoke(app, ["list"]).exit_code == InputError.exit_code
    assert capsys.readouterr().err.startswith("springbench: a plug-in is odd")


def test_the_version_and_short_help():
    assert CliRunner().invoke(app, ["--version"]).stdout.startswith("springbench 0.")
    for arguments in (["-h"], ["run", "-h"]):
        assert "Usage:" in CliRunner().invoke(app, arguments).stdout

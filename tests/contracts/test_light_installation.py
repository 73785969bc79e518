"""Without Rerun, PyVista and VTK: what needs none of them works, and all else names the command that installs it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest
from springbench.harness.execution.optional_parts import OPTIONAL_PARTS
from springbench.requirements import LIGHT_EXTRAS, list_light_requirements

ROOT = Path(__file__).resolve().parents[2]

BLOCK = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in BLOCKED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker())
"""
"""Imports that fail, in a process and in its workers."""

SCRIPT = """
import json, sys
import springbench
from springbench.harness.cli.main import app
from typer.testing import CliRunner

for name in springbench.__all__:
    getattr(springbench, name)
scene = springbench.load_scene("net")
springbench.Simulation(scene, "sparse", size=4).step()
answers = []
for command in json.loads(sys.argv[1]):
    answer = CliRunner().invoke(app, command.split())
    answers.append([answer.exit_code, answer.output])
print("\\n" + json.dumps(answers))
"""
RECORD, PICTURES = 'pip install "springbench[record]"', 'pip install "springbench[pictures]"'


class CommandResult(NamedTuple):
    code: int
    text: str


COMMANDS: dict[str, CommandResult] = {
    "run net --size 4 --frames 2 --solver sparse --in-process": CommandResult(0, RECORD),
    "list net": CommandResult(0, "missing"),
    "report": CommandResult(0, "index.html"),
    "figure timing results/net": CommandResult(0, "timing.pdf"),
    "figure run results/net": CommandResult(2, PICTURES),
    "preview net --size 4": CommandResult(2, PICTURES),
    "gallery net": CommandResult(2, PICTURES),
    "inspect mine.rrd": CommandResult(2, RECORD),
    "view mine.rrd": CommandResult(2, RECORD),
    "run recorded.yaml": CommandResult(2, "recorded.yaml:4: options.record: recordings need Rerun, which this "
                                          f"installation lacks; to have it: {RECORD}; or set `record: false`"),
}  # fmt: skip
RECORDED_SWEEP = "scenes: [net]\nsolvers: [sparse]\noptions:\n  record: true\n"


@pytest.fixture(scope="module")
def command_results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, CommandResult]:
    folder = tmp_path_factory.mktemp("light")
    blocked = [name for part in OPTIONAL_PARTS for name in part.modules]
    (folder / "site").mkdir()
    (folder / "site" / "sitecustomize.py").write_text(f"BLOCKED = {blocked}\n{BLOCK}")
    (folder / "recorded.yaml").write_text(RECORDED_SWEEP)
    environment = os.environ | {"PYTHONPATH": str(folder / "site"), "COLUMNS": "1000"}
    command = [sys.executable, "-c", SCRIPT, json.dumps(list(COMMANDS))]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    return {name: CommandResult(*answer) for name, answer in zip(COMMANDS, found, strict=True)}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_works_or_names_what_to_install(command_results: dict[str, CommandResult], command: str):
    expected, found = COMMANDS[command], command_results[command]
    assert found.code == expected.code, found.text
    assert expected.text in found.text


def test_the_extras_repeat_dependencies_of_the_complete_installation():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    assert {part.extra for part in OPTIONAL_PARTS} == set(LIGHT_EXTRAS)
    for extra in LIGHT_EXTRAS:
        assert set(extras[extra]) <= set(project["dependencies"])
    lines = [*project["dependencies"], *(f"{line}; extra == '{name}'" for name in extras for line in extras[name])]
    light = list_light_requirements(lines)
    assert set(project["dependencies"]) - set(light) == {line for extra in LIGHT_EXTRAS for line in extras[extra]}


def test_a_light_installation_preserves_markers_and_omits_extras():
    lines = ["a>=1; python_version < '4'", "b-c<2", "d==1", "d==1; extra == 'record'", 'e; extra == "gates"']
    assert list_light_requirements(lines) == ["a>=1; python_version < '4'", "b-c<2"]

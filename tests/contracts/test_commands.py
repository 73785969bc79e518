"""Commands that the pages and the product suggest: each is one that the command line takes, and the short ones are run.

A word in capitals stands for a file or a name of the reader's own.
"""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any, cast

import pytest
from springbench.harness.cli.main import app
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

from tests.contracts.test_page_language import PAGES

ROOT = Path(__file__).resolve().parents[2]

_COMMAND = re.compile(r"^(?:\.venv/bin/)?springbench ")


def find_commands(page: Path) -> list[str]:
    """The commands of a page, in code spans and in fences of shell commands."""
    text = page.read_text()
    spans = re.findall(r"`([^`\n]+)`", text)
    fences = re.findall(r"^```(?:sh|bash)\n(.*?)^```", text, re.S | re.M)
    lines = [line.split("  #")[0] for fence in fences for line in fence.splitlines()]
    parts = [part.strip() for some in (*spans, *lines) for part in some.split(" && ")]
    return list(dict.fromkeys(_COMMAND.sub("", part) for part in parts if _COMMAND.match(part)))


GROUP = cast("TyperGroup", get_command(app))

COMMANDS = [(page, command) for page in PAGES for command in find_commands(page) if not command.split()[0].isupper()]


def test_there_are_commands_in_the_pages():
    assert len(COMMANDS) > 60


def options_of(found: Any) -> set[str]:
    return {
        option
        for parameter in found.get_params(found.context_class(found))
        for option in (*parameter.opts, *parameter.secondary_opts)
    }


def test_a_command_in_a_message_exists_with_its_options():
    """What stands in the braces of a message is left out."""
    seen = set[str]()
    for path in [*(ROOT / "harness").rglob("*.py"), *(ROOT / "solvers").rglob("*.py")]:
        text = re.sub(r"\{[^{}]*\}", "X", path.read_text())
        for marked, name, rest in re.findall(r"(`?)springbench ([a-z][a-z-]*)\b([^`\n;]*)", text):
            assert not marked or name in GROUP.commands, f"{path}: springbench {name}"
            if name in GROUP.commands:
                seen.add(name)
                assert set(re.findall(r"(?<!\S)--[a-z-]+", rest)) <= options_of(GROUP.commands[name]), (
                    f"{path}: springbench {name}{rest}"
                )
    assert len(seen) > 15


@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=lambda value: getattr(value, "name", value))
def test_a_command_of_a_page_has_its_options_and_its_files(page: Path, command: str):
    name, *arguments = shlex.split(command.replace("[", "").replace("]", ""))
    found = GROUP.commands[name]
    if isinstance(found, TyperGroup):
        name, *arguments = arguments
        found = found.commands[name]
    assert {word for word in arguments if word.startswith("-") and word != "-"} <= options_of(found)
    for word in arguments:
        if word.startswith("configs/") and "{" not in word:
            assert (ROOT / word).is_file()


@pytest.mark.long
def test_the_quick_start_and_all_that_it_suggests_end_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    done = CliRunner().invoke(app, ["run", "configs/quickstart.yaml"])
    assert done.exit_code == 0, done.output
    following = re.findall(r"^ +springbench (.+)$", done.output, re.M)
    assert {command.split()[0] for command in following} == {"view", "recommend", "report"}
    for command in following:
        name, *arguments = shlex.split(command)
        answer = CliRunner().invoke(app, ["inspect" if name == "view" else name, *arguments])
        assert answer.exit_code == 0, f"{command}: {answer.output}"


SHORT = """
list
list configs/quickstart.yaml
schema
preview configs/scenes/curtain.yaml
run configs/scenes/hanging-cloth.yaml --size 8
recommend configs/scenes/chain.yaml --error 1e-2
run configs/scenes/chain.yaml --error 1e-4 --t-end 2 --verify
export-script configs/engines.yaml
ablate configs/scenes/pulled-curtain.yaml
report results
query "SELECT size, solver, 1e3 * min(seconds) AS ms FROM rows WHERE phase = 'step' GROUP BY ALL ORDER BY ALL"
compact results
"""
"""Commands of the pages that take minutes at most, in an order in which each finds what it needs."""


@pytest.mark.long
def test_the_short_commands_of_the_pages_end_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    for command in SHORT.strip().splitlines():
        answer = CliRunner().invoke(app, shlex.split(command))
        assert answer.exit_code == 0, f"{command}: {answer.output[-3000:]}"

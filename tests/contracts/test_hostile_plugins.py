"""Code of others may do anything: a command says what it did, does the other runs, and is what it was."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from time import monotonic

import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest
from springbench.harness.cli.main import app
from typer.testing import CliRunner

from tests.contracts.hostile_plugins import FAILED, FINE, HOSTILE, MISTAKE, Hostile, write
from tests.machine_load import shares_per_core
from tests.rare_cases import mark_rare_cases

HANGS = 90.0
"""Seconds after which a command counts as hanging on an idle machine; its own limits end it within 20 s there."""


SAMPLE = ["importing exits well", "an effect binds nothing", "a mesh has NaN", "solving nothing"]


def state() -> tuple[object, ...]:
    """Of this process: its folder, streams, functions and environment, which plug-ins change."""
    return os.getcwd(), sys.stdout, sys.stderr, np.linalg.norm, os.environ.get("PATH")


@pytest.mark.parametrize("name", mark_rare_cases(HOSTILE, SAMPLE))
def test_a_command_survives_its_plugins(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    case = HOSTILE[name]
    write(tmp_path, case)
    began = monotonic()
    monkeypatch.chdir(tmp_path)
    before = state()
    result = CliRunner().invoke(app, ["run", "sweep.yaml"])
    said = re.sub(r"\s+", " ", result.output)
    assert result.exit_code == case.code, result.output[-3000:]
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert "Traceback" not in said
    assert case.said in said, result.output[-3000:]
    assert len(result.output) < 50_000
    assert state() == before
    assert monotonic() - began < HANGS * shares_per_core()
    assert not [child for child in psutil.Process().children(recursive=True) if child.name() == "sleep"]
    written = {path.name for path in tmp_path.iterdir()} - {"__pycache__"}  # Python's own, unless bytecode is off
    assert written <= {"mine.py", "odd.yaml", "sound.yaml", "sweep.yaml", "results"}
    if case.code != MISTAKE:
        require_rows(tmp_path, case)


INSPECTIONS = [
    *(("list", name) for name in HOSTILE),
    *(("preview", name) for name, case in HOSTILE.items() if case.part in ("effect", "mesh")),
]


@pytest.mark.long
@pytest.mark.parametrize(("command", "name"), INSPECTIONS)
def test_listing_and_showing_survive_plugins(command: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """`list` imports no code of others; `show` binds an effect or a mesh, and says what is wrong with it."""
    case = HOSTILE[name]
    write(tmp_path, case)
    monkeypatch.chdir(tmp_path)
    before, began = state(), monotonic()
    arguments = ["list", "sweep.yaml"] if command == "list" else ["preview", "odd.yaml", "-o", "picture.png"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code in ((0, 2) if command == "list" else (0, 1, 2)), result.output[-3000:]
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert "Traceback" not in result.output
    assert state() == before
    assert monotonic() - began < HANGS * shares_per_core()
    assert not [child for child in psutil.Process().children(recursive=True) if child.name() == "sleep"]


def require_rows(folder: Path, case: Hostile) -> None:
    """Each run has its rows; those that the plug-in has no part in are good."""
    files = (folder / "results" / "sweep" / "rows").glob("*.parquet")
    rows = [pq.read_table(path).to_pylist()[0] for path in files]
    assert len(rows) == (1 if case.part == "report" else 2)
    others = [row for row in rows if row["plugins"] is None]
    assert len(others) == 1
    assert [row["status"] for row in others] == ["ok"], others[0]["reason"]
    if case.code == FAILED and case.part != "report":
        assert [row["status"] == "ok" for row in rows if row["plugins"]] == [False]
    if case.code == FINE:
        assert {row["status"] for row in rows} == {"ok"}

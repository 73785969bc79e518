"""Inputs of gates from elsewhere: a message within limits, and nothing is read or written elsewhere."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.contracts.attempts import Outcome, attempt
from tests.contracts.hostile import scene, sweep
from tests.contracts.hostile_gates import PLUGIN, RECORDS, TABLES

QUICK = {"a scene of a pipe"}
"""Of each kind of fault one; the others are tried by `pytest -m long`."""


def each(names: object) -> list[object]:
    return [n if n in QUICK else pytest.param(n, marks=pytest.mark.long) for n in names]  # type: ignore[attr-defined]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a scene, a sweep and a pipe."""
    (tmp_path / "good.yaml").write_text(scene())
    (tmp_path / "sweep.yaml").write_text(sweep())
    os.mkfifo(tmp_path / "pipe")
    return tmp_path


def put(path: Path, content: str | bytes | Callable[[Path], object]) -> None:
    if callable(content):
        content(path)
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode(errors="surrogatepass"))


def require_message(outcome: Outcome, *codes: int) -> None:
    assert not outcome.error, outcome.error
    assert "Traceback" not in outcome.said
    assert outcome.code in codes, outcome.said
    assert not outcome.outside


@pytest.mark.parametrize("name", each(TABLES))
def test_a_hostile_table_is_refused_by_name(name: str, folder: Path):
    put(folder / "hostile.yaml", TABLES[name])
    outcome = attempt(folder, ["regress", "hostile.yaml", "--budget", "0.1"])
    require_message(outcome, 2)
    assert "hostile.yaml" in outcome.said


@pytest.mark.parametrize("name", each(RECORDS))
def test_a_hostile_record_ends_with_a_message(name: str, folder: Path):
    put(folder / "hostile.json", RECORDS[name])
    require_message(attempt(folder, ["regress", "hostile.json", "--baseline", "hostile.json"]), 0, 2, 3)
    require_message(attempt(folder, ["regress", "--history", "hostile.json"]), 2, 3)


@pytest.mark.long
@pytest.mark.parametrize("enabled", [True, False])
def test_tests_that_use_the_plugin_wrongly_fail_and_break_nothing(enabled: bool, folder: Path):
    (folder / "test_wrong.py").write_text(PLUGIN)
    options = [
        "--benchmark-enable" if enabled else "--benchmark-disable",
        "-p",
        "no:cacheprovider",
        "-q",
        "-c",
        "/dev/null",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, "--rootdir", str(folder), "test_wrong.py"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300.0,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "INTERNALERROR" not in done.stdout + done.stderr
    assert "error" not in done.stdout.splitlines()[-1]
    print(done.stdout[-6000:])

"""A command line attempted on hostile input, in a process with limits, and its outcome."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from springbench.harness.execution import sandbox
from typer.testing import CliRunner

LIMITS = sandbox.CallLimits(20.0, 2**31)
"""What an answer may take: 20 s of processor time, and 2 GiB of memory beyond that of a bare interpreter."""


@dataclass(frozen=True)
class Outcome:
    """The exit code, what was printed, the error that was not caught, and the files that changed outside of results."""

    code: int
    said: str
    error: str
    outside: list[str]


def attempt(folder: Path, arguments: list[str]) -> Outcome:
    """What a command line comes to in a folder, of which `results` is the folder of results. Raises child.NoAnswer."""
    return sandbox.call_in_sandbox(_attempt, folder, arguments, limits=LIMITS)


def _attempt(folder: Path, arguments: list[str]) -> Outcome:
    from springbench.harness.cli.main import app
    from springbench.harness.scenes.mesh import file_mesh

    file_mesh.MIN_READ_SECONDS = 1.0  # some of these would be read for ever
    os.chdir(folder)
    (folder / "temporary").mkdir(exist_ok=True)
    tempfile.tempdir = os.environ["TMPDIR"] = str(folder / "temporary")  # what is left there is seen
    before = _state(folder)
    done = CliRunner().invoke(app, arguments)
    error = "" if done.exception is None or isinstance(done.exception, SystemExit) else repr(done.exception)
    changed = [str(path) for path, _ in before ^ _state(folder)]
    return Outcome(done.exit_code, done.output, error, changed)


def _state(folder: Path) -> set[tuple[Path, Any]]:
    """What lies in a folder, and when it was changed; all but the results."""
    found = set()
    for path in folder.rglob("*"):
        if path.relative_to(folder).parts[0] != "results":
            state = path.lstat()
            found.add((path.relative_to(folder), (state.st_size, state.st_mtime_ns) if not path.is_dir() else ()))
    return found

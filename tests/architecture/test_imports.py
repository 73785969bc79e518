"""What a command imports: to list is not to draw, to record or to compute."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DRAWING = {"PIL", "matplotlib", "mpl_toolkits", "plotly", "pyvista", "vtkmodules", "rerun"}
COMPUTING = {"duckdb", "llvmlite", "numba", "numpy", "pyarrow", "pydantic", "scipy"}
PROGRAM = (
    "import atexit, sys; atexit.register(lambda: print('loaded', *sys.modules)); from harness.cli import main; main()"
)


@pytest.mark.parametrize(
    ("arguments", "without", "fewer"),
    [
        (["--help"], DRAWING | COMPUTING, 300),
        (["list", "configs/quickstart.yaml"], DRAWING | {"duckdb", "harness.report", "harness.record.rerun"}, 1200),
    ],
    ids=["--help", "list"],
)
def test_a_command_that_tells_imports_neither_pictures_nor_recordings(
    arguments: list[str], without: set[str], fewer: int, tmp_path: Path
) -> None:
    if "list" in arguments:
        arguments = [*arguments, "--results", str(tmp_path)]
    told = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert told.returncode == 0, told.stderr
    loaded = told.stdout.rpartition("loaded")[2].split()
    assert not without & set(loaded)
    # A module takes a third of a millisecond at the least: there are 234 to help, 1,033 to list, 1,950 with pictures.
    assert len(loaded) < fewer

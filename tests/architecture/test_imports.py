"""What a command imports: to list is not to draw, to record or to compute."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from springbench.harness.results.parquet_rows import write_rows

ROOT = Path(__file__).resolve().parents[2]
DRAWING = {"PIL", "matplotlib", "mpl_toolkits", "plotly", "pyvista", "vtkmodules", "rerun"}
COMPUTING = {"duckdb", "llvmlite", "numba", "numpy", "pyarrow", "pydantic", "scipy"}
STEPPING = {"duckdb", "llvmlite", "numba", "pandas", "pyarrow", "scipy.linalg"}
PROGRAM = (
    "import atexit, sys; atexit.register(lambda: print('loaded', *sys.modules)); from "
    "springbench.harness.__main__ import main; main()"
)


def loads(arguments: list[str], cache: Path) -> list[str]:
    """The modules that a command has loaded when it ends."""
    completed = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cache)},
        capture_output=True,
        text=True,
    )
    assert completed.returncode == 0, completed.stderr
    return completed.stdout.rpartition("loaded")[2].split()


@pytest.mark.parametrize(
    ("arguments", "without", "fewer"),
    [
        (["--help"], DRAWING | COMPUTING | {"rich"}, 220),
        (
            ["list", "configs/quickstart.yaml"],
            DRAWING | STEPPING | {"springbench.harness.report", "springbench.harness.recording.rerun_recorder"},
            800,
        ),
        (["list"], DRAWING | COMPUTING - {"pydantic"}, 400),
        (["query", "select size from rows"], DRAWING | {"numba", "pandas", "scipy"}, 900),
    ],
    ids=["--help", "list-config", "list", "query"],
)
def test_a_command_without_pictures_imports_neither_plotting_nor_recording(
    arguments: list[str], without: set[str], fewer: int, tmp_path: Path
) -> None:
    if "--help" not in arguments:
        arguments = [*arguments, "--results", str(tmp_path)]
        (tmp_path / "sweep" / "rows").mkdir(parents=True)
        write_rows(tmp_path / "sweep" / "rows" / "run.parquet", [{"run_id": "run", "size": 4}])
        loads(arguments, tmp_path)  # the first time it reads the parameters of solvers, and caches them
    loaded = loads(arguments, tmp_path)
    assert not without & set(loaded)
    # A module takes a third of a millisecond at the least: there are 188 to help, 700 to list, 1,950 with pictures.
    assert len(loaded) < fewer

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


def loads(arguments: list[str], cache: Path, program: str = PROGRAM) -> list[str]:
    """The modules that a command, or a program, has loaded when it ends."""
    completed = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        cwd=ROOT,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT / ".src"), str(ROOT)]),
            "XDG_CACHE_HOME": str(cache),
        },
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
            ["list", "configs/quickstart.yaml", "--results", "RESULTS"],
            DRAWING | STEPPING | {"springbench.harness.report", "springbench.harness.recording.rerun_recorder"},
            800,
        ),
        (["list"], DRAWING | COMPUTING | {"rich", "typer"}, 250),
        (["schema"], DRAWING | COMPUTING | {"rich", "typer"}, 250),
        (["list", "--results", "RESULTS"], DRAWING | COMPUTING - {"pydantic"}, 400),
        (["query", "select size from rows", "--results", "RESULTS"], DRAWING | COMPUTING - {"pydantic"}, 450),
    ],
    ids=["--help", "list-config", "list", "schema", "list-results", "query"],
)
def test_a_command_without_pictures_imports_neither_plotting_nor_recording(
    arguments: list[str], without: set[str], fewer: int, tmp_path: Path
) -> None:
    arguments = [word.replace("RESULTS", str(tmp_path)) for word in arguments]
    if "--help" not in arguments:
        (tmp_path / "sweep" / "rows").mkdir(parents=True)
        write_rows(tmp_path / "sweep" / "rows" / "run.parquet", [{"run_id": "run", "size": 4}])
        loads(arguments, tmp_path)  # the first time it reads the sources of solvers, and caches what it finds
    loaded = loads(arguments, tmp_path)
    assert not without & set(loaded)
    # A module takes a third of a millisecond at the least: there are 188 to list names, 216 to help, 370 to query.
    assert len(loaded) < fewer


CONTROL = "springbench.harness.cli.commands.error_control"
LISTING = f"""
import atexit, sys; atexit.register(lambda: print('loaded', *sys.modules))
import {CONTROL}
from springbench.harness.experiments.error_control.candidate_methods import list_candidate_methods, list_contact_methods
assert list_candidate_methods() and list_contact_methods()
"""


def test_error_control_imports_neither_sweeps_nor_solvers_that_it_does_not_try(tmp_path: Path) -> None:
    loads([], tmp_path, LISTING)  # the first time it reads the traits of all solvers, and caches them
    loaded = set(loads([], tmp_path, LISTING))
    assert CONTROL in loaded
    assert not (DRAWING | {"duckdb"}) & loaded
    own = {"run_pipeline", "sweep_runner", "sweep_summary", "timing_table"}
    assert not {name for name in loaded if name.startswith("springbench.harness.") and name.split(".")[-1] in own}
    untried = ("position_based", "local_global", "quasi_newton")
    assert not {name for name in loaded if any(f"solvers.methods.{family}." in name for family in untried)}


def test_the_process_that_draws_inherits_all_of_pyvista(tmp_path: Path) -> None:
    program = "import springbench.harness.report.run_picture, sys; print('loaded', *sys.modules)"
    assert "pyvista.plotting" in loads([], tmp_path, program)

"""The examples run as they are, each a file of its own; and `harness` shows what they use."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = {
    "first_simulation": "after 1.00 s the lowest vertex is at",
    "own_solver": "./own_solver.py:HeavyBall",
    "own_effect": "c = 0.5",
    "own_mesh": "the rim sinks to",
    "own_report": "rows, and results/own-report/iterations.png",
}


def python(*arguments: str, folder: Path) -> str:
    """What a program says, run in a folder."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    told = subprocess.run([sys.executable, *arguments], cwd=folder, env=env, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    return told.stdout


def test_every_example_is_run_here():
    assert {path.stem for path in (ROOT / "configs" / "examples").glob("*.py")} == set(EXAMPLES)


def test_every_example_is_short():
    lengths = {path.name: len(path.read_text().splitlines()) for path in (ROOT / "configs" / "examples").glob("*.py")}
    assert {name for name, length in lengths.items() if length > 40} == set()


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name: str, tmp_path: Path):
    assert EXAMPLES[name] in python(str(ROOT / "configs" / "examples" / f"{name}.py"), folder=tmp_path)


def test_what_scripts_use_is_all_that_harness_shows(tmp_path: Path):
    program = (
        "import sys, harness; print(dir(harness)); print('springbench.harness.api' "
        "in sys.modules, 'numpy' in sys.modules)"
    )
    names, loaded = python("-c", program, folder=tmp_path).splitlines()
    types = ["IntegratorName", "OptionKeys", "OwnName", "SceneKeys", "SolverName", "SweepKeys"]
    does = ["Picture", "Simulation", "draw", "load_scene", "make_scene", "open_recording", "rows", "run"]
    wanted = sorted([*types, *does])
    assert (names, loaded) == (str(wanted), "False False")

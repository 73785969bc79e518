"""The examples run as they are, each from its own file; `springbench` lists its public names."""

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

PUBLIC_NAMES = {
    # scripts and notebooks
    *(
        "Simulation",
        "draw_picture",
        "load_rows",
        "load_scene",
        "make_scene",
        "open_recording",
        "run_config",
        "view_recording",
        "PngImage",
        "RunRecording",
    ),
    *("InputError", "InputMistake", "RunFailed", "SpringbenchError"),
    # types of names and keys
    *("IntegratorName", "OptionKeys", "SceneKeys", "SolverName", "SweepKeys", "UserCodeName"),
    # effects and meshes
    *("ConfigModel", "EffectContribution", "ForceFunction", "PinGroup", "SceneEffect", "VelocityFilter"),
    *("Mesh", "MeshGenerator", "assemble_mesh"),
    # solvers
    *("Citation", "Energy", "FixedPointSolver", "IterativeSolver", "NotPositiveDefinite", "Positions"),
    *("PreparedSolver", "ProjectiveEnergy", "Solution", "Solver", "SolverInfo", "SolverState", "StepProblem"),
    *("StepStart", "StopRule", "System", "Unsupported"),
}


def python(*arguments: str, folder: Path) -> str:
    """What a program says, run in a folder."""
    env = {**os.environ, "PYTHONPATH": str(ROOT / ".src"), "MPLBACKEND": "agg"}
    completed = subprocess.run([sys.executable, *arguments], cwd=folder, env=env, capture_output=True, text=True)
    assert completed.returncode == 0, completed.stderr
    return completed.stdout


def test_every_example_is_run_here():
    assert {path.stem for path in (ROOT / "configs" / "examples").glob("*.py")} == set(EXAMPLES)


def test_every_example_is_short():
    lengths = {path.name: len(path.read_text().splitlines()) for path in (ROOT / "configs" / "examples").glob("*.py")}
    assert {name for name, length in lengths.items() if length > 40} == set()


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name: str, tmp_path: Path):
    assert EXAMPLES[name] in python(str(ROOT / "configs" / "examples" / f"{name}.py"), folder=tmp_path)


def test_dir_lists_the_public_names_without_loading_them(tmp_path: Path):
    program = (
        "import sys, springbench; print(dir(springbench)); print('springbench.harness.api' "
        "in sys.modules, 'numpy' in sys.modules)"
    )
    names, loaded = python("-c", program, folder=tmp_path).splitlines()
    assert (names, loaded) == (str(sorted(PUBLIC_NAMES)), "False False")

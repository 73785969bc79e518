"""The examples run as they are, each from its own file; `springbench` lists its public names, which suffice."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
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
    *("DerivedEnergies", "ObservedMotion", "SceneCheck", "Vector3", "build_constant_force"),
    *("BEND", "SHEAR", "STRETCH", "LengthMetres", "Mesh", "MeshGenerator", "SpringProperties", "assemble_mesh"),
    # solvers
    *("Citation", "Energy", "FixedPointSolver", "IterativeSolver", "NotPositiveDefinite", "Positions"),
    *("PreparedSolver", "ProjectiveEnergy", "Solution", "Solver", "SolverInfo", "SolverState", "StepProblem"),
    *("StepStart", "StopRule", "System", "Unsupported"),
    *("DirichletPins", "LaggedEnergy", "LengthConstraints", "ResidualIterate", "Springs"),
    *("PreparedLocalGlobal", "prepare_local_global", "require_projective"),
    # matrices and their factors
    *("DenseCholesky", "LinearSolver", "SparseLU", "assemble_system_matrix", "rest_lengths"),
    *(
        f"{matrix}_matrix_{form}"
        for matrix in ("mass", "selection", "signed_incidence", "system")
        for form in ("dense", "sparse")
    ),
    # integrators
    *("AnyIntegrator", "GeneralisedAlpha", "RungeKutta", "SingleStageIntegrator", "find_integrator"),
    *("Motion", "Stage", "StageGenerator", "StageSolution", "StepEnd"),
    # reports
    *("ReportFunction", "RunOutcome", "VerifiedRun", "read_verified_runs"),
    *("AxisScale", "CellMap", "CellOutcome", "CurvePlot", "CurveSeries", "FigurePanel", "MapCell", "MarkedValue"),
    *("MeshPicture", "MeshRenderer", "SeriesStyle", "ShadedBand", "assign_solver_styles"),
    *("ChartAxis", "ChartDescription", "ChartFrame", "ChartSeries", "select_panels"),
}

PART = r"(?:harness|solvers)\b"
DEEP_IMPORT = re.compile(
    rf"^[ \t]*(?:>>> |\.\.\. )?(?:(?:from|import) springbench\.{PART}.*|from springbench import .*\b{PART}.*)",
    re.MULTILINE,
)
"""An import from the folders of the package instead of its public names."""


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


def read_code(path: Path) -> Iterator[str]:
    """The Python code of a program, of the code cells of a notebook, or of the fences of a page."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        yield from ("".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "code")
    elif path.suffix == ".py":
        yield text
    else:
        yield from re.findall(r"^```(?:python|py)\b.*?\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def find_deep_imports(path: Path) -> list[str]:
    """The lines of a file's code that import from the folders of the package."""
    return [found.strip() for code in read_code(path) for found in DEEP_IMPORT.findall(code)]


def list_configs_with_code() -> list[Path]:
    """The programs, notebooks and pages of `configs`."""
    suffixes = (".py", ".ipynb", ".md", ".md.j2")
    return [path for path in sorted((ROOT / "configs").rglob("*.*")) if path.name.endswith(suffixes)]


def test_what_is_shipped_imports_public_names_only():
    files = list_configs_with_code()
    assert {path.suffix for path in files} == {".py", ".ipynb", ".md", ".j2"}
    found = {path.relative_to(ROOT).as_posix(): find_deep_imports(path) for path in files}
    assert {name: lines for name, lines in found.items() if lines} == {}


@pytest.mark.parametrize(
    "line",
    [
        "from springbench.harness.scenes.mesh.mesh import Mesh",
        "import springbench.solvers.registry as registry",
        "from springbench import Mesh, solvers",
        ">>> from springbench.solvers.model.step_problem import Positions",
    ],
)
def test_an_import_from_a_folder_of_the_package_is_found_in_each_kind_of_file(line: str, tmp_path: Path):
    code = f"import springbench\n{line}\nfrom springbench import Mesh, Solver\n"
    cells = [{"cell_type": "markdown", "source": [code]}, {"cell_type": "code", "source": code.splitlines(True)}]
    texts = {"a.py": code, "a.ipynb": json.dumps({"cells": cells}), "a.md": f"{line}\n\n```python\n{code}```\n"}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        assert find_deep_imports(tmp_path / name) == [line], name

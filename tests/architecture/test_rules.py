"""The linters enforce the architecture; these tests run them, and show them what they must refuse."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent


def ruff(*arguments: str, text: str | None = None) -> list[tuple[str, str]]:
    """Violations that `ruff check` finds, as (file, code)."""
    command = [BIN / "ruff", "check", "--no-cache", "--output-format=json", *arguments]
    result = subprocess.run(command, cwd=ROOT, input=text, capture_output=True, text=True)
    assert result.returncode in (0, 1), result.stderr
    return [(violation["filename"], violation["code"]) for violation in json.loads(result.stdout)]


def import_contracts(tree: Path) -> str:
    """Output of the import linter for the package in a folder, empty if all contracts are satisfied."""
    command = [BIN / "lint-imports", "--no-cache", "--no-logo"]
    environment = {"PYTHONPATH": str(tree / ".src")}
    result = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    return "" if result.returncode == 0 else result.stdout + result.stderr


def test_the_code_passes_the_linter():
    assert ruff() == []


@pytest.mark.parametrize(
    ("file", "text", "code"),
    [
        ("harness/recording/new.py", '"""Doc."""\n\nimport rerun as rr\n\nrr.init("app")\n', "TID251"),
        ("harness/recording/new.py", '"""Doc."""\n\nfrom rerun import log\n\nlog("a", 1)\n', "TID251"),
        ("solvers/new.py", '"""Doc."""\n\nfrom numba import njit\n\nfast = njit(cache=True)(abs)\n', "TID251"),
        ("solvers/new.py", '"""Doc."""\n\nimport numba\n\nfast = numba.njit(abs)\n', "TID251"),
        ("solvers/new.py", '"""Doc."""\n\nimport harness.cli\n\nx = harness.cli\n', "TID251"),
        ("tests/new.py", "from solvers import registry\n\nx = registry\n", "TID251"),
        ("solvers/new.py", "x = 1\n", "D100"),
        ("solvers/new.py", '"""Doc."""\n\n\nclass Public:\n    x = 1\n', "D101"),
        ("harness/new.py", '"""Doc."""\n\n\ndef public() -> None:\n    return\n', "D103"),
        ("harness/new.py", '"""Doc."""\n\n# TO' + "DO: later\n", "FIX002"),
        ("tests/unit/test_new.py", "# FIX" + "ME: it fails\n", "FIX001"),
    ],
    ids=lambda value: value if isinstance(value, str) and value.isalnum() else "",
)
def test_the_linter_refuses(file: str, text: str, code: str):
    assert code in {found for _, found in ruff(f"--stdin-filename={file}", "-", text=text)}


def test_imports_go_down_the_rows_only():
    assert import_contracts(ROOT) == ""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of the package and of the contracts, to be changed."""
    shutil.copytree(ROOT / ".src", tmp_path / ".src", symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for package in ("harness", "solvers"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return Path(shutil.copy(ROOT / "pyproject.toml", tmp_path)).parent


@pytest.mark.parametrize(
    ("file", "line", "refused"),
    [
        (
            "solvers/model/system_matrix_assembly.py",
            "from springbench.harness.results import parquet_rows",
            "The solvers do not import the harness BROKEN",
        ),
        (
            "solvers/model/system_matrix_assembly.py",
            "import springbench.solvers.methods.local_global.reference_local_global",
            "The rows of the solvers BROKEN",
        ),
        (
            "solvers/methods/local_global/reference_local_global.py",
            "from time import perf_counter",
            "solvers is not allowed to import time",
        ),
        (
            "solvers/methods/local_global/reference_local_global.py",
            "import rerun",
            "solvers is not allowed to import rerun",
        ),
        (
            "harness/scenes/mesh/mesh.py",
            "import springbench.harness.experiments.run_pipeline",
            "springbench.harness.scenes is not allowed to import springbench.harness.experiments",
        ),
        (
            "harness/scenes/effects/wind_effect.py",
            "import springbench.harness.scenes.effects.gravity_effect",
            "The effects do not import each other BROKEN",
        ),
        (
            "harness/report/plot_style.py",
            "import springbench.harness.simulation.time_loop",
            "springbench.harness.report is not allowed to import",
        ),
        ("harness/experiments/run_pipeline.py", "import rerun", "Only the recordings import Rerun BROKEN"),
        (
            "harness/scenes/scene_builder.py",
            "import pyvista",
            "Only the reports import PyVista, Matplotlib and Plotly BROKEN",
        ),
        ("harness/surprise.py", "", "harness.surprise"),
    ],
    ids=lambda value: value if isinstance(value, str) and value.endswith(".py") else "",
)
def test_the_import_linter_refuses(tree: Path, file: str, line: str, refused: str):
    with (tree / file).open("a") as source:
        source.write(f"\n{line}\n")
    assert refused in " ".join(import_contracts(tree).split())

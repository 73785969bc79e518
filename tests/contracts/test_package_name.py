"""The package takes one name, `springbench`: files of a user called `solvers` or `harness` do not disturb it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("harness", "solvers")
SCENE = """
mesh: {kind: grid}
mass: 1
time_step: 1/30
frames: 2
default_size: 4
effects: [{kind: springs, stretch: 300}, {kind: gravity}, {kind: pins, parts: [top_corners]}]
"""
SCRIPT = """
import springbench
for name in springbench.__all__:
    getattr(springbench, name)
scene = springbench.load_scene("scene.yaml")
print(*springbench.Simulation(scene, "sparse").step().shape)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene and a script next to files that have the names of the checkout's two folders, and fail when imported."""
    for name in FOLDERS:
        (tmp_path / f"{name}.py").write_text(f"raise RuntimeError('{name}.py of the user was imported')\n")
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "script.py").write_text(SCRIPT)
    return tmp_path


def python(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, where nothing but the installed package is on the path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def test_a_script_next_to_files_of_these_names_imports_all_public_names(folder: Path):
    result = python("script.py", folder=folder)
    assert (result.returncode, result.stdout) == (0, "16 3\n"), result.stderr


def test_a_config_next_to_files_of_these_names_runs(folder: Path):
    result = python("-m", "springbench", "run", "scene.yaml", "--solver", "sparse", folder=folder)
    assert result.returncode == 0, result.stderr
    assert list((folder / "results").rglob("*.parquet"))


@pytest.mark.parametrize("name", FOLDERS)
def test_the_folders_are_no_packages_outside_the_checkout(name: str, tmp_path: Path):
    result = python("-c", f"import {name}", folder=tmp_path)
    assert result.returncode == 1
    assert f"No module named '{name}'" in result.stderr


def test_the_wheel_has_one_package(tmp_path: Path):
    command = ["pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", str(tmp_path), str(ROOT)]
    built = python("-m", *command, folder=tmp_path)
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0] for name in names} == {"springbench", f"{wheel.name.split('-py3')[0]}.dist-info"}
    for module in ("__init__.py", "py.typed", "harness/__main__.py", "solvers/registry.py"):
        assert f"springbench/{module}" in names
    configs = [path for path in (ROOT / "configs").rglob("*.*") if "__pycache__" not in path.parts]
    assert {f"springbench/{path.relative_to(ROOT).as_posix()}" for path in configs} <= set(names)

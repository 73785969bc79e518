"""The wheel does the main job in an empty folder and an environment of its own: the commands of the how-to page.

Only the last test uses a network: the libraries of the others are those of this environment.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "configs" / "howto" / "without-a-checkout.md"


def read_commands(heading: str) -> list[str]:
    """The commands in the fence of a section of the page."""
    (section,) = re.findall(rf"^## {heading}\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.M | re.S)
    (fence,) = re.findall(r"^```sh\n(.*?)^```", section, re.M | re.S)
    return fence.splitlines()


def find_interpreters() -> list[str]:
    """The supported interpreters of this machine other than this one, in the path or installed by pyenv."""
    found = list[str]()
    for name in (f"python3.{minor}" for minor in (11, 12, 13, 14) if minor != sys.version_info.minor):
        installed = sorted((Path.home() / ".pyenv" / "versions").glob(f"{name.removeprefix('python')}.*/bin/{name}"))
        options = [*filter(None, [shutil.which(name)]), *map(str, installed)]
        found += [one for one in options if subprocess.run([one, "-V"], capture_output=True).returncode == 0][:1]
    return found


def start(*command: str, folder: Path, path: str = "", **variables: str) -> subprocess.CompletedProcess[str]:
    """The outcome of a command in a folder, without what leads Python to the checkout."""
    outside = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTEST_ADDOPTS")}
    environment = outside | {"PATH": f"{path}{os.pathsep}{os.environ['PATH']}"} if path else outside
    return subprocess.run(command, cwd=folder, env=environment | variables, capture_output=True, text=True)


def call(*command: str, folder: Path, path: str = "", **variables: str) -> str:
    done = start(*command, folder=folder, path=path, **variables)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of an environment with the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    build = ["pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", ".", str(ROOT)]
    call(sys.executable, "-m", *build, folder=folder)
    (wheel,) = folder.glob("*.whl")
    call(sys.executable, "-m", "venv", "--without-pip", "environment", folder=folder)
    python = folder / "environment" / "bin" / "python"
    (library,) = folder.glob("environment/lib/python*/site-packages")
    install = ["pip", "--python", str(python), "install", "--no-deps", "--no-index", "--quiet", str(wheel)]
    call(sys.executable, "-m", *install, folder=folder)
    (library / "libraries.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    assert str(library) in call(str(python), "-c", "import springbench; print(springbench.__file__)", folder=folder)
    return python.parent


def test_the_page_installs_the_package_by_its_name():
    assert 'pip install "springbench[gates]"' in read_commands("Install")


def test_the_commands_of_the_page_end_well(scripts: Path, tmp_path: Path):
    said = dict[str, str]()
    folder = tmp_path
    for command in [*read_commands("Run"), *read_commands("Begin a study")]:
        if command.startswith("cd "):
            folder /= command.removeprefix("cd ")
            continue
        program = f"{scripts / 'python'} -m pytest --benchmark-disable" if command == "pytest" else command
        said[command] = call("bash", "-c", program, folder=folder, path=str(scripts))
    assert "hanging-cloth" in said["springbench list --shipped"]
    assert "HeavyBall" in said["springbench run compare.yaml"].replace(" ", "").replace("\n", "").replace("-", "")
    assert "1 passed" in said["pytest"]
    study = tmp_path / "my-study" / "results"
    assert (study / "index.html").is_file()
    assert len([*(study / "compare" / "recordings").glob("*.rrd")]) >= 6
    assert len([*(study / "compare" / "pictures").glob("*.png")]) >= 6


def test_the_light_list_leaves_out_the_libraries_of_recordings_and_pictures(scripts: Path, tmp_path: Path):
    light = call(str(scripts / "python"), "-m", "springbench.requirements", folder=tmp_path)
    assert "numba" in light
    assert not re.search("rerun|pyvista|vtk", light)


def test_a_traceback_names_files_of_the_installed_package(scripts: Path, tmp_path: Path):
    program = "import numpy, springbench; springbench.DenseCholesky(numpy.zeros((1, 1)))"
    done = start(str(scripts / "python"), "-c", program, folder=tmp_path)
    (library,) = scripts.parent.glob("lib/python*/site-packages")
    assert done.returncode == 1
    assert "NotPositiveDefinite" in done.stderr
    files = re.findall(r'^  File "(.*)", line \d+', done.stderr, re.M)
    assert str(library / "springbench" / "solvers" / "linalg" / "direct_solvers.py") in files
    assert not [file for file in files if file.startswith(f"{ROOT / 'solvers'}{os.sep}")]


KERNEL_PROGRAM = """
import numpy as np
from springbench.harness.scenes.spring_strains import _strains_kernel
points, edges, numbers = np.zeros((2, 3)), np.array([[0, 1]]), np.ones(1)
_strains_kernel(points, edges, numbers, numbers, numbers)
print(sum(_strains_kernel.stats.cache_hits.values()), sum(_strains_kernel.stats.cache_misses.values()))
"""
"""Calls a compiled function, and prints whether its code was loaded or compiled."""


def test_a_kernel_that_one_process_caches_is_loaded_by_the_next(scripts: Path, tmp_path: Path):
    cache = tmp_path / "kernels"
    command = str(scripts / "python"), "-c", KERNEL_PROGRAM
    assert call(*command, folder=tmp_path, NUMBA_CACHE_DIR=str(cache)) == "0 1\n"
    (code,) = cache.rglob("*.nbc")
    assert call(*command, folder=tmp_path, NUMBA_CACHE_DIR=str(cache)) == "1 0\n"
    assert [*cache.rglob("*.nbc")] == [code]


def test_other_interpreters_of_this_machine_run_a_scene_and_a_study(scripts: Path, tmp_path: Path):
    (wheel,) = scripts.parents[1].glob("*.whl")
    for interpreter in find_interpreters():
        name = Path(interpreter).name
        call(interpreter, "-m", "venv", name, folder=tmp_path)
        bin_folder = tmp_path / name / "bin"
        install = ["uv", "pip", "install", "--quiet", "--python", str(bin_folder / "python"), f"{wheel}[gates]"]
        call(sys.executable, "-m", *install, folder=tmp_path)
        home = tmp_path / f"home-{name}"
        home.mkdir()
        run = ["run", "net", "--size", "4", "--frames", "2", "--solver", "sparse"]
        assert "net" in call(str(bin_folder / "springbench"), *run, folder=home)
        call(str(bin_folder / "springbench"), "new", "study", folder=home)
        output = call(str(bin_folder / "python"), "-m", "pytest", "-q", "--benchmark-disable", folder=home / "study")
        assert "1 passed" in output

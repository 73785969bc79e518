"""Compiled code is kept by the sources it was made from, and goes when new sources come and nobody uses it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from harness import kernels

YEAR_2001 = 1e9
"""Seconds since 1970."""


@pytest.fixture
def solvers(tmp_path: Path) -> Path:
    """A folder of sources with the compiled code of two others: one in use, one not."""
    (tmp_path / "kernel.py").write_text("one = 1")
    for name in ("numba-used", "numba-unused"):
        (tmp_path / "__pycache__" / name / "kernels").mkdir(parents=True)
    os.utime(tmp_path / "__pycache__" / "numba-unused", (YEAR_2001, YEAR_2001))
    return tmp_path


def kept(solvers: Path) -> set[str]:
    return {folder.name for folder in (solvers / "__pycache__").iterdir()}


def test_new_sources_have_a_folder_of_their_own_and_clear_away_what_nobody_uses(solvers: Path):
    folder = Path(kernels(solvers))
    assert kept(solvers) == {folder.name, "numba-used"}
    (solvers / "kernel.py").write_text("one = 2")
    assert kernels(solvers) != str(folder)


def test_a_folder_that_was_not_used_for_long_serves_its_sources_again(solvers: Path):
    folder = Path(kernels(solvers))
    (folder / "code").touch()
    os.utime(folder, (YEAR_2001, YEAR_2001))
    assert kernels(solvers) == str(folder)
    (solvers / "kernel.py").write_text("one = 2")
    kernels(solvers)
    assert (folder / "code").exists()  # it was in use a moment ago


def test_sources_that_cannot_be_written_beside_are_no_obstacle(tmp_path: Path):
    (tmp_path / "__pycache__").write_text("a file, where a folder would have to be")
    assert kernels(tmp_path).startswith(str(tmp_path))


DIGESTS = """
import hashlib
from itertools import islice
import harness
from solvers.registry import SOLVERS, load
from tests.scenes import cloth, first_problem
problem = first_problem(cloth(12))
for name in ("numba", "lbfgs", "vbd"):
    iterates = load(SOLVERS[name])().prepare(problem.system).iterates(problem)
    print(name, hashlib.sha256(b"".join(p.tobytes() for p in islice(iterates, 20))).hexdigest())
"""


def test_the_process_that_compiles_a_kernel_finds_the_bits_of_those_that_load_it(tmp_path: Path):
    root = Path(__file__).resolve().parents[2]
    compiling, loading = (
        subprocess.run(
            [sys.executable, "-c", DIGESTS],
            cwd=root,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    )
    assert compiling == loading

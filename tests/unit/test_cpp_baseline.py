"""The baseline in C++: it takes the same steps as ours where it can be built, and says why where it cannot."""

from __future__ import annotations

import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.roofline.cpp_baseline import MALLOC_TUNABLES, CppBaseline, compile_baseline
from springbench.solvers.methods.local_global import cpp_backend
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import StopRule, Unsupported

from tests.scene_builders import build_cloth, build_first_problem

ECHO = f"""#!{sys.executable}
import sys
print(0.125, flush=True)
for line in sys.stdin:
    if int(line) > 100:
        sys.exit(3)
    print(int(line), 1.5, 2.5, flush=True)
with open(sys.argv[2], "wb") as file:
    file.write(bytes(8 * 3 * 16))
"""


@pytest.fixture
def echo(tmp_path: Path) -> Path:
    """A program that speaks as the baseline does, for a cloth of 16 vertices, and ends badly above 100 iterations."""
    program = tmp_path / "echo"
    program.write_text(ECHO)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    return program


def test_without_a_compiler_it_is_unsupported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cpp_backend.shutil, "which", lambda _: None)
    with pytest.raises(Unsupported, match=r"no C\+\+ compiler"):
        compile_baseline(tmp_path)


def test_the_output_of_the_compiler_is_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    compiler = tmp_path / "compiler"
    compiler.write_text("#!/bin/sh\necho 'baseline.cpp:17: fatal error: Eigen/Sparse: No such file' >&2\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    with pytest.raises(Unsupported, match=r"Eigen/Sparse: No such file.*libeigen3-dev"):
        compile_baseline(tmp_path / "build")
    assert list((tmp_path / "build").iterdir()) == []


def test_the_cached_program_is_of_this_compiler_version_and_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    compiler = tmp_path / "compiler"
    compiler.write_text(
        '#!/bin/sh\ntest "$1" = --version && cat "$0.version" && exit\nfor last; do :; done\n: > "$last"\n'
    )
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))

    def compile_with(version: str) -> Path:
        (tmp_path / "compiler.version").write_text(version)
        cpp_backend._read_compiler_version.cache_clear()
        return compile_baseline(tmp_path / "build")

    first = compile_with("compiler 12")
    assert first.exists()
    assert compile_with("compiler 12") == first
    assert compile_with("compiler 13") != first
    monkeypatch.setattr(cpp_backend.llvmlite.binding, "get_host_cpu_name", lambda: "another")
    assert compile_with("compiler 12") != first


def test_it_is_queried_line_by_line(echo: Path, tmp_path: Path):
    made = build_cloth(4)
    running = CppBaseline(echo, build_first_problem(made), made.all_springs, tmp_path, "")
    assert running.prepare_seconds == 0.125
    assert running.time_step_phases(7) == [7.0, 1.5, 2.5]
    assert running.close().shape == (16, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["echo"]


def test_a_program_that_ends_early_is_a_failed_run(echo: Path, tmp_path: Path):
    made = build_cloth(4)
    running = CppBaseline(echo, build_first_problem(made), made.all_springs, tmp_path, "")
    with pytest.raises(RunFailed, match="too short"):
        running.time_step_phases(101)
    with pytest.raises(RunFailed):
        running.time_step_phases(1)
    running.kill_process()


def test_exact_pins_are_not_supported(tmp_path: Path):
    made = build_cloth(4, weight="exact")
    with pytest.raises(Unsupported, match="penalty"):
        CppBaseline(tmp_path / "none", build_first_problem(made), made.all_springs, tmp_path, "")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The real one; where it cannot be built the report says so in a row, and there is nothing to compare."""
    try:
        return compile_baseline(tmp_path_factory.mktemp("build"))
    except Unsupported as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("tunables", ["", MALLOC_TUNABLES], ids=["default", "cheap temporaries"])
def test_it_takes_the_same_steps_as_the_solver_in_python(program: Path, tmp_path: Path, tunables: str):
    made = build_cloth(12)
    stated = build_first_problem(made)
    ours = SparseLocalGlobal().prepare(made.system).solve(stated, StopRule(50)).positions
    running = CppBaseline(program, stated, made.all_springs, tmp_path, tunables)
    for _ in range(2):  # each step starts from the first guess again
        step, local, global_ = running.time_step_phases(50)
        assert step >= local + global_ > 0.0
    # Two factorisations of a matrix with weights from 1e2 to 1e10: round-off in positions of a metre.
    np.testing.assert_allclose(running.close(), ours, rtol=0, atol=1e-11)

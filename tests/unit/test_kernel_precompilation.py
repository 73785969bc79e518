"""Kernels are compiled on all cores before runs: those that the runs call, each once, and no failure stops a run."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from numba import typeof
from springbench.harness.execution import interrupts
from springbench.harness.experiments import kernel_precompilation
from springbench.harness.experiments.kernel_precompilation import ERROR_CONTROL, compile_missing_kernels, list_kernels
from springbench.solvers.jit.kernel_signatures import build_type, describe_type
from springbench.solvers.kernels.iteration_loop import LoopLimits

from tests.record_kernels import SOLVERS, record_kernels

NORMALS = "springbench.harness.recording.strain_shading:_normals_kernel"
STRAINS = "springbench.harness.scenes.spring_strains:_strains_kernel"
POINTS, NUMBERS = ["array", "float64", 2, "C", True, True], ["array", "float64", 1, "C", True, True]
EDGES, TRIANGLES = ["array", "int64", 2, "C", True, True], ["array", "int64", 2, "C", False, True]
NORMALS_SIGNATURE = [NORMALS, [POINTS, TRIANGLES, POINTS]]
STRAINS_SIGNATURE = [STRAINS, [POINTS, EDGES, NUMBERS, NUMBERS, NUMBERS]]

COMPILE_MISSING = """
import sys
from pathlib import Path
from springbench.harness.experiments import kernel_precompilation
kernel_precompilation.SIGNATURES_PATH = Path(sys.argv[1])
kernel_precompilation.list_usable_cores = lambda: [0, 1]
kernel_precompilation.compile_missing_kernels(["numba"], print)
"""
CALL_KERNELS = """
import numpy as np
from springbench.harness.recording import strain_shading
from springbench.harness.scenes import spring_strains
points, edges, numbers = np.zeros((2, 3)), np.array([[0, 1]]), np.ones(1)
triangles = np.array([[0, 1, 1]])
triangles.flags.writeable = False
strain_shading._normals_kernel(points, triangles, np.zeros((2, 3)))
spring_strains._strains_kernel(points, edges, numbers, numbers, numbers)
for kernel in (strain_shading._normals_kernel, spring_strains._strains_kernel):
    print(sum(kernel.stats.cache_hits.values()), sum(kernel.stats.cache_misses.values()))
"""


@pytest.fixture
def run_code(tmp_path: Path) -> Callable[..., str]:
    """Run code with these signatures in a process with an empty cache, and return what it prints."""

    def run(code: str, *signatures: Any) -> str:
        path = tmp_path / "signatures.json"
        path.write_text(json.dumps({"callers": {"numba": [*range(len(signatures))]}, "kernels": signatures}))
        variables = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        command = [sys.executable, "-c", code, str(path)]
        return subprocess.run(command, env=variables, check=True, capture_output=True, text=True).stdout

    return run


RECORD = np.dtype([("count", np.int64), ("length", np.float64)])
ARRAYS = np.zeros((2, 3)), np.zeros((2, 3)).T, np.zeros(4, np.int32)[::2], np.zeros(1, RECORD)


@pytest.mark.parametrize(
    "value",
    [
        3,
        2.5,
        True,
        np.float32(1.0),
        None,
        *ARRAYS,
        (1, 2),
        (1, 2.0),
        (np.zeros(3), (4, 5.0)),
        LoopLimits(1, 0.0, 0.0, 2),
    ],
    ids=lambda value: str(typeof(value)),
)
def test_a_type_is_the_same_after_it_was_described(value: Any):
    assert build_type(json.loads(json.dumps(describe_type(typeof(value))))) == typeof(value)


def test_an_array_that_is_only_read_has_a_type_of_its_own():
    array = np.zeros(3)
    array.flags.writeable = False
    assert build_type(describe_type(typeof(array))) == typeof(array) != typeof(np.zeros(3))


def test_a_type_without_a_description_is_refused():
    with pytest.raises(ValueError, match="expected a number"):
        describe_type(typeof(np.zeros(1, "datetime64[s]")))


def test_missing_kernels_are_compiled_once_and_then_loaded(run_code: Callable[..., str], tmp_path: Path):
    signatures = NORMALS_SIGNATURE, STRAINS_SIGNATURE
    assert run_code(COMPILE_MISSING, *signatures) == "compiling 2 kernels on 2 cores (once)\n"
    assert run_code(CALL_KERNELS) == "1 0\n1 0\n"
    assert run_code(COMPILE_MISSING, *signatures) == ""
    assert not [*tmp_path.rglob("*.lock")]


UNKNOWN_KERNELS = [[NORMALS + "_of_before", [POINTS]], ["springbench.of_before:kernel", [POINTS]]]
WRONG = [NORMALS, [POINTS, NUMBERS, POINTS]]


def test_what_cannot_be_compiled_stops_nothing(run_code: Callable[..., str], tmp_path: Path):
    assert run_code(COMPILE_MISSING, *UNKNOWN_KERNELS) == ""
    assert (
        run_code(COMPILE_MISSING, WRONG, *UNKNOWN_KERNELS, STRAINS_SIGNATURE)
        == "compiling 2 kernels on 2 cores (once)\n"
    )
    assert run_code(CALL_KERNELS) == "0 1\n1 0\n"
    assert not [*tmp_path.rglob("*.lock")]


KILL_EACH = """
import os, signal
from springbench.solvers.jit import kernel_cache
def kill(path, content):
    os.kill(os.getpid(), signal.SIGKILL)
kernel_cache._write_atomically = kill
"""


def test_a_killed_process_stops_nothing(run_code: Callable[..., str]):
    signatures = NORMALS_SIGNATURE, STRAINS_SIGNATURE
    assert run_code(KILL_EACH + COMPILE_MISSING, *signatures) == "compiling 2 kernels on 2 cores (once)\n"
    assert run_code(CALL_KERNELS) == "0 1\n0 1\n"


REFUSE_WRITING = """
from pathlib import Path
from springbench.solvers.jit import kernel_cache
kernel_cache._writable_root = lambda source: Path("/none")
"""


def test_nothing_is_compiled_ahead_where_it_cannot_be_stored(run_code: Callable[..., str]):
    assert run_code(REFUSE_WRITING + COMPILE_MISSING, NORMALS_SIGNATURE, STRAINS_SIGNATURE) == ""


def test_one_core_compiles_nothing_ahead(monkeypatch: pytest.MonkeyPatch):
    def refuse(*arguments: object) -> None:
        raise AssertionError("a process was started")

    monkeypatch.setattr(kernel_precompilation, "list_usable_cores", lambda: [0])
    monkeypatch.setattr(kernel_precompilation, "run_tasks", refuse)
    compile_missing_kernels(["numba"], refuse)


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_kernels_that_are_stated_are_those_that_a_run_calls(solver: str):
    assert set(record_kernels(solver)) == {json.dumps(signature) for signature in list_kernels(solver)}


def test_the_search_for_a_method_calls_kernels_that_are_stated():
    """A trial that is stopped early on a busy machine may leave out some."""
    called, stated = set(record_kernels(ERROR_CONTROL)), {json.dumps(one) for one in list_kernels(ERROR_CONTROL)}
    assert called <= stated
    assert len(called) > 0.8 * len(stated)


def test_ctrl_c_ends_the_processes_that_compile(tmp_path: Path):
    arguments = ["run", "hanging-cloth", "--size", "8", "--solver", "numba", "--results", str(tmp_path / "results")]
    process = subprocess.Popen(
        [sys.executable, "-m", "springbench", *arguments],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert process.stderr
    while "compiling" not in process.stderr.readline():
        assert process.poll() is None
    while not (found := psutil.Process(process.pid).children(recursive=True)):
        assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    process.communicate()
    assert process.returncode == interrupts.INTERRUPT_EXIT_CODE
    _, alive = psutil.wait_procs(found, timeout=30.0)
    assert not alive

"""Kernels, which the simulator runs as Python, compile for a device as they are launched; none is needed for that.

    NUMBA_ENABLE_CUDASIM=1 .venv/bin/python -m pytest -q -n 0 -s -m long tests/cuda/test_ahead.py

The simulator has no types. So here it records with which ones each kernel is launched, and another process compiles it
for them (`tests.cuda.ahead`). A line a kernel says what it takes of a device.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.solvers.cuda import cuda_device
from springbench.solvers.linalg import additive_schwarz
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.position_based.xpbd import Xpbd, XpbdSmallSteps
from springbench.solvers.methods.vertex_block import device_vbd
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.step_problem import StopRule

from tests.cuda import ahead
from tests.cuda.near import PRECISIONS
from tests.cuda.test_touching import touching
from tests.effect_scenes import AIR_DRAG_EFFECT, BENDING_EFFECT, DASHPOT_EFFECT, build_moving_problem
from tests.effect_scenes import build_effect_cloth as cloth_with
from tests.scene_builders import build_cloth, build_first_problem, build_random_problem

ROOT = Path(__file__).resolve().parents[2]

METHODS: tuple[Callable[..., Any], ...] = (
    VertexBlockDescent,
    lambda **on: NewtonCG(preconditioner="schwarz", **on),
    Xpbd,
    XpbdSmallSteps,
)

SHARED_BYTES, NUM_REGISTERS = 48 * 1024, 65_536
"""Bytes of shared memory that a block has without asking for more, and registers that it has (CUDA C++ Programming
Guide, "Technical Specifications per Compute Capability")."""

MOST_THREADS = 256
"""Of a block, that kernels are launched with."""

WITHOUT_DOUBLES = (
    *("device_vbd_kernels.sweep_colour", "device_vbd_kernels.extrapolate_iterate"),
    *("device_xpbd_kernels.project_colour", "schwarz_kernels.restrict_residual", "schwarz_kernels.apply_inverses"),
)
"""Kernels that in float32 compute nothing in float64: a literal in it would make all that it meets float64."""


def missing() -> str:
    """What of the tools is not installed, or nothing."""
    if find_spec("numba_cuda") is None:
        return "numba-cuda"
    find: Any = import_module("cuda.pathfinder")
    for library in ("nvvm", "nvJitLink"):
        try:
            find.load_nvidia_dynamic_lib(library)
        except find.DynamicLibNotFoundError:
            return library
    return ""


def record_launches(monkeypatch: pytest.MonkeyPatch) -> dict[str, set[bytes]]:
    """Examples of arguments, pickled, of each kernel that is launched from now on."""
    names = {id(kernel): name for name, kernel in ahead.kernels().items()}
    found = dict[str, set[bytes]]()
    simulated: Any = import_module("numba.cuda.simulator.kernel").FakeCUDAKernel
    usual = simulated.__call__

    def call(self: Any, *arguments: Any) -> Any:
        if not ahead.for_kernels_alone(self):
            found.setdefault(names[id(self)], set()).add(pickle.dumps(tuple(map(ahead.example, arguments))))
        return usual(self, *arguments)

    monkeypatch.setattr(simulated, "__call__", call)
    return found


def launch_all() -> None:
    """Have the methods launch every kernel, in both precisions."""
    problems = build_random_problem(0, weights=(1e4, np.inf, 1e2)), build_first_problem(build_cloth(3, "exact"))
    for precision in PRECISIONS:
        for method in METHODS:
            for problem in problems:
                method(device="cuda", precision=precision).prepare(problem.system).solve(problem, StopRule(8, 1e-3))
        touched = touching("sphere")
        VertexBlockDescent(device="cuda", precision=precision).prepare(touched.system).solve(touched, StopRule(2))
        damped = build_moving_problem(cloth_with(BENDING_EFFECT, DASHPOT_EFFECT, AIR_DRAG_EFFECT))
        newton = NewtonCG(preconditioner="schwarz", device="cuda", precision=precision)
        newton.prepare(damped.system).solve(damped, StopRule(2))


@pytest.mark.long
@pytest.mark.skipif(not cuda_device.is_simulated(), reason="on a device each kernel that is launched is compiled")
@pytest.mark.skipif(bool(missing()), reason=f"{missing()} is not installed; {cuda_device.INSTALL_HINT}")
def test_every_kernel_compiles_as_it_is_launched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(additive_schwarz, "SUBDOMAIN_SIZE", 3)  # small scenes have levels, and the reference changes soon
        patch.setattr(device_vbd, "REBASE_INTERVAL", 3)
        launches = record_launches(patch)
        launch_all()
        assert set(launches) == set(ahead.kernels())
    file = tmp_path / "launches.pickle"
    file.write_bytes(pickle.dumps(launches))
    without = {name: value for name, value in os.environ.items() if name != "NUMBA_ENABLE_CUDASIM"}
    command = [sys.executable, "-m", "tests.cuda.ahead", str(file)]
    completed = subprocess.run(command, cwd=ROOT, env=without, capture_output=True, text=True, check=False)
    assert completed.returncode == 0, completed.stderr
    found = {name: [ahead.CompiledKernel(*one) for one in each] for name, each in json.loads(completed.stdout).items()}
    assert set(found) == set(launches)
    assert {name: one.wrong for name, each in found.items() for one in each if one.wrong} == {}
    for name, each in found.items():
        for one in each:
            print(f"{name}: {one}")
            assert one.spilled == 0, name
            assert one.shared <= SHARED_BYTES, name
            assert one.registers * MOST_THREADS <= NUM_REGISTERS, name
    for name in WITHOUT_DOUBLES:
        assert [one.doubles for one in found[f"{name}, float32"]] == [0], name

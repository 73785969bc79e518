"""Kernels that the simulator runs as Python compile for a device, as they are launched: no device is needed for that.

    NUMBA_ENABLE_CUDASIM=1 .venv/bin/python -m pytest -q -n 0 -m long tests/cuda/test_ahead.py

The simulator knows no types. So here it tells with which ones each kernel is launched, and another process compiles it
for them. Where the extra `cuda` is not installed there is nothing to compile with.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.simulation.measure import Settings, steps
from solvers.cuda import device, triad, vbd
from solvers.cuda.target import cuda
from solvers.linear import schwarz
from solvers.methods.explicit import BlanesMoan4, Tsitouras5, VelocityVerlet
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.newton_cg import NewtonCG
from solvers.methods.pncg import NonlinearCG
from solvers.methods.vbd import VertexBlockDescent
from solvers.methods.xpbd import Xpbd, XpbdSmallSteps
from solvers.problem import StopRule
from tests.cuda import ahead
from tests.cuda.near import PRECISIONS
from tests.cuda.test_steps import DRAGS, staying
from tests.cuda.test_steps import cloth as moving_cloth
from tests.effects import DASHPOTS
from tests.scenes import cloth, first_problem, random_problem

METHODS: dict[str, Callable[..., Any]] = {
    "vbd": VertexBlockDescent,
    "newton-cg": lambda **on: NewtonCG(preconditioner="schwarz", **on),
    "pncg": lambda **on: NonlinearCG(preconditioner="block-jacobi", **on),
    "lbfgs": lambda **on: Lbfgs(preconditioner="a-jacobi", **on),
    "xpbd": Xpbd,
    "xpbd-small-steps": XpbdSmallSteps,
    "velocity-verlet": VelocityVerlet,
    "blanes-moan-4": BlanesMoan4,
    "tsitouras-5": lambda **on: Tsitouras5(error=1e-4, **on),
}
SHARED = 48 * 1024
"""Bytes that a block has without asking for more (CUDA C++ Programming Guide, "Compute Capabilities")."""
REGISTERS = 255
"""Of a thread, the most there are (the same); what does not fit is spilled."""


@contextmanager
def recorded(monkeypatch: pytest.MonkeyPatch) -> Generator[dict[str, list[tuple[Any, ...]]]]:
    """Examples of arguments of each kernel, one for each set of types, as they are launched meanwhile."""
    names = {id(kernel): name for name, kernel in ahead.kernels().items()}
    found, seen = dict[str, list[tuple[Any, ...]]](), set[tuple[str, bytes]]()
    fake: Any = import_module("numba.cuda.simulator.kernel").FakeCUDAKernel
    usual = fake.__call__

    def call(self: Any, *arguments: Any) -> Any:
        if not self._device:
            examples = tuple(ahead.example(argument) for argument in arguments)
            key = names[id(self)], str([_types(each) for each in examples]).encode()
            if key not in seen:
                seen.add(key)
                found.setdefault(key[0], []).append(examples)
        return usual(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(fake, "__call__", call)
        yield found


def _types(argument: Any) -> Any:
    if isinstance(argument, tuple):
        return type(argument), [_types(part) for part in argument]
    return type(argument), getattr(argument, "dtype", None), np.ndim(argument)


def launch_all() -> None:
    """Every kernel, in both precisions, with what methods launch it with."""
    for precision in PRECISIONS:
        for make in METHODS.values():
            for problem in (random_problem(0, weights=(1e4, np.inf, 1e2)), first_problem(cloth(3, "exact"))):
                prepared = make(device="cuda", precision=precision).prepare(problem.system)
                prepared.solve(problem, StopRule(8, 1e-3))
        made = moving_cloth(*DRAGS, DASHPOTS)
        on_it = staying(made, NonlinearCG(preconditioner="block-jacobi", device="cuda", precision=precision))
        for step in steps(made, on_it, Settings(StopRule(1), "current", 1, 1)):
            on_it.keep(step)
    triad.run(*(cuda.device_array(1, np.float64) for _ in range(3)))


@pytest.mark.long
@pytest.mark.skipif(not device.simulated(), reason="a device compiles each kernel that it is asked for itself")
@pytest.mark.skipif(find_spec("numba_cuda") is None, reason=f"numba-cuda is not installed; {device.INSTALL}")
def test_every_kernel_compiles_as_it_is_launched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(schwarz, "PATCH", 3)  # so that small scenes have levels
        patch.setattr(vbd, "REBASE", 3)
        with recorded(patch) as launches:
            launch_all()
        assert set(launches) == set(ahead.kernels())
    file = tmp_path / "launches.pickle"
    file.write_bytes(pickle.dumps(launches))
    command = [sys.executable, "-m", "tests.cuda.ahead", str(file)]
    without = {name: value for name, value in os.environ.items() if name != "NUMBA_ENABLE_CUDASIM"}
    told = subprocess.run(command, env=without, capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr
    found = json.loads(told.stdout)
    assert set(found) == set(launches)
    wrong = {name: [why for why, *_ in each if why] for name, each in found.items()}
    assert not any(wrong.values()), "\n".join(f"{name}: {why}" for name, each in wrong.items() for why in each)
    for name, each in found.items():
        for _, registers, shared, spilled in each:
            print(f"{name}: {registers} registers, {shared} bytes of shared memory, {spilled} spilled")
            assert 0 < registers <= REGISTERS
            assert shared <= SHARED, name

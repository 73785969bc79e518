"""Methods on a CUDA device: in Numba's simulator where the environment has `NUMBA_ENABLE_CUDASIM=1`, else on a device.

    NUMBA_ENABLE_CUDASIM=1 .venv/bin/python -m pytest -q -n 0 -m slow tests/cuda

Without either there is nothing to ask: `tests/unit/test_device.py` has what then holds.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from math import prod
from typing import Any

import pytest

from solvers.cuda import device
from solvers.problem import Unsupported


def _there() -> bool:
    try:
        device.ready("tests")
    except Unsupported:
        return False
    return True


collect_ignore_glob = [] if _there() else ["test_*.py"]


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a block of one thread the simulator asks all the time whether it has ended, which halves its speed, and has it
    wait for itself; here it is waited for, and does not."""
    if not device.simulated():
        return
    kernel: Any = import_module("numba.cuda.simulator.kernel")
    usual = kernel.BlockManager.run

    def run(self: Any, grid_point: Any, *args: Any) -> None:
        if prod(self._block_dim) > 1:
            usual(self, grid_point, *args)
            return
        thread = kernel.BlockThread(lambda: self._f(*args), self, grid_point, (0, 0, 0), self._debug)
        thread.syncthreads = lambda: None
        thread.start()
        thread.join()
        if thread.exception:
            raise thread.exception[0].with_traceback(thread.exception[1])

    monkeypatch.setattr(kernel.BlockManager, "run", run)


@pytest.fixture(autouse=True)
def quick_turns() -> Iterator[None]:
    """The simulator's threads wait for each other all the time: the interpreter lets them take turns ten times as
    often as usual or more."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(usual)

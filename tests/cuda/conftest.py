"""Methods on a CUDA device: in Numba's simulator where the environment has `NUMBA_ENABLE_CUDASIM=1`, else on a device.

    NUMBA_ENABLE_CUDASIM=1 .venv/bin/python -m pytest -q -n 0 -m slow tests/cuda

Without either there is nothing to ask: `tests/unit/test_device.py` has what then holds.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

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
def quick_turns() -> Iterator[None]:
    """The simulator's threads wait for each other all the time: the interpreter lets them take turns ten times as
    often as usual or more."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(usual)

"""Methods on a CUDA device: in Numba's simulator where the environment has `NUMBA_ENABLE_CUDASIM=1`, else on a device.

    NUMBA_ENABLE_CUDASIM=1 .venv/bin/python -m pytest -q -n 0 -m slow tests/cuda

Without either nothing can be tested here; `tests/unit/test_device.py` has the tests for that.
"""

from __future__ import annotations

import pytest
from springbench.solvers.cuda import cuda_device
from springbench.solvers.model.step_problem import Unsupported


def _is_device_present() -> bool:
    try:
        cuda_device.require_device("tests")
    except Unsupported:
        return False
    return True


collect_ignore_glob = [] if _is_device_present() else ["test_*.py"]


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulator is, where it stands for a device."""
    if cuda_device.is_simulated():
        from tests.cuda.simulator import install_simulator  # takes a second to load

        install_simulator(monkeypatch)

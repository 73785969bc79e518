"""Reuse of CPU kernel functions on a device, so that each formula is written once.

The copy of a function refers to such copies of the inner functions in its globals and closure. NumPy's scalar functions
are replaced by those of `math`, which Numba's CUDA target supports. In the simulator the copies are Python functions.
"""

from __future__ import annotations

import math
from types import CellType, FunctionType
from typing import Any

import numpy as np
from springbench.solvers.cuda.cuda_device import is_simulated
from springbench.solvers.cuda.cuda_target import cuda

_DEVICE_COPIES: dict[Any, Any] = {}


def _compile_for_device(function: Any) -> Any:
    return function if is_simulated() else cuda.jit(device=True)(function)


def share_with_device(function: Any) -> Any:
    """Return a device copy of a CPU function.

    The function is an inner function, a kernel or a plain Python function.
    """
    plain = getattr(function, "py_func", function)
    if plain not in _DEVICE_COPIES:
        names = {name for code in _nested_codes(plain.__code__) for name in code.co_names}
        own = {name: _replace_global(value) for name, value in plain.__globals__.items() if name in names}
        cells = tuple(CellType(_replace_global(cell.cell_contents)) for cell in plain.__closure__ or ())
        copy = FunctionType(plain.__code__, own, plain.__name__, plain.__defaults__, cells)
        copy.__module__ = plain.__module__
        _DEVICE_COPIES[plain] = _compile_for_device(copy)
    return _DEVICE_COPIES[plain]


def _nested_codes(code: Any) -> list[Any]:
    """Return a code object and all code objects nested in it."""
    return [code] + [one for inside in code.co_consts if hasattr(inside, "co_names") for one in _nested_codes(inside)]


def _replace_global(value: Any) -> Any:
    """Return the device replacement of a global."""
    if value is np and not is_simulated():
        return math
    of_processor = hasattr(value, "py_func") and "cuda" not in type(value).__module__
    return share_with_device(value) if of_processor else value

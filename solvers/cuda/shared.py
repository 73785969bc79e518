"""Functions of the processor's kernels, compiled for a device: no formula is written twice.

A copy of the function has in its globals, and in what it closes over, such copies of the inner functions that it calls.
NumPy's functions of one number are those of `math`, which Numba's CUDA target knows. In the simulator copies are
functions of Python.
"""

from __future__ import annotations

import math
from types import CellType, FunctionType
from typing import Any

import numpy as np

from solvers.cuda.device import simulated
from solvers.cuda.target import cuda

_COPIES: dict[Any, Any] = {}


def _on_device(function: Any) -> Any:
    return function if simulated() else cuda.jit(device=True)(function)


def shared(function: Any) -> Any:
    """A function of the processor's, inner, kernel or not compiled, for kernels on a device."""
    plain = getattr(function, "py_func", function)
    if plain not in _COPIES:
        names = {name for code in _codes(plain.__code__) for name in code.co_names}
        own = {name: _replaced(value) for name, value in plain.__globals__.items() if name in names}
        cells = tuple(CellType(_replaced(cell.cell_contents)) for cell in plain.__closure__ or ())
        copy = FunctionType(plain.__code__, own, plain.__name__, plain.__defaults__, cells)
        copy.__module__ = plain.__module__
        _COPIES[plain] = _on_device(copy)
    return _COPIES[plain]


def _codes(code: Any) -> list[Any]:
    """A code and those of what is defined in it."""
    return [code] + [one for inside in code.co_consts if hasattr(inside, "co_names") for one in _codes(inside)]


def _replaced(value: Any) -> Any:
    """What stands for a global on a device."""
    if value is np and not simulated():
        return math
    of_processor = hasattr(value, "py_func") and "cuda" not in type(value).__module__
    return shared(value) if of_processor else value

"""Kernels compiled ahead of time, for a device that need not be there: by Numba, libNVVM and NVIDIA's linker.

    python -m tests.cuda.ahead LAUNCHES       of a pickle {kernel: [arguments, ...]}, without the simulator's variable

prints {kernel: [[what was wrong, or ""; registers, bytes of shared memory, bytes spilled], ...]} as JSON.
"""

from __future__ import annotations

import json
import pickle
import re
import sys
from collections.abc import Generator
from importlib import import_module
from inspect import signature
from pathlib import Path
from pkgutil import iter_modules
from types import SimpleNamespace
from typing import Any

import numpy as np

import solvers.cuda
from solvers.cuda.target import cuda
from solvers.linear import schwarz

CAPABILITY = 9, 0


def kernels() -> dict[str, Any]:
    """All kernels of `solvers.cuda` that a host launches, by names that are the same in the simulator."""
    found = dict[str, Any]()
    for _, name, _ in iter_modules(solvers.cuda.__path__):
        module = import_module(f"{solvers.cuda.__name__}.{name}")
        own = {k: v for k, v in vars(module).items() if getattr(v, "__module__", None) == module.__name__}
        found |= {f"{name}.{k}": v for k, v in own.items() if hasattr(v, "py_func")}
        if "kernels" not in own:
            continue
        for real in (np.float32, np.float64):
            given = (real, schwarz.PATCH) if len(signature(own["kernels"]).parameters) == 2 else (real,)
            made = own["kernels"](*given)
            each = made._asdict() if isinstance(made, tuple) else {"kernel": made}
            found |= {f"{name}.{k}, {real.__name__}": v for k, v in each.items()}
    return {name: kernel for name, kernel in found.items() if not _on_device_only(kernel)}


def _on_device_only(kernel: Any) -> bool:
    """Whether kernels alone call it."""
    simulated = getattr(kernel, "_device", None)
    return kernel.targetoptions["device"] if simulated is None else simulated


def example(argument: Any) -> Any:
    """What has an argument's type, and can be pickled: arrays have one entry."""
    if isinstance(argument, tuple):
        parts = [example(part) for part in argument]
        return type(argument)(*parts) if hasattr(argument, "_fields") else tuple(parts)
    if hasattr(argument, "shape") and argument.shape:
        return np.zeros((1,) * len(argument.shape), argument.dtype)
    return argument


def compiled(kernel: Any, arguments: tuple[Any, ...]) -> tuple[str, int, int, int]:
    """What was wrong, or ""; registers, bytes of shared memory, bytes spilled."""
    core = import_module("cuda.core")
    types = tuple(kernel.typeof_pyval(argument) for argument in arguments)
    try:
        code, _ = cuda.compile_ptx(kernel.py_func, types, cc=CAPABILITY)
    except Exception as error:  # of Numba's types, or of libNVVM
        return f"{type(error).__name__}: {error}", 0, 0, 0
    arch = "sm_{}{}".format(*CAPABILITY)
    options = core.LinkerOptions(arch=arch, verbose=True, ptxas_options=["-v"])
    linker = core.Linker(core.ObjectCode.from_ptx(code.encode()), options=options)
    try:
        linker.link("cubin")
    except Exception as error:  # nvJitLink's, of a module that stands nowhere
        return f"{error} {linker.get_error_log()}", 0, 0, 0
    log = linker.get_info_log()
    return "", *(_number(unit, log) for unit in (r"used (\d+) registers", r"(\d+) bytes smem", r"(\d+) bytes spill st"))


def _number(pattern: str, log: str) -> int:
    told = re.search(pattern, log, re.IGNORECASE)
    return int(told[1]) if told else 0


def _all(launches: dict[str, list[tuple[Any, ...]]]) -> Generator[tuple[str, list[tuple[str, int, int, int]]]]:
    there = kernels()
    for name, examples in launches.items():
        yield name, [compiled(there[name], arguments) for arguments in examples]


if __name__ == "__main__":
    # Of functions that kernels call, Numba asks the device for what to compile; there need be none.
    import_module("numba.cuda.dispatcher").get_current_device = lambda: SimpleNamespace(compute_capability=CAPABILITY)
    sys.stdout.write(json.dumps(dict(_all(pickle.loads(Path(sys.argv[1]).read_bytes())))))

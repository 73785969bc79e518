"""Kernels compiled ahead of time, for a device that need not be there: by Numba, libNVVM and NVIDIA's linker.

    python -m tests.cuda.ahead LAUNCHES       of a pickle {kernel: {pickled arguments, ...}}, without the simulator

prints {kernel: [what became of it with each, ...]} as JSON; see `CompiledKernel`.
"""

from __future__ import annotations

import json
import pickle
import re
import sys
from importlib import import_module
from inspect import signature
from pathlib import Path
from pkgutil import iter_modules
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import springbench.solvers.cuda
from springbench.solvers.cuda.cuda_target import cuda
from springbench.solvers.linalg import additive_schwarz
from springbench.solvers.methods import newton, position_based, vertex_block

CAPABILITY = 9, 0


class CompiledKernel(NamedTuple):
    """wrong: why it does not compile, or ""; registers of a thread; bytes of shared memory of a block; bytes spilled by
    a thread; doubles: instructions of arithmetic in float64."""

    wrong: str
    registers: int = 0
    shared: int = 0
    spilled: int = 0
    doubles: int = 0


def device_modules() -> list[str]:
    """The modules of kernels: those of `springbench.solvers.cuda`, and `device_*` next to each method."""
    return [
        f"{package.__name__}.{name}"
        for package in (springbench.solvers.cuda, newton, position_based, vertex_block)
        for _, name, _ in iter_modules(package.__path__)
        if package is springbench.solvers.cuda or name.startswith("device_")
    ]


def kernels() -> dict[str, Any]:
    """All kernels that a host launches, by names that are the same in the simulator."""
    found = dict[str, Any]()
    for module in map(import_module, device_modules()):
        name = module.__name__.rpartition(".")[2]
        own = {k: v for k, v in vars(module).items() if getattr(v, "__module__", None) == module.__name__}
        found |= {f"{name}.{k}": v for k, v in own.items() if hasattr(v, "py_func")}
        for build in (v for k, v in own.items() if k.startswith("build_") and k.endswith("_kernels")):
            for real in (np.float32, np.float64):
                more = (additive_schwarz.SUBDOMAIN_SIZE,) if "patch" in signature(build).parameters else ()
                made: Any = build(real, *more)
                each = {made.py_func.__name__: made} if hasattr(made, "py_func") else made._asdict()
                found |= {f"{name}.{k}, {real.__name__}": v for k, v in each.items()}
    return {name: kernel for name, kernel in found.items() if not for_kernels_alone(kernel)}


def for_kernels_alone(function: Any) -> bool:
    """Whether no host launches it."""
    simulated = getattr(function, "_device", None)
    return function.targetoptions["device"] if simulated is None else simulated


def example(argument: Any) -> Any:
    """What has an argument's type, and can be pickled: arrays have one entry, numbers are 0."""
    if isinstance(argument, tuple):
        parts = map(example, argument)
        return type(argument)(*parts) if hasattr(argument, "_fields") else tuple(parts)
    if getattr(argument, "shape", ()):
        return np.zeros((1,) * len(argument.shape), argument.dtype)
    return type(argument)()


def compile_kernel(kernel: Any, arguments: tuple[Any, ...]) -> CompiledKernel:
    """What becomes of a kernel with such arguments, up to the machine's code."""
    core, types = import_module("cuda.core"), tuple(map(kernel.typeof_pyval, arguments))
    options = core.LinkerOptions(arch="sm_{}{}".format(*CAPABILITY), verbose=True, ptxas_options=["-v"])
    try:
        code, _ = cuda.compile_ptx(kernel.py_func, types, cc=CAPABILITY)
        linker = core.Linker(core.ObjectCode.from_ptx(code.encode()), options=options)
        linker.link("cubin")
    except Exception as error:  # Numba's, libNVVM's and the linker's have nothing in common
        return CompiledKernel(f"{type(error).__name__}: {error}")
    log = linker.get_info_log()
    units = r"used (\d+) registers", r"(\d+) bytes smem", r"(\d+) bytes spill stores"
    registers, shared, spilled = (int(re.findall(unit, log, re.IGNORECASE)[0]) for unit in units)
    doubles = re.findall(r"\b(?:add|sub|mul|fma|div|sqrt|rcp)\.[\w.]*f64\b", code)
    return CompiledKernel("", registers, shared, spilled, len(doubles))


if __name__ == "__main__":
    # Of functions that kernels call, Numba queries the device for what to compile; there need be none.
    dispatcher: Any = import_module("numba.cuda.dispatcher")
    dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=CAPABILITY)
    there, launches = kernels(), pickle.loads(Path(sys.argv[1]).read_bytes())
    done = {
        name: [compile_kernel(there[name], pickle.loads(one)) for one in launches[name]] for name in sorted(launches)
    }
    sys.stdout.write(json.dumps(done))

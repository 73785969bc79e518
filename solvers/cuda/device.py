"""The CUDA device: availability, description, free memory and error handling.

With `NUMBA_ENABLE_CUDASIM=1` in the environment, set before Numba is imported, Numba's simulator replaces the device.
It runs the same kernels thread by thread in Python, without a GPU; rows state that.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from solvers.device import SIMULATED, broken
from solvers.memory import in_words
from solvers.problem import Unsupported

INSTALL = "`.venv/bin/pip install -e '.[cuda]'` in the checkout installs what it needs in addition to NVIDIA's driver"
_PACKAGES = "numba-cuda", "cuda-bindings", "cuda-core", "cuda-toolkit", "nvidia-ml-py"
_DRIVERS = ("cudadrv", "cuda.bindings", "cuda.core")
"""Parts of the names of modules that raise driver errors."""


class DeviceFailed(RuntimeError):
    """Failure of the device: no free memory, a failed kernel, or a lost device."""


def simulated() -> bool:
    """Return whether the simulator replaces the device."""
    config = import_module("numba.core.config")
    return bool(config.ENABLE_CUDASIM)


def ready(solver: str) -> Any:
    """Return the module `numba.cuda` with a usable device.

    Raises:
        Unsupported: if there is none, with the reason and the installation command.
    """
    if simulated():
        return import_module("numba.cuda")
    if broken():
        raise Unsupported(f"{solver}: this process has lost its device; start it anew")
    try:
        version("numba-cuda")
    except PackageNotFoundError as error:
        raise Unsupported(f"{solver}: `device: cuda` needs numba-cuda, which is not installed; {INSTALL}") from error
    try:
        cuda = import_module("numba.cuda")
        cuda.current_context()
    except Exception as error:  # without a driver, without a device, with one that another holds: each has its own
        why = " ".join(str(error).split()).rstrip(":. ")
        raise Unsupported(f"{solver}: there is no CUDA device ({why}); {INSTALL}") from error
    return cuda


def require_memory(solver: str, needed: float) -> None:
    """Raise Unsupported if the device has fewer free bytes than needed."""
    if simulated():
        return
    left, _ = import_module("numba.cuda").current_context().get_memory_info()
    if needed > left:
        raise Unsupported(f"{solver}: needs {in_words(needed)} on the device, which has {in_words(left)} left")


def told() -> dict[str, Any]:
    """Return the row columns that describe the device: its name, memory, driver and versions."""
    versions = json.dumps(dict(_versions()), sort_keys=True)
    if simulated():
        return {"device": SIMULATED, "device_versions": versions}
    cuda = import_module("numba.cuda")
    device = cuda.get_current_device()
    name = device.name.decode() if isinstance(device.name, bytes) else str(device.name)
    capability = ".".join(map(str, device.compute_capability))
    _, memory = cuda.current_context().get_memory_info()
    columns = {
        "device": f"{name}, compute capability {capability}, {device.MULTIPROCESSOR_COUNT} multiprocessors",
        "device_memory_gib": round(memory / 2**30, 1),
        "device_versions": versions,
    }
    return columns | _driver()


def _versions() -> Generator[tuple[str, str]]:
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            yield package, version(package)


_ASKED: dict[str, Callable[[Any, Any], float]] = {
    "sm_clock_mhz": lambda nvml, handle: nvml.nvmlDeviceGetClockInfo(handle, nvml.NVML_CLOCK_SM),
    "memory_clock_mhz": lambda nvml, handle: nvml.nvmlDeviceGetClockInfo(handle, nvml.NVML_CLOCK_MEM),
    "power_w": lambda nvml, handle: nvml.nvmlDeviceGetPowerUsage(handle) / 1000,
    "power_limit_w": lambda nvml, handle: nvml.nvmlDeviceGetEnforcedPowerLimit(handle) / 1000,
    "performance_state": lambda nvml, handle: nvml.nvmlDeviceGetPerformanceState(handle),
    "temperature_c": lambda nvml, handle: nvml.nvmlDeviceGetTemperature(handle, nvml.NVML_TEMPERATURE_GPU),
}
"""NVML queries of the device's state, by column."""


def state() -> dict[str, float | None]:
    """Return the current clocks, power and temperature; None if unavailable, as in the simulator."""
    found: dict[str, float | None] = dict.fromkeys(_ASKED)
    with _management() as nvml, suppress(Exception):  # the library, its driver or the right to ask may be missing
        handle = _handle(nvml, import_module("numba.cuda").get_current_device())
        for name, ask in _ASKED.items():
            with suppress(Exception):  # not every device tells everything
                found[name] = float(ask(nvml, handle))
    return found


def _driver() -> dict[str, str]:
    with _management() as nvml, suppress(Exception):
        told = nvml.nvmlSystemGetDriverVersion()
        return {"device_driver": told.decode() if isinstance(told, bytes) else str(told)}
    return {}


@contextmanager
def _management() -> Generator[Any]:
    """Open NVIDIA's management library; yield None if it is unavailable."""
    nvml: Any = None
    if not simulated():
        with suppress(Exception):
            there = import_module("pynvml")
            there.nvmlInit()
            nvml = there
    try:
        yield nvml
    finally:
        with suppress(Exception):
            nvml.nvmlShutdown()


def _handle(nvml: Any, device: Any) -> Any:
    """Return the library's handle of the device, by its UUID, because the two may number devices differently."""
    uuid = str(getattr(device, "uuid", ""))
    if uuid:
        return nvml.nvmlDeviceGetHandleByUUID(uuid if uuid.startswith("GPU-") else f"GPU-{uuid}")
    return nvml.nvmlDeviceGetHandleByIndex(device.id)


@contextmanager
def guarded() -> Generator[None]:
    """Convert driver errors to DeviceFailed.

    After an error other than a lack of memory, the process cannot use its device again and does not attempt to.
    """
    try:
        yield
    except Exception as error:
        origin = type(error).__module__
        if not any(part in origin for part in _DRIVERS):
            raise
        text = " ".join(str(error).split())
        if "MEMORY" in text.upper() and "ILLEGAL" not in text.upper():
            raise DeviceFailed(f"the device has no memory left: {text}") from error
        broken(text)
        raise DeviceFailed(f"the device failed: {text}") from error

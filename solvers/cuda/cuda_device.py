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

from springbench.solvers.iteration.device_interface import SIMULATOR_NAME, is_device_lost, record_device_loss
from springbench.solvers.linalg.memory import format_bytes
from springbench.solvers.model.step_problem import Unsupported

INSTALL_HINT = (
    "`.venv/bin/pip install -e '.[cuda]'` in the checkout installs what it needs in addition to NVIDIA's driver"
)
_REPORTED_PACKAGES = "numba-cuda", "cuda-bindings", "cuda-core", "cuda-toolkit", "nvidia-ml-py"
_DRIVER_MODULES = ("cudadrv", "cuda.bindings", "cuda.core")
"""Parts of the names of modules that raise driver errors."""


class DeviceFailure(RuntimeError):
    """Failure of the device: no free memory, a failed kernel, or a lost device."""


def is_simulated() -> bool:
    """Return whether the simulator replaces the device."""
    config = import_module("numba.core.config")
    return bool(config.ENABLE_CUDASIM)


def require_device(solver: str) -> Any:
    """Return the module `numba.cuda` with a usable device.

    Raises:
        Unsupported: if there is none, with the reason and the installation command.
    """
    if is_simulated():
        return import_module("numba.cuda")
    if is_device_lost():
        raise Unsupported(f"{solver}: this process has lost its device; restart it")
    try:
        version("numba-cuda")
    except PackageNotFoundError as error:
        raise Unsupported(
            f"{solver}: `device: cuda` needs numba-cuda, which is not installed; {INSTALL_HINT}"
        ) from error
    try:
        cuda = import_module("numba.cuda")
        cuda.current_context()
    except Exception as error:  # a missing driver, a missing device and a locked device raise different exceptions
        why = " ".join(str(error).split()).rstrip(":. ")
        raise Unsupported(f"{solver}: there is no CUDA device ({why}); {INSTALL_HINT}") from error
    return cuda


def require_memory(solver: str, needed: float) -> None:
    """Check that the device has enough free memory.

    Args:
        solver: name of the solver, for the message.
        needed: memory that it needs [bytes].

    Raises:
        Unsupported: the device has fewer free bytes.
    """
    if is_simulated():
        return
    left, _ = import_module("numba.cuda").current_context().get_memory_info()
    if needed > left:
        raise Unsupported(f"{solver}: needs {format_bytes(needed)} on the device, which has {format_bytes(left)} left")


def describe_device() -> dict[str, Any]:
    """Return the row columns that describe the device: its name, memory, driver and versions."""
    versions = json.dumps(dict(_package_versions()), sort_keys=True)
    if is_simulated():
        return {"device": SIMULATOR_NAME, "device_versions": versions}
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
    return columns | _driver_version()


def _package_versions() -> Generator[tuple[str, str]]:
    for package in _REPORTED_PACKAGES:
        with suppress(PackageNotFoundError):
            yield package, version(package)


_NVML_QUERIES: dict[str, Callable[[Any, Any], float]] = {
    "sm_clock_mhz": lambda nvml, handle: nvml.nvmlDeviceGetClockInfo(handle, nvml.NVML_CLOCK_SM),
    "memory_clock_mhz": lambda nvml, handle: nvml.nvmlDeviceGetClockInfo(handle, nvml.NVML_CLOCK_MEM),
    "power_w": lambda nvml, handle: nvml.nvmlDeviceGetPowerUsage(handle) / 1000,
    "power_limit_w": lambda nvml, handle: nvml.nvmlDeviceGetEnforcedPowerLimit(handle) / 1000,
    "performance_state": lambda nvml, handle: nvml.nvmlDeviceGetPerformanceState(handle),
    "temperature_c": lambda nvml, handle: nvml.nvmlDeviceGetTemperature(handle, nvml.NVML_TEMPERATURE_GPU),
}
"""NVML queries of the device's state, by column."""


def read_device_state() -> dict[str, float | None]:
    """Return the current clocks, power and temperature; None if unavailable, as in the simulator."""
    found: dict[str, float | None] = dict.fromkeys(_NVML_QUERIES)
    with _open_nvml() as nvml, suppress(Exception):  # the library, its driver or the permission may be missing
        handle = _nvml_handle(nvml, import_module("numba.cuda").get_current_device())
        for name, query in _NVML_QUERIES.items():
            with suppress(Exception):  # not every device reports all values
                found[name] = float(query(nvml, handle))
    return found


def _driver_version() -> dict[str, str]:
    with _open_nvml() as nvml, suppress(Exception):
        driver_version = nvml.nvmlSystemGetDriverVersion()
        return {"device_driver": driver_version.decode() if isinstance(driver_version, bytes) else str(driver_version)}
    return {}


@contextmanager
def _open_nvml() -> Generator[Any]:
    """Open NVIDIA's management library; yield None if it is unavailable."""
    nvml: Any = None
    if not is_simulated():
        with suppress(Exception):
            there = import_module("pynvml")
            there.nvmlInit()
            nvml = there
    try:
        yield nvml
    finally:
        with suppress(Exception):
            nvml.nvmlShutdown()


def _nvml_handle(nvml: Any, device: Any) -> Any:
    """Return the handle of the device in NVML, by its UUID.

    NVML and CUDA may number devices differently.
    """
    uuid = str(getattr(device, "uuid", ""))
    if uuid:
        return nvml.nvmlDeviceGetHandleByUUID(uuid if uuid.startswith("GPU-") else f"GPU-{uuid}")
    return nvml.nvmlDeviceGetHandleByIndex(device.id)


@contextmanager
def guard_device_errors() -> Generator[None]:
    """Convert driver errors to DeviceFailure.

    After an error other than a lack of memory, the process cannot use its device again and does not attempt to.
    """
    try:
        yield
    except Exception as error:
        origin = type(error).__module__
        if not any(part in origin for part in _DRIVER_MODULES):
            raise
        text = " ".join(str(error).split())
        if "MEMORY" in text.upper() and "ILLEGAL" not in text.upper():
            raise DeviceFailure(f"the device has no memory left: {text}") from error
        record_device_loss(text)
        raise DeviceFailure(f"the device failed: {text}") from error

"""Provenance of a measurement (machine, library versions, code version), and the number of threads."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import import_module
from pathlib import Path
from time import perf_counter, process_time, sleep
from typing import Any, Literal

from springbench.harness.errors import InputError, InputMistake
from springbench.solvers.platform_calls import list_usable_cores, measure_memory, read_load_average

_PROJECT_ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = ("harness", "solvers")
_LOAD_SAMPLE_SECONDS, _IDLE_ROUND_UP = 0.3, 0.25
"""Least duration of the sample of core usage [s], and total load [cores] that still counts as idle."""

_REPORTED_LIBRARIES = ("numpy", "scipy", "numba", "llvmlite", "cholespy", "pyarrow", "rerun-sdk", "pyvista", "vtk")


@dataclass(frozen=True, slots=True)
class MachineInfo:
    """Properties of the machine that affect speed; they do not identify its owner.

    Attributes:
        cpu: name of the processor.
        cores: number of cores that this process may use.
        memory_gib: memory [GiB], to one decimal.
        operating_system: operating system, release and architecture.
    """

    cpu: str
    cores: int
    memory_gib: float
    operating_system: str

    @property
    def machine_id(self) -> str:
        """12 hexadecimal digits that depend on processor, cores and memory (rounded to 1 GiB)."""
        text = f"{self.cpu}|{self.cores}|{round(self.memory_gib)}"
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def describe_machine() -> MachineInfo:
    """Describe the machine of this process, with the cores that it may use now."""
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    return MachineInfo(_read_cpu_name(), _count_cores(), round(measure_memory() / 2**30, 1), system)


@cache
def compute_node_id() -> str:
    """Compute 12 hexadecimal digits that identify this computer.

    They distinguish computers of the same kind, and do not reveal its name.
    """
    return hashlib.sha256(f"springbench {platform.node()}".encode()).hexdigest()[:12]


@cache
def _read_cpu_name() -> str:
    # lscpu also names ARM processors, for which the kernel reports only numbers.
    try:
        completed = subprocess.run(["lscpu"], env={**os.environ, "LC_ALL": "C"}, capture_output=True, text=True)
    except OSError:
        return platform.processor() or platform.machine()
    fields = (line.partition(":") for line in completed.stdout.splitlines())
    names = [value.strip() for name, _, value in fields if name.strip() == "Model name"]
    return names[0] if names else platform.machine()


def _count_usable_cores() -> int:
    return min(_count_cores(), int(os.environ.get("NUMBA_NUM_THREADS") or _count_cores()))


def _count_cores() -> int:
    return len(list_usable_cores())


@cache
def collect_versions(*more: str) -> dict[str, str]:
    """Collect the versions of Python, the standard set of libraries and more packages.

    Absent ones are omitted.
    """
    found = {"python": platform.python_version()}
    for name in (*_REPORTED_LIBRARIES, *more):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


@cache
def read_commit(root: Path = _PROJECT_ROOT) -> str:
    """Read the commit of a checkout, with `-dirty` if tracked files differ.

    The default is the project's own checkout, independent of the working directory. This function never fails.

    Returns:
        The commit, or "unknown" outside a checkout.
    """
    # An explicit repository prevents git from using one that merely contains the project.
    git = ["git", "--no-optional-locks", f"--git-dir={root / '.git'}", f"--work-tree={root}"]
    try:
        completed = subprocess.run(
            [*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=root,
            capture_output=True,
            text=True,
        )
    except OSError:
        return "unknown"
    return completed.stdout.strip() if completed.returncode == 0 else "unknown"


@cache
def hash_sources(root: Path = _PROJECT_ROOT) -> str:
    """Hash the project's Python sources to 12 hexadecimal digits.

    It is SHA-256 over their paths and contents.
    """
    digest = hashlib.sha256()
    sources = (path for package in _PACKAGES for path in (root / package).rglob("*.py"))
    for name, path in sorted((path.relative_to(root).as_posix(), path) for path in sources):
        content = path.read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:12]


@dataclass(frozen=True, slots=True)
class ThreadChoice:
    """Number of threads of BLAS and Numba, and the reason if it was chosen automatically."""

    count: int
    reason: str = ""


def choose_threads(requested: int | Literal["auto"]) -> ThreadChoice:
    """Return the requested number of threads.

    For "auto" it is the number of idle cores, constant within a process.
    """
    return _count_idle_cores() if requested == "auto" else ThreadChoice(requested)


@cache
def start_load_sample() -> tuple[float, float]:
    """Start to sample the usage of the cores, for `choose_threads("auto")`.

    A command that calls this before its imports does not wait for the sample afterwards.

    Returns:
        Wall time and processor time of this process [s] at the start of the sample.
    """
    import psutil  # only here: it takes as long to import as the rest of this module

    psutil.cpu_percent(None, percpu=True)  # the next call returns the usage since this one
    return perf_counter(), process_time()


@cache
def _count_idle_cores() -> ThreadChoice:
    """Count the cores that other processes leave idle.

    It is computed once, so that all runs use the same number.
    """
    import psutil

    usable = _count_usable_cores()
    mine = list_usable_cores()
    began, own_seconds = start_load_sample()
    sleep(max(0.0, began + _LOAD_SAMPLE_SECONDS - perf_counter()))
    busy = psutil.cpu_percent(None, percpu=True)
    own_share = max(0.0, (process_time() - own_seconds) / (perf_counter() - began))  # a fork starts at 0
    idle = min(len(mine), own_share + sum(1.0 - busy[core] / 100 for core in mine if core < len(busy)))
    number = min(usable, max(1, int(idle + _IDLE_ROUND_UP)))
    load = read_load_average()
    return ThreadChoice(
        number, f"threads: {number} of {usable}, for {idle:.1f} cores were idle (load average {load:.1f})"
    )


def check_thread_count(number: int) -> None:
    """Raise InputError if this process may not use the given number of threads."""
    usable = _count_usable_cores()
    if not 1 <= number <= usable:
        expected = f"should be from 1 to {usable}, the cores that this process may use, not {number}"
        raise InputError(InputMistake(expected, key="threads"))


@contextmanager
def limit_threads(threads: int) -> Generator[None]:
    """Limit BLAS and Numba's parallel kernels to `threads` threads each inside the block.

    The previous limits are restored afterwards.

    Raises:
        InputError: if this process may not use that many threads.
    """
    # Imported here: BLAS can only be limited once it is loaded. NumPy and SciPy contain one BLAS each, and a process
    # that computes nothing should not wait for them.
    import numba

    import_module("scipy.linalg")
    check_thread_count(threads)
    before = numba.get_num_threads()
    with _load_thread_pools(len(sys.modules)).limit(limits=threads, user_api="blas"):
        numba.set_num_threads(threads)
        try:
            yield
        finally:
            numba.set_num_threads(before)


@lru_cache(maxsize=1)
def _load_thread_pools(modules: int) -> Any:
    """Return the loaded libraries that have thread pools.

    They are loaded with modules, so a new search is needed only if the number of modules has changed. Reading the
    system's list of loaded libraries takes longer than writing the rows of a short run.
    """
    from threadpoolctl import ThreadpoolController  # pyright: ignore[reportMissingTypeStubs]

    return ThreadpoolController()

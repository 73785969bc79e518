"""Compile the kernels of runs on all cores, before the first run starts.

A run compiles each kernel at its first call, one after the other on one core. kernel_signatures.json states which
kernels each solver calls, so that several processes can compile them, and end before anything is timed. Kernels that
are not in the file are compiled when they are called. `python -m tests.record_kernels` writes the file.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from springbench.harness.console import show_activity
from springbench.harness.execution.isolated_worker import ProgressCallback, TaskLimits
from springbench.harness.execution.progress_display import ThrottledMessages
from springbench.harness.execution.timing_lock import lock_timing_shared
from springbench.harness.execution.worker_pool import PoolTask, run_tasks
from springbench.solvers.platform_calls import can_isolate_processes, list_usable_cores

if TYPE_CHECKING:
    from springbench.solvers.jit.kernel_signatures import KernelSignature

SIGNATURES_PATH = Path(__file__).with_name("kernel_signatures.json")

_MAX_PROCESSES = 4


class _SignatureTable(NamedTuple):
    """Content of SIGNATURES_PATH: all kernels, and the numbers of those that each solver calls.

    Kernels with the most machine code are first.
    """

    kernels: list[KernelSignature]
    numbers: dict[str, list[int]]

    @classmethod
    def from_file(cls) -> _SignatureTable:
        """Read the file."""
        from springbench.solvers.jit.kernel_signatures import KernelSignature  # with Numba

        stored = json.loads(SIGNATURES_PATH.read_text(encoding="utf-8"))
        kernels = [KernelSignature(name, tuple(arguments)) for name, arguments in stored["kernels"]]
        return cls(kernels, stored["solvers"])

    def select_kernels(self, solvers: Iterable[str]) -> list[KernelSignature]:
        """Return the kernels that some of these solvers call."""
        return [self.kernels[k] for k in sorted({k for solver in solvers for k in self.numbers.get(solver, ())})]

    def find_marker(self, solver: str) -> KernelSignature:
        """Return the last of the kernels of a solver that the fewest other solvers call."""
        num_callers = Counter(k for numbers in self.numbers.values() for k in numbers)
        return self.kernels[min(self.numbers[solver], key=lambda k: (num_callers[k], -k))]


def compile_missing_kernels(solvers: Iterable[str], print_message: Callable[[str], None]) -> None:
    """Compile the kernels of solvers that the cache lacks, and wait for it.

    Nothing is done if the cache contains the marker kernel of each solver. A kernel that cannot be compiled raises its
    error when it is called.

    Args:
        solvers: names of solvers.
        print_message: prints a remark.
    """
    num_processes = min(len(list_usable_cores()), _MAX_PROCESSES)
    if num_processes < 2 or not can_isolate_processes():
        return
    from springbench.solvers.jit.kernel_signatures import is_missing

    table = _SignatureTable.from_file()
    known = [solver for solver in solvers if solver in table.numbers]
    if not any(is_missing(table.find_marker(solver)) for solver in known):
        return
    missing = [signature for signature in table.select_kernels(known) if is_missing(signature)]

    def create_task(number: int) -> PoolTask:
        return PoolTask(partial(_compile_kernel, missing[number]), _ignore_progress, TaskLimits())

    print_message(f"compiling {len(missing)} kernels on {num_processes} cores (once)")
    report = ThrottledMessages(print_message, show_activity)
    for count, _ in enumerate(run_tasks(num_processes, int, [None] * len(missing), create_task), 1):
        report(f"compiling kernels (once): {count} of {len(missing)}")


def list_kernels(solver: str) -> list[KernelSignature]:
    """Return the kernels that a solver calls."""
    return _SignatureTable.from_file().select_kernels([solver])


def _ignore_progress(event: object) -> None:
    pass


def _compile_kernel(signature: KernelSignature, tick: ProgressCallback) -> None:
    from springbench.solvers.jit.kernel_signatures import compile_kernel

    with lock_timing_shared(tick):
        compile_kernel(signature)

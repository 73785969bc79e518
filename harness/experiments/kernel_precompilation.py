"""Compile the kernels of runs on all cores, before the first run starts.

A run compiles each kernel at its first call, one after the other on one core. kernel_signatures.json states which
kernels each solver calls, and which the search of `run --error`, so that several processes can compile them, and end
before anything is timed. Kernels that are not in the file are compiled when they are called.
`python -m tests.record_kernels` writes the file.
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
from springbench.harness.execution.progress_events import ignore_progress
from springbench.harness.execution.timing_lock import lock_timing_shared
from springbench.harness.execution.worker_pool import PoolTask, run_tasks
from springbench.solvers.platform_calls import can_isolate_processes, list_usable_cores

if TYPE_CHECKING:
    from springbench.solvers.jit.kernel_signatures import KernelSignature

SIGNATURES_PATH = Path(__file__).with_name("kernel_signatures.json")

ERROR_CONTROL = "--error"
"""Name in the file of what `run --error` calls."""

_MAX_PROCESSES = 4


class _SignatureTable(NamedTuple):
    """Content of SIGNATURES_PATH: all kernels, and the numbers of those that each caller calls.

    Callers are solvers and ERROR_CONTROL. Kernels with the most machine code are first.
    """

    kernels: list[KernelSignature]
    numbers: dict[str, list[int]]

    @classmethod
    def from_file(cls) -> _SignatureTable:
        """Read the file."""
        from springbench.solvers.jit.kernel_signatures import KernelSignature  # with Numba

        stored = json.loads(SIGNATURES_PATH.read_text(encoding="utf-8"))
        kernels = [KernelSignature(name, tuple(arguments)) for name, arguments in stored["kernels"]]
        return cls(kernels, stored["callers"])

    def select_kernels(self, callers: Iterable[str]) -> list[KernelSignature]:
        """Return the kernels that some of these callers call."""
        return [self.kernels[k] for k in sorted({k for caller in callers for k in self.numbers.get(caller, ())})]

    def find_marker(self, caller: str) -> KernelSignature:
        """Return the last of the kernels of a caller that the fewest others call."""
        num_callers = Counter(k for numbers in self.numbers.values() for k in numbers)
        return self.kernels[min(self.numbers[caller], key=lambda k: (num_callers[k], -k))]


def compile_missing_kernels(callers: Iterable[str], print_message: Callable[[str], None]) -> None:
    """Compile the kernels that the cache lacks, and wait for it.

    Nothing is done if the cache contains the marker kernel of each caller. A kernel that cannot be compiled raises its
    error when it is called.

    Args:
        callers: names of solvers, or ERROR_CONTROL.
        print_message: prints a remark.
    """
    num_processes = min(len(list_usable_cores()), _MAX_PROCESSES)
    if num_processes < 2 or not can_isolate_processes():
        return
    from springbench.solvers.jit.kernel_signatures import is_missing

    table = _SignatureTable.from_file()
    known = [caller for caller in callers if caller in table.numbers]
    if not any(is_missing(table.find_marker(caller)) for caller in known):
        return
    missing = [signature for signature in table.select_kernels(known) if is_missing(signature)]

    def create_task(number: int) -> PoolTask:
        return PoolTask(partial(_compile_kernel, missing[number]), ignore_progress, TaskLimits())

    print_message(f"compiling {len(missing)} kernels on {num_processes} cores (once)")
    report = ThrottledMessages(print_message, show_activity)
    for count, _ in enumerate(run_tasks(num_processes, int, [None] * len(missing), create_task), 1):
        report(f"compiling kernels (once): {count} of {len(missing)}")


def list_kernels(caller: str) -> list[KernelSignature]:
    """Return the kernels that a solver, or ERROR_CONTROL, calls."""
    return _SignatureTable.from_file().select_kernels([caller])


def _compile_kernel(signature: KernelSignature, tick: ProgressCallback) -> None:
    from springbench.solvers.jit.kernel_signatures import compile_kernel

    with lock_timing_shared(tick):
        compile_kernel(signature)

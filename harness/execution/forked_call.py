"""Call of a function in a fork of this process, which shares its objects, while this process continues."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from multiprocessing import get_context

from springbench.harness.execution import interrupts
from springbench.harness.execution.isolated_worker import can_fork


@contextmanager
def call_in_fork(function: Callable[[], object]) -> Generator[None]:
    """Call a function that writes files in a fork, during the block.

    Where a fork is unsafe, or has failed, the function is called in this process after the block, with its errors.

    Args:
        function: idempotent function, whose value is not used.
    """
    process = get_context("fork").Process(target=_call_and_exit, args=(function,)) if can_fork() else None
    if process:
        with interrupts.block_interrupts():
            process.start()
    try:
        yield
    finally:
        if process:
            process.join()
    if not process or process.exitcode:
        function()


def _call_and_exit(function: Callable[[], object]) -> None:
    try:
        function()
    except BaseException:  # it is raised by the call in the parent
        os._exit(1)

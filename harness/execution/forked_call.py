"""Call of a function in a fork of this process, while this process continues."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TypeVar

from springbench.harness.execution import interrupts
from springbench.harness.execution.isolated_worker import can_fork

Value = TypeVar("Value")


def start_in_fork(function: Callable[[], Value]) -> Callable[[], Value]:
    """Start a function in a fork, and return what waits for its value.

    Where a fork is unsafe, or has failed, waiting calls the function in this process, with its errors.

    Args:
        function: function that may be called twice, with a picklable value.

    Returns:
        Function that returns the value; it has to be called.
    """
    if not can_fork():
        return function
    context = get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_call_and_send, args=(function, sender))
    with interrupts.block_interrupts():
        process.start()
    sender.close()

    def wait_for_value() -> Value:
        found = list[Value]()
        with receiver, suppress(EOFError):
            found.append(receiver.recv())
        process.join()
        return found[0] if found else function()

    return wait_for_value


def _call_and_send(function: Callable[[], Value], sender: Connection) -> None:
    try:
        sender.send(function())
    except BaseException:  # the call in the parent raises it
        os._exit(1)

"""Numba's simulator, three times as fast: of a block's threads one runs at a time, and where none waits for another all
run in the process's own thread.

As it is, it makes a thread of Python of each and polls all of them whether they are done, looks through all
names of NumPy's arrays for an array's shape, and through all callers for a block's shared memory. What kernels are
given and compute does not change. Threads that ought to wait for each other and do not are found out: who goes first
changes from block to block and from turn to turn, and shared memory begins with no number.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache, partial
from importlib import import_module
from itertools import cycle
from threading import Lock, current_thread
from typing import Any

import numpy as np
import pytest

kernel: Any = import_module("numba.cuda.simulator.kernel")
api: Any = import_module("numba.cuda.simulator.kernelapi")
arrays: Any = import_module("numba.cuda.simulator.cudadrv.devicearray")
cuda: Any = import_module("numba.cuda")
Array, Kernel, usual = arrays.FakeWithinKernelCUDAArray, kernel.FakeCUDAKernel, kernel.FakeCUDAKernel.__call__


forwards: Iterator[bool] = cycle((True, False))
"""Whether a block's first thread begins, of those to come."""


def install_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on."""
    monkeypatch.setattr(sys.modules[__name__], "forwards", cycle((True, False)))
    monkeypatch.setattr(kernel.BlockManager, "run", run)
    monkeypatch.setattr(Kernel, "__call__", call)
    monkeypatch.setattr(Array, "__getattr__", attribute)
    monkeypatch.setattr(Array, "__getitem__", entry)
    monkeypatch.setattr(api.FakeCUDAShared, "array", allocate_shared)


def run(self: Any, grid_point: Any, *arguments: Any) -> None:
    """All threads of a block."""
    points = list(np.ndindex(*self._block_dim))
    if len(points) > 1 and waits(self._f):
        together([Thread(partial(self._f, *arguments), self, grid_point, at, self._debug) for at in points])
        return
    here: Any = current_thread()
    here.blockIdx, here.syncthreads = api.Dim3(*grid_point), fail_unexpected_wait if len(points) > 1 else alone
    for at in points:
        here.threadIdx = api.Dim3(*at)
        self._f(*arguments)


@cache
def waits(function: Any) -> bool:
    """Whether threads wait for each other in it, or in functions that it calls by their own names."""
    names, cells = function.__code__.co_names, function.__closure__ or ()
    called = [function.__globals__.get(name) for name in names] + [cell.cell_contents for cell in cells]
    return "syncthreads" in names or any(waits(one.fn) for one in called if isinstance(one, Kernel))


def alone() -> None:
    """The only thread of its block waits for no other."""


def fail_unexpected_wait() -> None:
    raise AssertionError("threads wait for each other in a function that the kernel calls by no name of its own")


class Thread(kernel.BlockThread):
    """One of several of a block, which runs when it is its turn."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.go, self.paused, self.ended = Lock(), Lock(), False
        for lock in (self.go, self.paused):
            lock.acquire()
        self.start()

    def run(self) -> None:
        self.go.acquire()
        super().run()
        self.ended = True
        self.paused.release()

    def run_until_wait(self) -> None:
        """Up to where it waits for the others, or to its end."""
        self.go.release()
        self.paused.acquire()
        if self.exception:
            raise self.exception[0].with_traceback(self.exception[1])

    def syncthreads(self) -> None:
        self.paused.release()
        self.go.acquire()


def together(threads: list[Thread]) -> None:
    """Each in its turn."""
    threads = threads if next(forwards) else threads[::-1]
    while threads:
        for thread in threads:
            thread.run_until_wait()
        threads = [thread for thread in reversed(threads) if not thread.ended]


def call(self: Any, *arguments: Any) -> Any:
    """A kernel or a function of one; of what it names, `cuda` is the running kernel's, if it is there."""
    if not self._device:
        assert all(type(n) is int and n > 0 for n in _sizes(self)), "a device takes positive integers of Python alone"
    return self.fn(*arguments) if self._device and not names_cuda(self.fn) else usual(self, *arguments)


def _sizes(launched: Any) -> list[Any]:
    """How many blocks and threads a kernel is launched with."""
    given = launched.grid_dim, launched.block_dim
    return [n for one in given for n in (one if isinstance(one, tuple) else (one,))]


@cache
def names_cuda(function: Any) -> bool:
    """Whether a function reads its thread index, or anything else of it."""
    named = map(function.__globals__.get, function.__code__.co_names)
    return any(one is cuda or isinstance(one, api.FakeCUDAModule) for one in named)


def entry(self: Any, at: Any) -> Any:
    """A number, or an array of some."""
    found = self._item._ary[at]
    return Array(arrays.FakeCUDAArray(found)) if isinstance(found, np.ndarray) else found


def attribute(self: Any, name: str) -> Any:
    """Of an array of numbers, such as its shape."""
    return getattr(self._item._ary, name)


def allocate_shared(self: Any, shape: Any, dtype: Any) -> Any:
    """A block's array, identified by the line that allocates it."""
    caller = sys._getframe(1)
    line = caller.f_code.co_filename, caller.f_lineno
    if line not in self._allocations:
        made = self._allocations[line] = api.FakeCUDALocal().array(shape, dtype)
        made.fill(np.nan if made.dtype.kind == "f" else np.iinfo(made.dtype).max)
    return self._allocations[line]

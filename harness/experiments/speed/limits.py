# pyright: reportMissingTypeStubs=false
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# Numba and llvmlite, which generate the code, have no type annotations.
"""Roofline microbenchmarks: bandwidth by working set (after STREAM, McCalpin 1995), and peak flops.

    read     s += a_i                    8 bytes per entry
    triad    a_i = b_i + 3 c_i           24 bytes per entry, as STREAM counts them
    fma      a = a x + y in registers    2 flops per lane

The same kernels run with one thread and with several; each thread has its own part of a working set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from solvers.compiling import kept

WORKING_SETS = tuple(int(2.0**k) for k in np.arange(14, 29.5, 0.5))
"""Bytes of all threads together: from 16 KiB, in the first-level cache, to 512 MiB, in memory."""

_CALL_BYTES = 1 << 27
_CHAINS, _VECTOR_BYTES = 12, 64
_REPEATS = 1 << 18
_FAST = {"contract", "reassoc", "nsz"}


@dataclass(frozen=True, slots=True)
class Probe:
    """Kernel that is ready to be timed.

    Attributes:
        name: name of the kernel.
        working_set: size of the data that it traverses repeatedly [B].
        bytes: bytes that one call moves [B].
        flops: operations that one call computes.
        call: runs the kernel.
    """

    name: str
    working_set: int
    bytes: int
    flops: int
    call: Callable[[], Any]


def probes(sets: tuple[int, ...] = WORKING_SETS) -> Iterator[Probe]:
    """Build all kernels for Numba's current number of threads."""
    threads = numba.get_num_threads()
    room = np.ones(max(sets) // 8)
    for size in sets:
        a = room[: size // 8]
        # Short sets are traversed many times in a call; otherwise the start of the threads would dominate.
        repeats = max(1, _CALL_BYTES // size)
        yield Probe("read", size, 8 * len(a) * repeats, len(a) * repeats, lambda a=a, r=repeats: _read(a, threads, r))
        b, c, d = np.split(a[: len(a) // 3 * 3], 3)
        moved, flops = 24 * len(b) * repeats, 2 * len(b) * repeats
        yield Probe("triad", size, moved, flops, lambda b=b, c=c, d=d, r=repeats: _triad(b, c, d, threads, r))
    for name, kind in (("fma float64", np.float64), ("fma float32", np.float32)):
        start = np.ones(1, kind)
        lanes = _VECTOR_BYTES // start.itemsize
        flops = 2 * _CHAINS * lanes * _REPEATS * threads
        yield Probe(name, 0, 0, flops, lambda start=start: _fused(start, threads))


@kept(parallel=True, fastmath=_FAST)
def _read(a: NDArray[Any], threads: int, repeats: int) -> float:
    total = 0.0
    for t in prange(threads):
        first, last = len(a) * t // threads, len(a) * (t + 1) // threads
        total += _sum(a[first:last], repeats)
    return total


@kept(fastmath=_FAST)
def _sum(a: NDArray[Any], repeats: int) -> float:
    total = 0.0
    for k in range(repeats):
        part = 0.0
        for i in range(len(a)):
            part += a[i]
        a[k % len(a)] = 1.0  # or the compiler would go through the array once
        total += part
    return total


@kept(parallel=True, fastmath=_FAST)
def _triad(a: NDArray[Any], b: NDArray[Any], c: NDArray[Any], threads: int, repeats: int) -> None:
    for t in prange(threads):
        first, last = len(a) * t // threads, len(a) * (t + 1) // threads
        for _ in range(repeats):
            _add_scaled(a[first:last], b[first:last], c[first:last])


@kept(fastmath=_FAST)
def _add_scaled(a: NDArray[Any], b: NDArray[Any], c: NDArray[Any]) -> None:
    for i in range(len(a)):
        a[i] = b[i] + 3.0 * c[i]


@kept(parallel=True)
def _fused(start: NDArray[Any], threads: int) -> float:
    total = 0.0
    for _ in prange(threads):
        total += _chains(start, _REPEATS)
    return total


def _multiply_adds(typingctx: Any, start: Any, repeats: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum some vectors after `repeats` multiply-adds of each with start[0] and itself, all in registers."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, count = signature.args[0], args[1]
        element = context.get_value_type(array.dtype)
        lanes = _VECTOR_BYTES * 8 // array.dtype.bitwidth
        vector = ir.VectorType(element, lanes)
        x = builder.load(context.make_array(array)(context, builder, args[0]).data)
        spread = ir.Constant(vector, [0.0] * lanes)
        for lane in range(lanes):
            spread = builder.insert_element(spread, x, ir.Constant(ir.IntType(32), lane))
        chains = [cgutils.alloca_once(builder, vector) for _ in range(_CHAINS)]
        for k, chain in enumerate(chains):
            builder.store(ir.Constant(vector, [float(k)] * lanes), chain)
        with cgutils.for_range(builder, count):
            for chain in chains:
                product = builder.fmul(builder.load(chain), spread, flags=("contract",))
                builder.store(builder.fadd(product, spread, flags=("contract",)), chain)
        total = ir.Constant(element, 0.0)
        for chain in chains:
            total = builder.fadd(total, builder.extract_element(builder.load(chain), ir.Constant(ir.IntType(32), 0)))
        return total

    return start.dtype(start, types.intp), generate


_chains: Any = intrinsic(_multiply_adds)  # Numba passes the first argument itself, which type checkers do not know

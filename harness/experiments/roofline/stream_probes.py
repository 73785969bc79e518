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
from springbench.solvers.jit.kernel_compilation import cached_njit

WORKING_SETS = tuple(int(2.0**k) for k in np.arange(14, 29.5, 0.5))
"""Bytes of all threads together: from 16 KiB, in the first-level cache, to 512 MiB, in memory."""

_BYTES_PER_CALL = 1 << 27
_NUM_CHAINS, _VECTOR_BYTES = 12, 64
_NUM_REPEATS = 1 << 18
_FAST_MATH_FLAGS = {"contract", "reassoc", "nsz"}


@dataclass(frozen=True, slots=True)
class RooflineProbe:
    """Kernel that is ready to be timed.

    Attributes:
        name: name of the kernel.
        working_set_bytes: size of the data that it traverses repeatedly [B].
        bytes_moved: bytes that one call moves [B].
        flops: operations that one call computes.
        call: runs the kernel.
    """

    name: str
    working_set_bytes: int
    bytes_moved: int
    flops: int
    call: Callable[[], Any]


def build_probes(working_sets: tuple[int, ...] = WORKING_SETS) -> Iterator[RooflineProbe]:
    """Build all kernels for Numba's current number of threads."""
    threads = numba.get_num_threads()
    room = np.ones(max(working_sets) // 8)
    for size in working_sets:
        a = room[: size // 8]
        # Short sets are traversed many times in a call; otherwise the start of the threads would dominate.
        repeats = max(1, _BYTES_PER_CALL // size)
        yield RooflineProbe(
            "read", size, 8 * len(a) * repeats, len(a) * repeats, lambda a=a, r=repeats: _read_sum(a, threads, r)
        )
        b, c, d = np.split(a[: len(a) // 3 * 3], 3)
        moved, flops = 24 * len(b) * repeats, 2 * len(b) * repeats
        yield RooflineProbe("triad", size, moved, flops, lambda b=b, c=c, d=d, r=repeats: _triad(b, c, d, threads, r))
    for name, kind in (("fma float64", np.float64), ("fma float32", np.float32)):
        start = np.ones(1, kind)
        lanes = _VECTOR_BYTES // start.itemsize
        flops = 2 * _NUM_CHAINS * lanes * _NUM_REPEATS * threads
        yield RooflineProbe(name, 0, 0, flops, lambda start=start: _run_multiply_adds(start, threads))


@cached_njit(parallel=True, fastmath=_FAST_MATH_FLAGS)
def _read_sum(a: NDArray[Any], threads: int, repeats: int) -> float:
    total = 0.0
    for t in prange(threads):
        first, last = len(a) * t // threads, len(a) * (t + 1) // threads
        total += _sum_repeatedly(a[first:last], repeats)
    return total


@cached_njit(fastmath=_FAST_MATH_FLAGS)
def _sum_repeatedly(a: NDArray[Any], repeats: int) -> float:
    total = 0.0
    for k in range(repeats):
        part = 0.0
        for i in range(len(a)):
            part += a[i]
        a[k % len(a)] = 1.0  # prevents the compiler from merging the passes
        total += part
    return total


@cached_njit(parallel=True, fastmath=_FAST_MATH_FLAGS)
def _triad(a: NDArray[Any], b: NDArray[Any], c: NDArray[Any], threads: int, repeats: int) -> None:
    for t in prange(threads):
        first, last = len(a) * t // threads, len(a) * (t + 1) // threads
        for _ in range(repeats):
            _add_scaled(a[first:last], b[first:last], c[first:last])


@cached_njit(fastmath=_FAST_MATH_FLAGS)
def _add_scaled(a: NDArray[Any], b: NDArray[Any], c: NDArray[Any]) -> None:
    for i in range(len(a)):
        a[i] = b[i] + 3.0 * c[i]


@cached_njit(parallel=True)
def _run_multiply_adds(start: NDArray[Any], threads: int) -> float:
    total = 0.0
    for _ in prange(threads):
        total += _multiply_add_chains(start, _NUM_REPEATS)
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
        chains = [cgutils.alloca_once(builder, vector) for _ in range(_NUM_CHAINS)]
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


_multiply_add_chains: Any = intrinsic(
    _multiply_adds
)  # Numba passes the first argument itself, which no type checker sees

"""Parallel sums in an order that depends only on the number of terms: they are bitwise reproducible.

Threads loop over the terms with a stride, the threads of a block are summed by a tree, and one block sums the blocks by
the same tree. The two stages are two kernels, so no block waits for another and atomics are unnecessary.

`keep` and `of_all` are inlined. Numba compiles a function once for each literal argument, including
its callees, so the shared array of `of_block` would be defined twice, which libNVVM rejects.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from solvers.cuda.device import simulated
from solvers.cuda.target import cuda

THREADS, MOST_BLOCKS = (1, 2) if simulated() else (256, 1024)
"""Threads per block. The simulator starts a Python thread for each, which is slower than its work. Its device functions
from other files than the kernel's also require a block of one thread."""


def blocks(n: int) -> int:
    """Return the number of blocks of a launch for n terms, over which threads loop with a stride."""
    return max(1, min(MOST_BLOCKS, -(-n // THREADS)))


@cuda.jit(device=True)
def of_block(value):
    """Return the sum of a float64 over the threads of the block, to all of them."""
    shared = cuda.shared.array(THREADS, np.float64)
    thread = cuda.threadIdx.x
    cuda.syncthreads()
    shared[thread] = value
    cuda.syncthreads()
    half = THREADS // 2
    while half > 0:
        if thread < half:
            shared[thread] += shared[thread + half]
        cuda.syncthreads()
        half //= 2
    return shared[0]


@cuda.jit(device=True, inline="always")
def keep(value, which, partials):
    """First stage: store the sum of the block in a row of partials (k, MOST_BLOCKS)."""
    total = of_block(value)
    if cuda.threadIdx.x == 0:
        partials[which, cuda.blockIdx.x] = total


@cuda.jit(device=True, inline="always")
def of_all(which, partials, count):
    """Second stage: return the sum of a row's first `count` partials to all threads.

    It runs in a kernel of one block.
    """
    mine, k = 0.0, cuda.threadIdx.x
    while k < count:
        mine += partials[which, k]
        k += THREADS
    return of_block(mine)


@cuda.jit
def collect(rows, partials, count, out):
    """Second stage of the first `rows` sums; one block."""
    for k in range(rows):
        total = of_all(k, partials, count)
        if cuda.threadIdx.x == 0:
            out[k] = total


def partials(rows: int) -> Any:
    """Allocate memory for `rows` simultaneous sums."""
    return cuda.device_array((rows, MOST_BLOCKS), np.float64)

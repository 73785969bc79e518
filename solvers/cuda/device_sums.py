"""Bitwise reproducible parallel sums, in an order that depends only on the number of terms.

Threads loop over the terms with a stride, the threads of a block are summed by a tree, and one block sums the blocks by
the same tree. The two stages are two kernels, so no block waits for another and atomics are unnecessary.

`store_partial_sum` and `sum_partials` are inlined. Numba compiles a function once for each literal argument, including
its callees, so the shared array of `sum_block` would be defined twice, which libNVVM rejects.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from springbench.solvers.cuda.cuda_device import is_simulated
from springbench.solvers.cuda.cuda_target import cuda

THREADS_PER_BLOCK, MAX_BLOCKS = (1, 2) if is_simulated() else (256, 1024)
"""Threads per block, and maximum number of blocks.

The simulator starts a Python thread for each thread, which is slower than its work. Its device functions from other
files than the kernel's also require a block of one thread."""


def count_blocks(n: int) -> int:
    """Return the number of blocks of a launch for n terms.

    Threads loop over the terms with a stride.
    """
    return int(max(1, min(MAX_BLOCKS, -(-n // THREADS_PER_BLOCK))))


@cuda.jit(device=True)
def sum_block(value):
    """Return the sum of a float64 over the threads of the block.

    All threads of the block return the sum.
    """
    shared = cuda.shared.array(THREADS_PER_BLOCK, np.float64)
    thread = cuda.threadIdx.x
    cuda.syncthreads()
    shared[thread] = value
    cuda.syncthreads()
    half = THREADS_PER_BLOCK // 2
    while half > 0:
        if thread < half:
            shared[thread] += shared[thread + half]
        cuda.syncthreads()
        half //= 2
    return shared[0]


@cuda.jit(device=True, inline="always")
def store_partial_sum(value, sum_slot, partials):
    """Do the first stage of a sum: store the sum of the block.

    Args:
        value: sum of this thread's terms.
        sum_slot: row of the partial sums.
        partials: output, partial sums (k, MAX_BLOCKS), one column for each block.
    """
    total = sum_block(value)
    if cuda.threadIdx.x == 0:
        partials[sum_slot, cuda.blockIdx.x] = total


@cuda.jit(device=True, inline="always")
def sum_partials(sum_slot, partials, count):
    """Do the second stage of a sum, in a kernel of one block.

    Args:
        sum_slot: row of the partial sums.
        partials: partial sums (k, MAX_BLOCKS).
        count: number of partial sums, the blocks of the first stage.

    Returns:
        The sum, to all threads.
    """
    mine, k = 0.0, cuda.threadIdx.x
    while k < count:
        mine += partials[sum_slot, k]
        k += THREADS_PER_BLOCK
    return sum_block(mine)


@cuda.jit
def collect_sums(rows, partials, count, out):
    """Do the second stage of several sums; launched with one block.

    Args:
        rows: number of sums, in the first rows of the partial sums.
        partials: partial sums (k, MAX_BLOCKS).
        count: number of partial sums of each, the blocks of the first stage.
        out: output, the sums, with at least `rows` numbers.
    """
    for k in range(rows):
        total = sum_partials(k, partials, count)
        if cuda.threadIdx.x == 0:
            out[k] = total


def allocate_partials(rows: int) -> Any:
    """Allocate memory for `rows` simultaneous sums."""
    return cuda.device_array((rows, MAX_BLOCKS), np.float64)

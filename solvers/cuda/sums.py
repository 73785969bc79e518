"""Sums over all threads, in an order that depends on nothing but the number of terms: they repeat bit by bit.

Threads go through the terms in strides and add up what they find, a block's threads add theirs by a tree, and one block
adds the blocks' sums by the same tree. The two stages are two kernels, so that no block waits for another and nothing
is added by atomics.

`keep` and `of_all` are inlined: Numba compiles a function anew for each literal that it is given, and takes in with
each what that one calls, so that `of_block`'s shared array would be there twice, which libNVVM refuses.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from solvers.cuda.device import simulated
from solvers.cuda.target import cuda

THREADS, MOST_BLOCKS = (1, 2) if simulated() else (256, 1024)
"""Of a launch. The simulator makes a thread of Python of each, which takes longer than what it does there; and device
functions of another file than the kernel's know their thread there where it is the only one of its block."""


def blocks(n: int) -> int:
    """Of a launch for n terms, which the threads go through in strides."""
    return max(1, min(MOST_BLOCKS, -(-n // THREADS)))


@cuda.jit(device=True)
def of_block(value):
    """The sum of a float64 over the block's threads, told to all of them."""
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
    """The first stage: the block's sum, kept in a row of partials (k, MOST_BLOCKS)."""
    total = of_block(value)
    if cuda.threadIdx.x == 0:
        partials[which, cuda.blockIdx.x] = total


@cuda.jit(device=True, inline="always")
def of_all(which, partials, count):
    """The second stage, in a kernel of one block: the sum of a row's first `count` partials, told to all threads."""
    mine, k = 0.0, cuda.threadIdx.x
    while k < count:
        mine += partials[which, k]
        k += THREADS
    return of_block(mine)


@cuda.jit
def collect(rows, partials, count, out):
    """The second stage of the first `rows` sums; one block."""
    for k in range(rows):
        total = of_all(k, partials, count)
        if cuda.threadIdx.x == 0:
            out[k] = total


def partials(rows: int) -> Any:
    """Memory for so many sums at a time."""
    return cuda.device_array((rows, MOST_BLOCKS), np.float64)

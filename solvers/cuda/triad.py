"""The triad of STREAM (McCalpin 1995) on a device, a = b + s c: by it, what bandwidth of its own a device reaches.

It must read two arrays and write one: 24 bytes an element in float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from solvers.cuda.target import cuda

_SHARE = 0.5
"""Of the memory that is left, what its arrays may take."""


def once(n: int) -> tuple[float, Any, Any] | None:
    """Bytes that a triad of n elements moved, and events around it that have been waited for; None without room."""
    left, _ = cuda.current_context().get_memory_info()
    if 24.0 * n > _SHARE * left:
        return None
    b, c, a = (cuda.device_array(n, np.float64) for _ in range(3))
    run(a, b, c)
    began, ended = cuda.event(), cuda.event()
    began.record()
    run(a, b, c)
    ended.record()
    ended.synchronize()
    return 24.0 * n, began, ended


def run(a: Any, b: Any, c: Any) -> None:
    """Launch it."""
    add[max(1, -(-len(a) // 256)), 256](a, b, c, 3.0)


@cuda.jit
def add(a, b, c, s):
    """a = b + s c, an element a thread."""
    i = cuda.grid(1)
    if i < a.shape[0]:
        a[i] = b[i] + s * c[i]

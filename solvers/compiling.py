"""How kernels are compiled: kept on disk, and without counting references to arrays.

Kernels neither make arrays nor keep them, so there is nothing to count; counting took half of a step of a hundred
vertices. They let Python's other threads run meanwhile. Inner ones are called by kernels alone and need no wrappers
for Python, which take longest to compile.
"""

from __future__ import annotations

from typing import Any

from numba import njit

_kept: Any = {"cache": True, "_nrt": False, "nogil": True}
inner_options: Any = {**_kept, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

kernel: Any = njit(**_kept)
inner: Any = njit(**inner_options)
inner_in_parallel: Any = njit(**inner_options, parallel=True)

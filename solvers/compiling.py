"""Numba options of the kernels: compiled code is cached on disk, and arrays are not reference-counted.

Kernels neither create nor store arrays, so there is nothing to count. Counting took half of a step of a hundred
vertices. Kernels release the GIL. Inner functions are called by kernels only: they need no Python wrapper and no
machine code of their own (`solvers.linking`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit  # noqa: TID251

from solvers.caching import KernelCache
from solvers.linking import LinkedCompiler


def kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator like Numba's `njit` whose disk cache depends on all that the function depends on."""

    def compiling(function: Callable[..., Any]) -> Any:
        dispatcher: Any = njit(**options)(function)
        dispatcher._cache = KernelCache(function, options)
        return dispatcher

    return compiling


_bare: Any = {"_nrt": False, "nogil": True}
_alone: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_linked: Any = {**_alone, "pipeline_class": LinkedCompiler}
inner_options: Any = {**_bare, **_linked}

kernel: Any = kept(**_bare, no_cfunc_wrapper=True)
inner: Any = kept(**inner_options)
part: Any = kept(**_linked)  # an inner one that makes arrays
inner_closure: Any = njit(**inner_options)  # has no name on disk; kept within what calls it
inlined_closure: Any = njit(**inner_options, forceinline=True)  # for what takes more arrays than it has work
inner_in_parallel: Any = kept(**_bare, **_alone, parallel=True)

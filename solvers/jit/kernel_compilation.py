"""Numba options of the kernels: a disk cache, and arrays without reference counting.

Compiled code is cached on disk. Kernels neither create nor store arrays, so that there are no references to count:
counting took half of a step of a hundred vertices. Kernels release the GIL. Inner functions are called by kernels only:
they need no Python wrapper and no machine code of their own (`springbench.solvers.jit.inline_linking`). Neither does a
kernel where another one calls it.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from numba import njit, types  # noqa: TID251
from numba.core.registry import CPUDispatcher
from numba.core.targetconfig import TargetConfig
from numba.core.typing.templates import signature
from springbench.solvers.jit.inline_linking import KernelCompiler, LinkedCompiler, ParallelCompiler
from springbench.solvers.jit.kernel_cache import KernelCache

ZERO, ONE = np.int64(0), np.int64(1)
"""0 and 1 as int64 arguments of kernels, which would be compiled once more for literals."""

_no_wrapper_options: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_linked_options: Any = {**_no_wrapper_options, "pipeline_class": LinkedCompiler}

_FLAGS_CLASS: Any = TargetConfig
_DISPATCHER_CLASS: Any = CPUDispatcher
"""Untyped, because the declared signatures differ from those of its subclasses."""


@cache
def _default_flags(flags_class: Any) -> dict[str, Any]:
    return {name: option.default for name, option in flags_class.options.items()}


def _read_flags(flags: Any) -> dict[str, Any]:
    """Return the values of all flags of a compilation, as the Numba method it replaces.

    Numba's method reads the flags one by one. Type inference compares them for each call in a kernel, which takes a
    quarter of the time of a compilation.
    """
    return {**_default_flags(type(flags)), **flags._values}


_FLAGS_CLASS.values = _read_flags


class KernelDispatcher(_DISPATCHER_CLASS):
    """The kernel that Python calls. Other kernels call `inner_kernel`, which is only linked into them."""

    inner_kernel: Any

    @property
    def _numba_type_(self) -> types.Dispatcher:
        """The type of the kernel where another kernel refers to it."""
        return types.Dispatcher(self.inner_kernel)


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator like Numba's `njit`, with a disk cache that considers all dependencies."""

    def compile_function(function: Callable[..., Any]) -> Any:
        if "pipeline_class" in options:
            return _cache_kernel(function, options)
        if options.get("parallel"):
            return _cache_kernel(function, {**options, "pipeline_class": ParallelCompiler})
        kernel = _cache_kernel(function, {**options, "no_cfunc_wrapper": True, "pipeline_class": KernelCompiler})
        kernel.__class__ = KernelDispatcher
        kernel.inner_kernel = _cache_kernel(function, {**options, **_linked_options})
        return kernel

    return compile_function


def _cache_kernel(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Return Numba's dispatcher of a function, with the cache of this package."""
    dispatcher: Any = njit(**options)(function)
    dispatcher._cache = kernel_cache = KernelCache(function, options)
    compile_code = dispatcher._compiler.compile

    def compile_once(args: Any, return_type: Any) -> Any:
        sig = args if return_type is None else signature(return_type, *args)
        with _pause_garbage_collection():
            return kernel_cache.compile_once(sig, dispatcher.targetctx, lambda: compile_code(args, return_type))

    dispatcher._compiler.compile = compile_once
    return dispatcher


@contextmanager
def _pause_garbage_collection() -> Generator[None]:
    """Collect no garbage inside the block.

    A compilation creates millions of objects that live until its end.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


_bare_options: Any = {"_nrt": False, "nogil": True}
jit_inner_options: Any = {**_bare_options, **_linked_options}

jit_kernel: Any = cached_njit(**_bare_options)
jit_inner: Any = cached_njit(**jit_inner_options)
jit_inner_allocating: Any = cached_njit(**_linked_options)  # inner functions that allocate arrays
jit_closure: Any = njit(**jit_inner_options)  # not cached by itself, but within its caller
# For functions that take many arrays and do little work.
jit_inlined_closure: Any = njit(**jit_inner_options, forceinline=True)
jit_inner_parallel: Any = cached_njit(
    **_bare_options, **_no_wrapper_options, parallel=True, pipeline_class=ParallelCompiler
)

"""Kernels and their argument types as plain data, so that another process can compile them.

A type is the name of one in `numba.types`, or a sequence:

    ["array", dtype, dimensions, layout, is_mutable, is_aligned]
    ["record", *names and formats of the fields]
    ["tuple", *types of the parts]
    ["module:NamedTuple", *types of the fields]
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numba import from_dtype, types
from numba.np.numpy_support import as_dtype
from springbench.solvers.jit.kernel_cache import KernelCache

_TYPES: Any = types
"""Untyped, as Numba is."""


class KernelSignature(NamedTuple):
    """A kernel and the types of its arguments.

    Attributes:
        kernel: `module:name` of the kernel.
        arguments: type of each argument, as plain data.
    """

    kernel: str
    arguments: tuple[Any, ...]


def describe_type(kind: Any) -> Any:
    """Return a Numba type as plain data.

    Raises:
        ValueError: the type has no such form.
    """
    if isinstance(kind, _TYPES.Array):
        return "array", describe_type(kind.dtype), kind.ndim, kind.layout, kind.mutable, kind.aligned
    if isinstance(kind, _TYPES.Record):
        return "record", *as_dtype(kind).descr
    if isinstance(kind, _TYPES.BaseTuple):
        made: type = getattr(kind, "instance_class", tuple)
        name = "tuple" if made is tuple else f"{made.__module__}:{made.__qualname__}"
        return name, *map(describe_type, kind)
    if getattr(_TYPES, kind.name, None) != kind:
        raise ValueError(f"{kind}: expected a number, an array, a record, or a tuple of these")
    return kind.name


def build_type(described: Any) -> Any:
    """Return the Numba type of a description by `describe_type`."""
    if isinstance(described, str):
        return getattr(_TYPES, described)
    name, *parts = described
    if name == "array":
        dtype, ndim, layout, is_mutable, is_aligned = parts
        return _TYPES.Array(build_type(dtype), ndim, layout, readonly=not is_mutable, aligned=is_aligned)
    if name == "record":
        return from_dtype(np.dtype([(field, kind) for field, kind in parts]))
    return _TYPES.BaseTuple.from_types([build_type(part) for part in parts], None if name == "tuple" else _load(name))


def _load(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)


def measure_called_kernels() -> dict[KernelSignature, int]:
    """Return the size of the cached code [bytes] of each kernel that Python code has called.

    Only calls in this process count.
    """
    return {
        KernelSignature(name, described): kernel._cache.measure_code(arguments, kernel.targetctx)
        for name, kernel in _find_kernels()
        for arguments in kernel.overloads
        if (described := _describe_arguments(arguments)) is not None
    }


def _find_kernels() -> Iterator[tuple[str, Any]]:
    """Yield name and dispatcher of each kernel that Python can call, in the imported modules."""
    for module in [module for name, module in sys.modules.items() if name.startswith("springbench.")]:
        for name, value in vars(module).items():
            is_kernel = isinstance(getattr(value, "_cache", None), KernelCache)
            if is_kernel and value.__module__ == module.__name__ and "no_cpython_wrapper" not in value.targetoptions:
                yield f"{module.__name__}:{name}", value


def _describe_arguments(arguments: tuple[Any, ...]) -> tuple[Any, ...] | None:
    try:
        return tuple(map(describe_type, arguments))
    except ValueError:
        return None


def is_missing(signature: KernelSignature) -> bool:
    """Return whether a kernel's code can be cached, but is not in the cache."""
    try:
        kernel, arguments = _load(signature.kernel), tuple(map(build_type, signature.arguments))
    except (ImportError, AttributeError):  # of another version of the sources
        return False
    return kernel._cache.is_writable and not kernel._cache.measure_code(arguments, kernel.targetctx)


def compile_kernel(signature: KernelSignature) -> None:
    """Compile a kernel unless its code is in the cache."""
    _load(signature.kernel).compile(tuple(map(build_type, signature.arguments)))

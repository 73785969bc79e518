"""Savings of compile time: work of Numba that does not change the compiled code.

A compilation creates millions of objects that live until its end, and the garbage collector searches them again and
again. Numba optimises each declared function, although it has no body. It also compares the options of kernels by
reading each option through a property.
"""

from __future__ import annotations

import gc
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from typing import Any

from numba.core.codegen import CPUCodeLibrary
from numba.core.targetconfig import TargetConfig

_LIBRARY_CLASS: Any = CPUCodeLibrary
_OPTIONS_CLASS: Any = TargetConfig
"""Untyped, because their methods are replaced."""


@contextmanager
def pause_garbage_collection() -> Generator[None]:
    """Collect no garbage inside the block."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def reduce_compiler_work() -> None:
    """Replace the methods of Numba that repeat work by ones with the same results."""
    _LIBRARY_CLASS._optimize_functions = _optimise_definitions
    _OPTIONS_CLASS.values = _option_values
    _OPTIONS_CLASS.__hash__ = _options_hash


def _optimise_definitions(self: Any, ll_module: Any) -> None:
    """Run the function passes on the functions that have a body."""
    ll_module.data_layout = self._codegen._data_layout
    for function in ll_module.functions:
        if not function.is_declaration:
            passes, builder = self._codegen._function_pass_manager()
            with self._recorded_timings.record(f"Function passes on {function.name!r}", builder):
                passes.run(function, builder)


def _option_values(self: Any) -> dict[str, Any]:
    """Return the values of all options by name."""
    return {**_option_defaults(type(self)), **self._values}


@cache
def _option_defaults(kind: Any) -> dict[str, Any]:
    return {name: option.default for name, option in kind.options.items()}


def _options_hash(self: Any) -> int:
    """Return a hash of the options' names, as Numba does: options that are equal have equal names."""
    return hash(type(self))

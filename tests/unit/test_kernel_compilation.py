"""What makes compilation faster changes nothing of what is compiled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Flags
from springbench.solvers.jit import kernel_cache
from springbench.solvers.jit.inline_linking import LinkedLibrary
from springbench.solvers.jit.kernel_compilation import cached_njit


@pytest.mark.parametrize("chosen", [{}, {"nrt": True}, {"error_model": "numpy", "no_cfunc_wrapper": False}], ids=str)
def test_flags_have_the_values_that_numba_reads_one_by_one(chosen: dict[str, Any]):
    flags: Any = Flags()
    for name, value in chosen.items():
        setattr(flags, name, value)
    assert list(flags.values().items()) == [(name, getattr(flags, name)) for name in flags.options]
    assert (flags == Flags()) == all(value == getattr(Flags(), name) for name, value in chosen.items())


def sum_ones(n: int) -> float:
    return np.ones(n).sum()


def test_code_that_is_only_linked_has_no_wrappers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked, added = list[str](), list[str]()
    add_linked, add_any = LinkedLibrary.add_ir_module, JITCodeLibrary.add_ir_module

    def note_linked(library: Any, module: Any) -> None:
        asked.append(module.name)
        add_linked(library, module)

    def note_any(library: Any, module: Any) -> None:
        added.extend([module.name] if isinstance(library, LinkedLibrary) else [])
        add_any(library, module)

    monkeypatch.setattr(LinkedLibrary, "add_ir_module", note_linked)
    monkeypatch.setattr(JITCodeLibrary, "add_ir_module", note_any)
    monkeypatch.setattr(kernel_cache, "_writable_root", lambda source: tmp_path)
    assert cached_njit()(sum_ones)(3) == 3.0
    assert "cfunc_wrapper" in asked
    assert added
    assert "cfunc_wrapper" not in added

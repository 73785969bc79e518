"""Kernels that are closures: of one name, and distinguished by the functions that they are made of."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from springbench.solvers.jit import kernel_cache

CLOSURES = """
from springbench.solvers.jit.kernel_compilation import jit_closure, jit_inner, jit_kernel
@jit_inner
def double(x):
    return 2.0 * x
@jit_inner
def triple(x):
    return 3.0 * x
def made(part):
    @jit_closure
    def middle(x):
        return part(x)
    @jit_closure
    def outer(x):
        return middle(x)
    @jit_kernel
    def closed(x):
        return outer(x)
    return closed
"""


def test_closures_of_other_functions_however_deep_are_other_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "closures_of_test.py").write_text(CLOSURES)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(kernel_cache.config, "CACHE_DIR", str(tmp_path / "kept"))
    module = importlib.import_module("closures_of_test")
    assert [module.made(part)(1.0) for part in (module.double, module.triple, module.double)] == [2.0, 3.0, 2.0]

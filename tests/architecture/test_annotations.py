"""Every parameter has a type, except those of functions that Numba compiles and of functions that generate code."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

KERNELS = {
    "cached_njit",
    "jit_kernel",
    "jit_inner",
    "jit_inner_allocating",
    "jit_inner_numpy",
    "jit_inner_parallel",
    "jit_closure",
    "jit_inlined_closure",
    "register_jitable",
    "cuda.jit",
}
"""Decorators of compiled functions: this project's, and Numba's for functions that are compiled into their callers and
for those of a device."""
GENERATES = {"typingctx", "context"}
"""First parameters of an intrinsic and of the function that generates its code."""


def unannotated(tree: ast.AST) -> Iterator[str]:
    """Parameters without a type, as `function: parameter`; functions inside a kernel are part of it."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from unannotated(node)
        elif not is_compiled(node):
            given = node.args
            named = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
            free = (a.arg for a in named if a and a.annotation is None)
            yield from (f"{node.name}: {name}" for name in free if name not in ("self", "cls"))
            yield from unannotated(node)


def has_kernel_decorator(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    decorators = (d.func if isinstance(d, ast.Call) else d for d in function.decorator_list)
    return any(ast.unparse(d) in KERNELS for d in decorators)


def is_compiled(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    first = next((a.arg for a in function.args.args), "")
    return first in GENERATES or has_kernel_decorator(function)


@pytest.mark.parametrize("folder", ["harness", "solvers"])
def test_every_parameter_outside_kernels_has_a_type(folder: str):
    found = {
        f"{path.relative_to(ROOT)}: {words}"
        for path in (ROOT / folder).rglob("*.py")
        for words in unannotated(ast.parse(path.read_text()))
    }
    assert not found


def test_a_missing_type_is_found_and_kernels_are_exempt():
    code = """
class A:
    def method(self, a, *rest: int, **more): ...
@cached_njit(parallel=True)
def kernel(p, q): ...
def intrinsic(typingctx, x):
    def generate(context, builder, signature, args):
        def read(entry): ...
@wraps(kernel)
def outer(b: int):
    async def inner(c): ...
"""
    assert list(unannotated(ast.parse(code))) == ["method: a", "method: more", "inner: c"]

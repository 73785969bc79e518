"""Every parameter says its type, but for what Numba compiles: kernels, and the functions that generate their code."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

KERNELS = {
    "kept",
    "kernel",
    "inner",
    "inner_closure",
    "inlined_closure",
    "inner_in_parallel",
    "part",
    "register_jitable",
    "cuda.jit",
}
"""What a compiled function is decorated with: ours, Numba's for what is compiled within its caller, and its own for a
device."""
GENERATES = {"typingctx", "context"}
"""The first parameter of an intrinsic, and of the function that generates its code; Numba gives both."""


def unannotated(tree: ast.AST) -> Iterator[str]:
    """The parameters without a type, as `function: parameter`; what is defined within a kernel is part of it."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from unannotated(node)
        elif not compiled(node):
            given = node.args
            named = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
            free = (a.arg for a in named if a and a.annotation is None)
            yield from (f"{node.name}: {name}" for name in free if name not in ("self", "cls"))
            yield from unannotated(node)


def compiled(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    decorators = (d.func if isinstance(d, ast.Call) else d for d in function.decorator_list)
    first = next((a.arg for a in function.args.args), "")
    return first in GENERATES or any(ast.unparse(d) in KERNELS for d in decorators)


@pytest.mark.parametrize("folder", ["harness", "solvers"])
def test_every_parameter_outside_kernels_says_its_type(folder: str):
    found = {
        f"{path.relative_to(ROOT)}: {words}"
        for path in (ROOT / folder).rglob("*.py")
        for words in unannotated(ast.parse(path.read_text()))
    }
    assert not found


def test_a_missing_type_is_found_and_a_kernel_is_left_alone():
    code = """
class A:
    def method(self, a, *rest: int, **more): ...
@kept(parallel=True)
def kernel(p, q): ...
def intrinsic(typingctx, x):
    def generate(context, builder, signature, args):
        def read(entry): ...
@wraps(kernel)
def outer(b: int):
    async def inner(c): ...
"""
    assert list(unannotated(ast.parse(code))) == ["method: a", "method: more", "inner: c"]

"""A function has at most eight parameters: those that belong together are fields of a named tuple or a dataclass."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest
from springbench.harness.cli.main import app

from tests.architecture.test_annotations import has_kernel_decorator
from tests.architecture.test_docstrings import list_parameters
from tests.architecture.test_vocabulary import ROOT, parse_sources

MAX_PARAMETERS = 8

EXCEPTIONS = {
    "harness/scenes/mesh/mesh_topology.py:assemble_mesh": (
        "users call it by keyword; the keywords are those of `Mesh`, and all but two have defaults"
    ),
    "harness/experiments/regression/pytest_plugin.py:compare_solvers": (
        "users call it by keyword, in tests; the keywords are keys of a gate in gates.yaml"
    ),
}
"""Functions with more parameters, and why.

Three kinds need no entry. A command has a parameter for each option, as Typer requires. A compiled function gets arrays
one by one: a tuple of arrays would be another signature, compiled to other code. An intrinsic has the parameters of the
compiled function that it generates.
"""


def list_functions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yield the interpreted functions of a module, however deep; functions inside a compiled one are part of it."""
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if has_kernel_decorator(node) or [one.arg for one in node.args.args[:1]] == ["typingctx"]:
                continue
            yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            pending += getattr(node, part, [])


def find_long_signatures(tree: ast.Module) -> dict[str, int]:
    """Return the names of the interpreted functions with too many parameters, and how many these have."""
    counts = ((one.name, len(list_parameters(one.args))) for one in list_functions(tree))
    return {name: count for name, count in counts if count > MAX_PARAMETERS}


def list_commands() -> set[str]:
    """Return the functions of all commands, as `file:function`."""
    callbacks = (command.callback for command in app.registered_commands)
    places = ((one.__module__.removeprefix("springbench."), one.__name__) for one in callbacks if one)
    return {f"{module.replace('.', '/')}.py:{name}" for module, name in places}


@pytest.fixture(scope="module")
def long_signatures() -> dict[str, int]:
    """The functions of the product with too many parameters, as `file:function`, and how many these have."""
    return {
        f"{one.path.relative_to(ROOT).as_posix()}:{name}": count
        for one in parse_sources()
        for name, count in find_long_signatures(one.tree).items()
    }


def test_a_function_has_at_most_eight_parameters(long_signatures: dict[str, int]) -> None:
    allowed = list_commands() | set(EXCEPTIONS)
    found = {place: count for place, count in long_signatures.items() if place not in allowed}
    assert not found, "make a named tuple of parameters that belong together"


def test_each_exception_is_still_needed(long_signatures: dict[str, int]) -> None:
    assert set(EXCEPTIONS) - set(long_signatures) == set(), "these have fewer parameters now"
    assert "harness/cli/main.py:run" in list_commands() & set(long_signatures)


def test_long_signatures_are_found_and_compiled_functions_are_exempt() -> None:
    code = """
def eight(a, b, c, d, e, f, g, h): ...
class A:
    @classmethod
    def build(cls, a, b, c, d, e, f, g, h): ...
    def method(self, a, b, c, d, e, f, /, g, *, h, i): ...
@jit_kernel
def kernel(a, b, c, d, e, f, g, h, i):
    def part(a, b, c, d, e, f, g, h, i): ...
def declare(typingctx, a, b, c, d, e, f, g, h): ...
try:
    async def outer(a, b, c, d, e, f, g, *rest, **more):
        if a:
            def inner(context, b, c, d, e, f, g, h, i, j): ...
        @cuda.jit(device=True)
        def change(a, b, c, d, e, f, g, h, i): ...
finally:
    pass
"""
    assert find_long_signatures(ast.parse(code)) == {"method": 9, "outer": 9, "inner": 10}

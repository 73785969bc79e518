"""Docstrings of functions state every parameter, by its name, in sections of one form."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from springbench.harness.cli.main import app
from springbench.harness.cli.reference_pages.markdown_text import read_section_entries

from tests.architecture.test_vocabulary import ROOT, parse_sources

SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises", "Example")


class DocumentedFunction(NamedTuple):
    """A function or method with a docstring: file, name, parameters without `self`, and the docstring."""

    file: str
    name: str
    is_public: bool
    parameters: list[str]
    docstring: str


def find_functions(tree: ast.AST, file: str, is_public: bool = True) -> Iterator[DocumentedFunction]:
    """Yield the documented functions of a module and of its classes, without those inside functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef):
            yield from find_functions(node, file, is_public and not node.name.startswith("_"))
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if docstring := ast.get_docstring(node):
                public = is_public and (not node.name.startswith("_") or node.name.startswith("__"))
                yield DocumentedFunction(file, node.name, public, list_parameters(node.args), docstring)
        elif isinstance(node, ast.If | ast.With | ast.Try):
            yield from find_functions(node, file, is_public)


def list_parameters(arguments: ast.arguments) -> list[str]:
    """List the names of all parameters but `self` and `cls`."""
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    others = filter(None, (arguments.vararg, arguments.kwarg))
    return [one.arg for one in (*named, *others) if one.arg not in ("self", "cls")]


def read_names(docstring: str, section: str) -> list[str]:
    """List the names that the entries of a section describe; an entry without a name is listed as it is."""
    return [name.lstrip("*") for name in read_section_entries(docstring, section)]


@pytest.fixture(scope="module")
def functions() -> list[DocumentedFunction]:
    found = (find_functions(one.tree, one.path.relative_to(ROOT).as_posix()) for one in parse_sources())
    return [one for functions in found for one in functions]


def test_public_functions_with_several_parameters_describe_them(functions: list[DocumentedFunction]) -> None:
    """Commands are exempt: their options have texts of their own, and their docstring is their help."""
    commands = {getattr(command.callback, "__name__", "") for command in app.registered_commands}
    several = [one for one in functions if one.is_public and len(one.parameters) > 1 and one.name not in commands]
    assert len(several) > 1000
    assert not [one[:2] for one in several if not read_names(one.docstring, "Args")]


def test_the_described_arguments_are_the_parameters(functions: list[DocumentedFunction]) -> None:
    described = (one for one in functions if re.search("^Args:", one.docstring, re.MULTILINE))
    named = ((one, read_names(one.docstring, "Args")) for one in described)
    assert not [(*one[:2], names) for one, names in named if sorted(names) != sorted(one.parameters)]


def list_docstrings() -> Iterator[tuple[str, str]]:
    """Yield all docstrings of the product, each with its file."""
    for one in parse_sources():
        for node in ast.walk(one.tree):
            documentable = isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef | ast.Module)
            if documentable and (docstring := ast.get_docstring(node)):
                yield one.path.relative_to(ROOT).as_posix(), docstring


def test_sections_have_one_form() -> None:
    """A section follows a blank line, and its text is indented below its title."""
    inline = re.compile(rf"^(?:{'|'.join(SECTIONS)}): |(?<!\n)\n(?:{'|'.join(SECTIONS)}):$", re.MULTILINE)
    assert not [
        f"{file}: {docstring.splitlines()[0]}" for file, docstring in list_docstrings() if inline.search(docstring)
    ]


REFERENCE = re.compile(r"\AThe same\b|\b[Ss]ee `")


def find_references(tree: ast.Module) -> list[str]:
    """Return the docstrings, of attributes too, that refer to another place instead of describing."""
    texts = (
        node.value for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    )
    return [text.value for text in texts if isinstance(text.value, str) and REFERENCE.search(text.value)]


def test_docstrings_describe_and_do_not_refer() -> None:
    found = {one.path.name: find_references(one.tree) for one in parse_sources()}
    assert not {name: texts for name, texts in found.items() if texts}, "write in a few words what it is"


def test_a_reference_in_place_of_a_description_is_found() -> None:
    source = '"""Rows."""\nA = 1\n"""The same of columns."""\ndef add_rows(x):\n    """Add x, see `g`."""\n'
    assert find_references(ast.parse(source)) == ["The same of columns.", "Add x, see `g`."]


MAX_SUMMARY_WORDS = 15


def count_summary_words(docstring: str) -> int:
    """Count the words of the first paragraph, without shapes, units and formulas in brackets."""
    summary = re.sub(r"\([^()]*\)|\[[^\[\]]*\]", "", docstring.partition("\n\n")[0])
    return len(re.findall(r"\S*\w\S*", summary))


def test_docstrings_begin_with_a_short_summary() -> None:
    docstrings = [*list_docstrings()]
    assert len(docstrings) > 5000
    assert not [
        f"{file}: {docstring.partition(chr(10))[0]}"
        for file, docstring in docstrings
        if count_summary_words(docstring) > MAX_SUMMARY_WORDS
    ]


def test_brackets_of_a_summary_are_no_words() -> None:
    assert count_summary_words("Compute lengths (m, 3) of springs [m] at p = x.\n\nArgs:\n    p: positions.") == 7


def test_described_attributes_are_defined() -> None:
    """Every name in the section `Attributes` of a class is a name in the body of that class or of a base class."""
    missing: list[str] = []
    classes = {
        node.name: node for one in parse_sources() for node in ast.walk(one.tree) if isinstance(node, ast.ClassDef)
    }
    for name, node in classes.items():
        described = read_names(ast.get_docstring(node) or "", "Attributes")
        bases = [node, *(classes[base.id] for base in node.bases if isinstance(base, ast.Name) and base.id in classes)]
        names = {found for base in bases for found in list_attributes(base)}
        missing += [f"{name}.{entry}" for entry in described if entry not in names]
    assert not missing


def list_attributes(node: ast.ClassDef) -> Iterator[str]:
    """Yield the names that a class defines: fields, methods, and attributes of `self`."""
    for part in ast.walk(node):
        if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
            yield part.id
        elif isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store):
            yield part.attr
        elif isinstance(part, ast.FunctionDef):
            yield part.name

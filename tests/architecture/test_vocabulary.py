"""Names and docstrings use the terms of the field: `harness/VOCABULARY.md` lists each and where it is implemented."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = [path for package in ("harness", "solvers") for path in sorted((ROOT / package).rglob("*.py"))]
PAGE = (ROOT / "harness" / "VOCABULARY.md").read_text(encoding="utf-8")
GLOSSARY = re.findall(r"^\| ([\w -]+) \| ([\w/]+\.py) \| .+ \|$", PAGE, re.MULTILINE)


def _split_words(text: str) -> frozenset[str]:
    return frozenset(text.split())


DIALECT = _split_words(
    "told tell tells kept held holding asks beside anew whoever nobody somebody yardstick racer racers crew "
    "shelf blame foresee oracle opinion grip peers goals"
)
"""Words that stand for terms of the field; none is part of a public name or opens a docstring."""
TEXT_DIALECT = DIALECT | _split_words(
    "ask asked holds keeps knows promise promises promised came wanted everybody anybody"
)
"""Words that are in no text of the product: messages, help, labels, docstrings and comments. A file contains or states,
a method supports or reaches, a user requests, a condition is satisfied, and results remain."""
NAME_DIALECT = TEXT_DIALECT | _split_words(
    "say says said saying telling lie lies lying know knowing way ways keep keeping hold answer answers answered "
    "answering oracles peer blamed truth judge judges judged doubt doubted doubtful ours theirs mine race races raced"
)
"""Words that are in no name of a test, helper, fixture or class of tests. A message states, a solver reports, a call
returns, a value is within a range, a body conserves its momentum, an interval contains a number."""
ALLOWED_TEXTS = {
    "wanted": "name of a lock file, which other versions of the program on the machine lock as well",
}
"""Texts with such a word, and why."""

OPERATIONS = _split_words(
    "solve step prepare residual iterates value gradient hessian factorise multiply matvec toarray close main save"
)
"""Operations that papers, or Python, SciPy, optimistix, ipctk and Pillow, call by this one word."""
PROPERTIES = _split_words(
    "values stats order state time positions velocity elements energies dhat gamma beta weight vertices targets "
    "motion scene title description name kind index verdict columns info speedup"
)
"""Quantities and attributes of small classes, whose class name says the rest."""
PROPER = _split_words("Admm Xpbd Anderson Chebyshev Lbfgs Tsitouras5 Ros2 Rodas Jgs2 Multigrid Woodbury BVH Colouring")
"""Methods, and the data structures of methods, that the literature names so."""
ENERGIES = _split_words("Springs Dashpots Bending Gas Sewing Quadratic Attachments")
"""Energies, each named by what stores it."""
NOUNS = _split_words(
    "Mesh Scene System Solver Solution Energy Hessian Stage Motion Unsupported Simulation Trajectory Trial Method "
    "Stepper Stopwatch Citation Elements Candidates Collisions Triangulation"
)
"""Classes that are the only ones of their kind, so that a second word adds nothing."""
COMMANDS = _split_words(
    "run ablate compact merge mesh publish figure gallery preview recommend convergence regress roofline accuracy "
    "report query reference schema inspect view matrices grade validate pages reproduce compare"
)
"""Commands of the command line, each a function of its name."""
REQUIRED = _split_words("invoke emit filter finalize codegen enable disable flush start stop refresh")
"""Methods that override those of a class of Typer, logging, Numba or Rich."""
VECTORS = _split_words("load store shuffle dot3 cross3 subtract3")
"""Operations of vector registers, named as in LLVM, and of vectors with three components."""
SETS = OPERATIONS, PROPERTIES, PROPER, ENERGIES, NOUNS, COMMANDS, REQUIRED, VECTORS
ONE_WORD = frozenset[str]().union(*SETS)


class Definition(NamedTuple):
    """A module, class or function with its docstring."""

    file: str
    name: str
    docstring: str
    is_module: bool = False

    @property
    def words(self) -> list[str]:
        """Words of the name, in lower case."""
        return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z0-9]+", self.name)]


def find_definitions(tree: ast.Module, file: str) -> Iterator[Definition]:
    """Yield the module, and its classes, functions and methods."""
    yield Definition(file, Path(file).stem.strip("_"), ast.get_docstring(tree) or "", is_module=True)
    pending: list[ast.AST] = [tree]
    while pending:
        for node in ast.iter_child_nodes(pending.pop()):
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                yield Definition(file, node.name, ast.get_docstring(node) or "")
            if isinstance(node, ast.ClassDef):
                pending.append(node)


class ParsedSource(NamedTuple):
    """A file of the product: its text, and its tree."""

    path: Path
    text: str
    tree: ast.Module


@cache
def parse_sources() -> list[ParsedSource]:
    """Parse all files of the product, once."""
    texts = ((path, path.read_text()) for path in FILES)
    return [ParsedSource(path, text, ast.parse(text)) for path, text in texts]


@cache
def list_public_definitions() -> list[Definition]:
    """Return all definitions whose names do not begin with an underscore."""
    found = (find_definitions(one.tree, one.path.relative_to(ROOT).as_posix()) for one in parse_sources())
    return [one for definitions in found for one in definitions if not one.name.startswith("_")]


def test_no_public_name_uses_a_word_of_the_dialect() -> None:
    assert not {f"{one.file}: {one.name}" for one in list_public_definitions() if DIALECT & set(one.words)}


def test_no_docstring_begins_with_a_word_of_the_dialect() -> None:
    first_lines = ((one, one.docstring.partition("\n")[0].lower()) for one in list_public_definitions())
    assert not {f"{one.file}: {line}" for one, line in first_lines if DIALECT & set(re.findall(r"\w+", line))}


def find_texts(tree: ast.Module, source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of each string, docstring and comment; of an f-string without its expressions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
    for number, line in enumerate(source.splitlines(), 1):
        if "#" in line:
            yield number, line.partition("#")[2]


def find_dialect(tree: ast.Module, source: str) -> set[str]:
    """Return the words of the dialect in the texts of a file, as `line: word`; words within a name are none."""
    texts = ((line, text) for line, text in find_texts(tree, source) if text not in ALLOWED_TEXTS)
    return {
        f"{line}: {word}" for line, text in texts for word in TEXT_DIALECT & set(re.findall(r"[a-z_]+", text.lower()))
    }


@pytest.mark.parametrize("package", ["harness", "solvers"])
def test_no_text_of_the_product_uses_a_word_of_the_dialect(package: str) -> None:
    files = [one for one in parse_sources() if one.path.is_relative_to(ROOT / package)]
    found = {f"{one.path.relative_to(ROOT)}:{at}" for one in files for at in find_dialect(one.tree, one.text)}
    assert not found


def find_docstrings(tree: ast.Module) -> Iterator[str]:
    """Yield the docstrings of a module and of all that it defines, however deep."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


@cache
def parse_tests() -> list[ParsedSource]:
    """Parse all files of the tests, once."""
    texts = ((path, path.read_text()) for path in sorted((ROOT / "tests").rglob("*.py")))
    return [ParsedSource(path, text, ast.parse(text)) for path, text in texts]


def test_docstrings_of_tests_use_the_terms_of_the_field() -> None:
    texts = [
        (one.path, re.sub("`[^`]*`", "", text))  # names of files and commands
        for one in parse_tests()
        for text in find_docstrings(one.tree)
    ]
    assert not {
        f"{path.name}: {text}" for path, text in texts if TEXT_DIALECT & set(re.findall(r"[a-z_]+", text.lower()))
    }


def find_dialect_names(tree: ast.Module) -> set[str]:
    """Return the functions and classes, however deep, and the module's constants that have a word of the dialect."""
    names = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names |= {one.id for target in targets if target for one in ast.walk(target) if isinstance(one, ast.Name)}
    return {name for name in names if NAME_DIALECT & set(Definition("", name, "").words)}


def test_names_of_tests_use_the_terms_of_the_field() -> None:
    assert not {f"{one.path.name}: {name}" for one in parse_tests() for name in find_dialect_names(one.tree)}


def test_words_of_the_dialect_are_found_in_names_of_tests() -> None:
    source = "HELD, SIZE = 1, 2\nKEPT: int = 3\ndef test_it_says_so(oracle):\n    def ours(): ...\nclass Answer: ...\n"
    assert find_dialect_names(ast.parse(source)) == {"HELD", "KEPT", "test_it_says_so", "ours", "Answer"}


def test_each_allowed_text_is_still_there() -> None:
    texts = {text for one in parse_sources() for _, text in find_texts(one.tree, one.text)}
    assert set(ALLOWED_TEXTS) <= texts


def test_words_of_the_dialect_are_found_in_every_kind_of_text() -> None:
    source = '''"""What holds."""\nkept = f"{kept} came, {1}"  # nobody asks\nX = "kept_pairs"\n"""It keeps."""\n'''
    assert find_dialect(ast.parse(source), source) == {"1: holds", "2: came", "2: asks", "2: nobody", "4: keeps"}


def test_public_names_have_two_words_or_a_reason() -> None:
    one_word = {one.name for one in list_public_definitions() if not one.is_module and len(one.words) == 1}
    assert one_word - ONE_WORD == set(), "give it a second word, or a reason in this file"
    assert ONE_WORD - one_word == set(), "these are no longer defined"
    assert len(ONE_WORD) == sum(map(len, SETS)), "a word is in two sets"


def test_the_glossary_has_forty_terms() -> None:
    assert len({term for term, _ in GLOSSARY}) >= 40


@pytest.mark.parametrize(("term", "file"), GLOSSARY, ids=[term for term, _ in GLOSSARY])
def test_a_search_for_a_term_ends_at_the_file_that_implements_it(term: str, file: str) -> None:
    pattern = re.compile(r"[\s_-]+".join(map(re.escape, re.split(r"[ _-]", term))), re.IGNORECASE)
    tree = ast.parse((ROOT / file).read_text())
    names = [node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)]
    names += [node.id for node in ast.walk(tree) if isinstance(node, ast.Name)]
    texts = [text for one in find_definitions(tree, file) for text in (one.name, one.docstring)]
    assert any(map(pattern.search, [*names, *texts]))


def test_a_word_of_the_dialect_is_found_within_a_name() -> None:
    (_, one) = find_definitions(ast.parse("class KeptPairs: ..."), "a.py")
    assert one.words == ["kept", "pairs"]
    assert DIALECT & set(one.words)

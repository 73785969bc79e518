"""A public name has one meaning, and no file uses two classes of one name."""

import ast
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILES = [path for package in ("harness", "solvers") for path in sorted((ROOT / package).rglob("*.py"))]

PAIRED = "Energy"
"""As what an effect's file imports the energy of the effect's name, which is its other half."""

Trees = dict[str, ast.Module]


def met(trees: Trees) -> list[str]:
    """The file and the name, where a file defines or imports classes of one name from two modules."""
    homes: dict[str, set[str]] = defaultdict(set)
    for module, tree in trees.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                homes[node.name].add(module)
    return sorted(f"{module}: {name}" for module, tree in trees.items() for name in _twice(module, tree, homes))


def _twice(module: str, tree: ast.Module, homes: dict[str, set[str]]) -> Iterable[str]:
    here: dict[str, set[str]] = defaultdict(set)
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and module in homes[node.name]:
            here[node.name].add(module)
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if node.module in homes.get(alias.name, ()) and alias.asname != PAIRED:
                    here[alias.name].add(str(node.module))
    return (name for name, modules in here.items() if len(modules) > 1 and not name.startswith("_"))


PUBLISHED = {
    "main": "the entry point of each program",
    "load_scene": "`harness/api.py` publishes the loader of configs, and accepts a str for a path",
}
"""Names of functions that several modules define, and why."""


def find_homonyms(trees: Trees) -> set[str]:
    """Return public functions and classes that several modules define."""
    homes: dict[str, set[str]] = defaultdict(set)
    for module, tree in trees.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                homes[node.name].add(module)
    return {name for name, modules in homes.items() if len(modules) > 1}


def parsed(texts: Iterable[tuple[str, str]]) -> Trees:
    return {module: ast.parse(text) for module, text in texts}


def test_no_file_meets_two_classes_of_one_name() -> None:
    modules = (
        (".".join(("springbench", *path.relative_to(ROOT).with_suffix("").parts)), path.read_text()) for path in FILES
    )
    assert met(parsed(modules)) == [], "give one of them a name of its own"


def test_a_public_name_is_defined_once() -> None:
    homonyms = find_homonyms(parsed((str(path), path.read_text()) for path in FILES))
    assert homonyms - set(PUBLISHED) == set(), "give one of them a name of its own"
    assert set(PUBLISHED) - homonyms == set(), "these are defined once now"


def test_a_clash_is_found_under_another_name_too() -> None:
    texts = [("a.x", "class Step: ..."), ("a.y", "class Step: ..."), ("a.z", "from a.x import Step as Other")]
    assert met(parsed(texts)) == []
    assert met(parsed([*texts, ("a.w", "from a.x import Step as One\nfrom a.y import Step")])) == ["a.w: Step"]
    assert met(parsed([*texts, ("a.v", "from a.x import Step as Energy\nfrom a.y import Step")])) == []

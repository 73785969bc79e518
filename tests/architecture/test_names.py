"""A public name has one meaning, no file uses two classes of one name, and a function is no participle."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

from tests.architecture.test_vocabulary import FILES, ROOT, parse_sources

ENERGY_CLASS = "Energy"
"""As what an effect's file imports the energy of the effect's name, which is its other half."""

Trees = dict[str, ast.Module]


def find_class_clashes(trees: Trees) -> list[str]:
    """The file and the name, where a file defines or imports classes of one name from two modules."""
    homes: dict[str, set[str]] = defaultdict(set)
    for module, tree in trees.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef):
                homes[node.name].add(module)
    return sorted(
        f"{module}: {name}" for module, tree in trees.items() for name in _find_ambiguous_names(module, tree, homes)
    )


def _find_ambiguous_names(module: str, tree: ast.Module, homes: dict[str, set[str]]) -> Iterable[str]:
    here: dict[str, set[str]] = defaultdict(set)
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and module in homes[node.name]:
            here[node.name].add(module)
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if node.module in homes.get(alias.name, ()) and alias.asname != ENERGY_CLASS:
                    here[alias.name].add(str(node.module))
    return (name for name, modules in here.items() if len(modules) > 1 and not name.startswith("_"))


REPEATED_NAMES = {
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


def parse_modules(texts: Iterable[tuple[str, str]]) -> Trees:
    return {module: ast.parse(text) for module, text in texts}


def name_product_trees() -> Trees:
    """The trees of all files of the product, by the dotted names of their modules."""
    places = ((one.path.relative_to(ROOT).with_suffix(""), one.tree) for one in parse_sources())
    return {".".join(("springbench", *place.parts)): tree for place, tree in places}


def test_no_file_refers_to_two_classes_of_one_name() -> None:
    assert find_class_clashes(name_product_trees()) == [], "give one of them a name of its own"


def test_a_public_name_is_defined_once() -> None:
    homonyms = find_homonyms(name_product_trees())
    assert homonyms - set(REPEATED_NAMES) == set(), "give one of them a name of its own"
    assert set(REPEATED_NAMES) - homonyms == set(), "these are defined once now"


def test_a_clash_is_found_under_another_name_too() -> None:
    texts = [("a.x", "class Step: ..."), ("a.y", "class Step: ..."), ("a.z", "from a.x import Step as Other")]
    assert find_class_clashes(parse_modules(texts)) == []
    assert find_class_clashes(
        parse_modules([*texts, ("a.w", "from a.x import Step as One\nfrom a.y import Step")])
    ) == ["a.w: Step"]
    assert (
        find_class_clashes(parse_modules([*texts, ("a.v", "from a.x import Step as Energy\nfrom a.y import Step")]))
        == []
    )


PARTICIPLE = re.compile(
    "_*([a-z]+(ed|en|wn)|begun|bound|brought|built|chosen|done|found|gone|held|kept|left|lost|made|sent|swept|taken)_*"
)
EXCEPTED_NAMES = {
    "codegen": "a property that Numba prescribes",
    "_shorten": "a verb that ends in en",
    "__len__": "a method that Python prescribes",
}
"""Names of functions that end as a past participle does, and why they are right."""


def find_participles(tree: ast.Module) -> set[str]:
    """Return the functions and methods, however deep, whose name is a past participle alone."""
    names = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}
    return {name for name in names if PARTICIPLE.fullmatch(name)}


def test_no_function_is_named_by_a_past_participle_alone() -> None:
    found = {name for tree in name_product_trees().values() for name in find_participles(tree)}
    assert found - set(EXCEPTED_NAMES) == set(), "name it by a verb and an object, or as a noun"
    assert set(EXCEPTED_NAMES) - found == set(), "these are no longer defined"


def test_a_past_participle_is_found_within_functions_and_classes() -> None:
    source = "class A:\n    def _shifted(self):\n        def drawn(): ...\ndef shift_pins(): ...\ndef read(): ...\n"
    assert find_participles(ast.parse(source)) == {"_shifted", "drawn"}


def find_unresolved(text: str, root: Path) -> set[str]:
    """Return dotted names `springbench.harness...` and `springbench.solvers...` in a text that nothing defines."""
    return {name for name in set(re.findall(r"\bspringbench((?:\.[A-Za-z]\w*)+)", text)) if not _is_defined(name, root)}


def _is_defined(name: str, root: Path) -> bool:
    _, *parts = name.split(".")
    if parts[0] not in ("harness", "solvers"):
        return True
    place = root
    while parts and (place / parts[0]).is_dir():
        place /= parts.pop(0)
    if not parts:
        return True
    is_module = (place / f"{parts[0]}.py").is_file()
    file = place / (f"{parts.pop(0)}.py" if is_module else "__init__.py")
    return not parts or re.search(rf"\b{parts[0]}\b", file.read_text()) is not None


def test_dotted_names_in_texts_of_the_product_are_defined() -> None:
    pages = [path for path in ROOT.glob("*/README.md") if path.parent.name != "tests"]
    assert {(path.name, name) for path in (*FILES, *pages) for name in find_unresolved(path.read_text(), ROOT)} == set()


def test_a_dotted_name_that_nothing_defines_is_found() -> None:
    text = (
        "springbench.solvers.registry.SOLVER_TABLE, `springbench.solvers.registry.nothing`, springbench.harness.none.x"
    )
    assert find_unresolved(text, ROOT) == {".solvers.registry.nothing", ".harness.none.x"}

"""Dependencies of source files, and their digest, which identifies compiled kernels and measurements.

A source depends on itself and on the sources that its imports lead to, wherever in the file the imports stand. Imports
are followed within this project, and within its own folder or package if the source lies elsewhere. A source elsewhere
depends on the modules of the public names of `springbench` that it uses, except those that scripts call. A source also
depends on compiled-language files of the same name next to it, as `eigen_local_global.py` does on
`eigen_local_global.cpp` and `eigen_local_global.hpp`. Installed libraries are identified by their versions.

A process continues to run the code that it has imported, even if the files change. So each source is identified by its
state when this module was imported, or when its digest was first needed. A source that has changed since then gets a
digest that no other process has.

Digests and imports are stored in the user's cache folder, under one state of all files: time of modification, time of
change, size and inode number of each. Every edit changes at least one of these.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

_MAX_STATES = 8
"""Number of stored states, which serve as many checkouts."""
_SETTLING_NS = 2 * 10**9
"""Age [ns] from which a file is stored: two edits of a younger one can have the same time."""


class SourceFacts(NamedTuple):
    """Content digest of a source (hexadecimal), and the paths that it imports or compiles."""

    digest: str
    imports: list[str]


def read_facts(states: Mapping[str, os.stat_result]) -> dict[str, SourceFacts]:
    """Return the stored facts by path for this state of the sources; empty if none."""
    with suppress(OSError, ValueError, TypeError, IndexError):
        paths, facts = json.loads(_find_file(states).read_text(encoding="utf-8"))
        return {
            path: SourceFacts(digest, [paths[k] for k in imports])
            for path, (digest, imports) in zip(paths, facts, strict=True)
        }
    return {}


def store_facts(states: Mapping[str, os.stat_result], facts: Mapping[str, SourceFacts]) -> None:
    """Store the facts of all sources if possible.

    Args:
        states: state of each source before it was read.
        facts: facts of each of these sources.
    """
    import tempfile  # takes 10 ms, and is rarely needed

    path, paths = _find_file(states), sorted(facts)
    numbers = {name: k for k, name in enumerate(paths)}
    text = json.dumps([paths, [(facts[name].digest, [numbers[one] for one in facts[name].imports]) for name in paths]])
    youngest = max(max(found.st_mtime_ns, found.st_ctime_ns) for found in states.values())
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        number, partial = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(text)
        is_settled = youngest < os.stat(partial).st_mtime_ns - _SETTLING_NS
        if not is_settled or _find_file({name: os.stat(name) for name in states}) != path:  # edited while it was read
            os.unlink(partial)
            return
        os.replace(partial, path)
        stored = sorted(path.parent.glob("*.json"), key=lambda one: one.stat().st_mtime)
        for older in stored[:-_MAX_STATES]:
            older.unlink(missing_ok=True)


def _find_file(states: Mapping[str, os.stat_result]) -> Path:
    described = [(path, *_describe_state(found)) for path, found in sorted(states.items())]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench" / "sources"
    return folder / f"{hashlib.sha256(repr(described).encode()).hexdigest()[:32]}.json"


def _describe_state(found: os.stat_result) -> tuple[int, ...]:
    return found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino


PROJECT_ROOT = Path(__file__).resolve().parents[2]
"""The folder of the project's packages."""

PACKAGE_NAMES = ("solvers", "harness")
_TOP_PACKAGE = "springbench"
_PACKAGE_PREFIXES = tuple(
    f"{root / package}{os.sep}"
    # An editable installation imports the packages through links.
    for root in dict.fromkeys((PROJECT_ROOT, Path(os.path.abspath(__file__)).parents[2]))
    for package in PACKAGE_NAMES
)

COMPILED_SUFFIXES = (".c", ".cc", ".cpp", ".cu", ".cuh", ".f90", ".h", ".hpp")
"""Suffixes of sources that a Python source of the same name compiles."""

_LIBRARY_FOLDERS = {str(Path(sysconfig.get_path(name)).resolve()) for name in ("stdlib", "purelib", "platlib")}
_TYPE_CHECKING_BLOCK = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+\S.*\n|\n)+", re.M)
"""Imports for type checkers, which are never executed."""

_SCRIPT_MODULE = f"{_TOP_PACKAGE}.harness.api"
"""Module of the functions that scripts call, such as `run_config`: no solver or effect of a user depends on them."""
_PUBLIC_NAME_PATTERN = re.compile(rf"\b{_TOP_PACKAGE}\.(\w+)")
_IMPORT_PATTERN = re.compile(
    r"^[ \t]*(?:from[ \t]+(?P<base>\.*[\w.]*)[ \t]+import[ \t]+(?P<names>\([^)]*\)|.*)|import[ \t]+(?P<whole>.+))", re.M
)
_PROCESS_SALT = os.urandom(16)

FileStamp = tuple[int, int]


def _stamp_file(path: str) -> FileStamp:
    found = os.stat(path)
    return found.st_mtime_ns, found.st_size


def _scan_folder(folder: str) -> Iterator[tuple[str, os.stat_result]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                yield from _scan_folder(entry.path)
            elif entry.name.endswith((".py", *COMPILED_SUFFIXES)):
                yield entry.path, entry.stat()


_FIRST_STATES = {
    path: found
    for package in PACKAGE_NAMES
    if (PROJECT_ROOT / package).is_dir()
    for path, found in _scan_folder(str(PROJECT_ROOT / package))
}
"""State of each source of this project when this module was imported."""
_FIRST_STAMPS: dict[str, FileStamp] = {
    path: (found.st_mtime_ns, found.st_size) for path, found in _FIRST_STATES.items()
}
"""Stamp of each source when it was first read."""


def digest_sources(sources: Iterable[str | Path]) -> str:
    """Return the SHA-256 digest, in hexadecimal digits, of all sources that these depend on."""
    digest = hashlib.sha256()
    for name, path in _sorted_dependencies(frozenset(os.path.abspath(source) for source in sources)):
        digest.update(f"{name}\0".encode() + _content_digest(path))
    return digest.hexdigest()


@cache
def _sorted_dependencies(sources: frozenset[str]) -> list[tuple[str, str]]:
    """Return the dependencies of sources at absolute paths, sorted by name.

    The result is cached for the runs of a sweep.
    """
    paths = {path for source in sources for path in find_dependencies(str(Path(source).resolve()))}
    return sorted((_portable_name(path), path) for path in paths)


@cache
def find_dependencies(source: str) -> frozenset[str]:
    """Return the paths of all dependencies of a source at an absolute path, including itself."""
    found, todo = {source}, [source]
    while todo:
        new = _find_imports(todo.pop()) - found
        found |= new
        todo += new
    return frozenset(found)


def digest_package(package: str) -> str:
    """Return the SHA-256 digest, in hexadecimal digits, of all sources of a package in PACKAGE_NAMES."""
    start, digest = f"{PROJECT_ROOT / package}{os.sep}", hashlib.sha256()
    for path in sorted(path for path in _FIRST_STAMPS if path.startswith(start)):
        digest.update(f"{_portable_name(path)}\0".encode() + _content_digest(path))
    return digest.hexdigest()


def stamp_sources() -> str:
    """Return the SHA-256 digest, in hexadecimal digits, of path, time and size of each source.

    It identifies the state of a checkout or an installation in a tenth of the time of `digest_sources`.
    """
    return hashlib.sha256(repr(sorted(_FIRST_STAMPS.items())).encode()).hexdigest()


@cache
def find_class_sources(made: type) -> frozenset[Path]:
    """Return the source files of a class and its bases, without those of libraries."""
    own = {getattr(sys.modules.get(made.__module__), "__file__", None)}
    for base in made.__mro__:
        # A module that was loaded manually may be identifiable by its functions only.
        values = list(vars(base).values())  # a model of pydantic may be completed by the access to its attributes
        codes = (getattr(value, "__code__", None) for value in values)
        files = {code.co_filename for code in codes if code}
        files.add(getattr(sys.modules.get(base.__module__), "__file__", None))
        own |= {file for file in files if file and not _is_library_file(file)}
    return frozenset(Path(file).resolve() for file in own if file and file.endswith(".py") and os.path.isfile(file))


def is_known_source(path: str) -> bool:
    """Return whether a file is part of this project or of an installed library.

    A name such as `<string>` is known, too.
    """
    return _is_project_file(path) or _is_library_file(path) or path.startswith("<")


@cache
def _is_library_file(path: str) -> bool:
    return not _is_project_file(path) and any(
        folder in _LIBRARY_FOLDERS for folder in map(str, Path(path).resolve().parents)
    )


@cache
def _portable_name(path: str) -> str:
    """Return the path in a form that is the same in every checkout."""
    return os.path.relpath(path, PROJECT_ROOT) if _is_project_file(path) else os.path.basename(path)


def _is_project_file(path: str) -> bool:
    return path.startswith(_PACKAGE_PREFIXES)


def _content_digest(path: str) -> bytes:
    """Return the digest of a source.

    It is unique to this process if the file has changed since it was first read.
    """
    try:
        first = _FIRST_STAMPS.get(path) or _FIRST_STAMPS.setdefault(path, _stamp_file(path))
        file_digest = _file_digest(path)
        if _stamp_file(path) == first:
            return file_digest
    except OSError:  # it was removed
        file_digest = b""
    return hashlib.sha256(_PROCESS_SALT + file_digest).digest()


@cache
def _file_digest(path: str) -> bytes:
    known = _read_facts().get(path)
    return bytes.fromhex(known.digest) if known else hashlib.sha256(Path(path).read_bytes()).digest()


@cache
def _read_facts() -> dict[str, SourceFacts]:
    """Return digest and imports of all sources of this project, from the store if possible."""
    facts = read_facts(_FIRST_STATES)
    if not facts:
        with suppress(OSError):  # one was removed
            for path in _FIRST_STATES:
                digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
                facts[path] = SourceFacts(digest, sorted(_parse_imports(path)))
            store_facts(_FIRST_STATES, facts)
            return facts
        return {}
    return facts


@cache
def _find_imports(source: str) -> set[str]:
    """Return the sources that a source imports or compiles, and their packages' `__init__` files."""
    known = _read_facts().get(source)
    return set(known.imports) if known else _parse_imports(source)


def _parse_imports(source: str) -> set[str]:
    if not source.endswith(".py"):
        return set()
    compiled = {
        path for path in (f"{source.removesuffix('.py')}{ending}" for ending in COMPILED_SUFFIXES) if _is_source(path)
    }
    try:
        text = Path(source).read_text(encoding="utf-8", errors="replace")
    except OSError:  # it was removed, which `_content_digest` detects
        return compiled
    run = _TYPE_CHECKING_BLOCK.sub("", text)
    names = [*_imported_names(run), *((_TOP_PACKAGE, name) for name in _find_public_names(source, run))]
    return compiled | {path for base, name in names for path in _resolve_import(source, base, name)}


def _list_public_modules() -> Mapping[str, str]:
    """Return the module of each public name, which is imported on first use."""
    return getattr(sys.modules.get(_TOP_PACKAGE), "_MODULE_OF", {})


def _find_public_names(source: str, text: str) -> set[str]:
    """Return the public names that a source outside this project uses."""
    return set() if _is_project_file(source) else _list_public_modules().keys() & _PUBLIC_NAME_PATTERN.findall(text)


def _imported_names(text: str) -> Iterator[tuple[str, str]]:
    """Yield each imported name as a pair (module, name).

    The module is "" if the name is a module itself.
    """
    for found in _IMPORT_PATTERN.finditer(text):
        listed = re.sub(r"#.*|[()\\]", "", found["names"] or found["whole"])
        for entry in listed.split(","):
            if words := entry.split():
                yield found["base"] or "", words[0]


def _resolve_import(source: str, base: str, name: str) -> Iterator[str]:
    folder, own = _import_root(source)
    if base.startswith("."):
        steps = len(base) - len(base.lstrip("."))
        parts = [*own[: len(own) - steps + 1], *base.strip(".").split("."), name]
    else:
        parts = [*base.split("."), *name.split(".")]
    parts = [part for part in parts if part]
    if len(parts) == 2 and parts[0] == _TOP_PACKAGE and not _is_project_file(source):
        module = _list_public_modules().get(parts[1], "")
        parts = module.split(".") if module and module != _SCRIPT_MODULE else parts
    if parts[0] == _TOP_PACKAGE and parts[1:2] and parts[1] in PACKAGE_NAMES:
        folder, parts = str(PROJECT_ROOT), parts[1:]
    elif parts[0] not in own[:1] and (_is_project_file(source) or folder in _LIBRARY_FOLDERS):
        return
    place = folder
    for part in parts:
        place = os.path.join(place, part)
        for path in (f"{place}.py", os.path.join(place, "__init__.py")):
            if _is_source(path):
                yield path


def _is_source(path: str) -> bool:
    """Return whether a source exists, or was in this project when this module was imported."""
    return path in _FIRST_STAMPS or (not _is_project_file(path) and os.path.isfile(path))


@cache
def _import_root(source: str) -> tuple[str, list[str]]:
    """Return the folder from which imports are resolved, and the packages down to the source."""
    folder, packages = os.path.dirname(source), list[str]()
    while os.path.isfile(os.path.join(folder, "__init__.py")):
        folder, package = os.path.split(folder)
        packages.insert(0, package)
    return folder, packages

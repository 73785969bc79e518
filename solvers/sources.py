"""The sources that code depends on, and their digest, which identifies the code of kernels and measurements.

A source depends on itself and on the sources that its imports lead to, wherever in the file the imports stand. Imports
are followed within this project, and within its own folder or package if the source lies elsewhere. A source also
depends on compiled-language files of the same name next to it, as `eigen.py` does on `eigen.cpp` and `eigen.hpp`.
Installed libraries are identified by their versions.

A process continues to run the code that it has imported, even if the files change. So each source is identified by its
state when this module was imported, or when its digest was first needed. A source that has changed since then gets a
digest that no other process has.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""The folder of the project's packages."""

PACKAGES = ("solvers", "harness")
_STARTS = tuple(f"{ROOT / package}{os.sep}" for package in PACKAGES)

COMPILED = (".c", ".cc", ".cpp", ".cu", ".cuh", ".f90", ".h", ".hpp")
"""Suffixes of sources that a Python source of the same name compiles."""

_INSTALLED = {str(Path(sysconfig.get_path(name)).resolve()) for name in ("stdlib", "purelib", "platlib")}
_TYPES_ALONE = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+\S.*\n|\n)+", re.M)
"""Imports for type checkers, which are never executed."""

_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+(?P<base>\.*[\w.]*)[ \t]+import[ \t]+(?P<names>\([^)]*\)|.*)|import[ \t]+(?P<whole>.+))", re.M
)
_SALT = os.urandom(16)

Stamp = tuple[int, int]


def _stamp(path: str) -> Stamp:
    found = os.stat(path)
    return found.st_mtime_ns, found.st_size


def _stamps(folder: str) -> Iterator[tuple[str, Stamp]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                yield from _stamps(entry.path)
            elif entry.name.endswith((".py", *COMPILED)):
                found = entry.stat()
                yield entry.path, (found.st_mtime_ns, found.st_size)


_FIRST: dict[str, Stamp] = {
    path: stamp for package in PACKAGES if (ROOT / package).is_dir() for path, stamp in _stamps(str(ROOT / package))
}
"""Stamp of each source when it was first read."""


def digest(sources: Iterable[str | Path]) -> str:
    """Return the SHA-256 digest, in hexadecimal digits, of all sources that these depend on."""
    told = hashlib.sha256()
    for name, path in _reached_by(frozenset(os.path.abspath(source) for source in sources)):
        told.update(f"{name}\0".encode() + _content(path))
    return told.hexdigest()


@cache
def _reached_by(sources: frozenset[str]) -> list[tuple[str, str]]:
    """Return the dependencies of sources at absolute paths, sorted by name; cached for the runs of a sweep."""
    paths = {path for source in sources for path in reached(str(Path(source).resolve()))}
    return sorted((_name(path), path) for path in paths)


@cache
def reached(source: str) -> frozenset[str]:
    """Return the paths of all sources that the one at an absolute path depends on, including itself."""
    found, todo = {source}, [source]
    while todo:
        new = _imported(todo.pop()) - found
        found |= new
        todo += new
    return frozenset(found)


def everything(package: str) -> str:
    """Return the SHA-256 digest, in hexadecimal digits, of all sources of a package in PACKAGES."""
    start, told = f"{ROOT / package}{os.sep}", hashlib.sha256()
    for path in sorted(path for path in _FIRST if path.startswith(start)):
        told.update(f"{_name(path)}\0".encode() + _content(path))
    return told.hexdigest()


@cache
def of_class(made: type) -> frozenset[Path]:
    """Return the source files of a class and of its base classes, without those of libraries."""
    own = {getattr(sys.modules.get(made.__module__), "__file__", None)}
    for base in made.__mro__:
        # A module that was loaded manually may be identifiable by its functions only.
        codes = (getattr(value, "__code__", None) for value in vars(base).values())
        files = {code.co_filename for code in codes if code}
        files.add(getattr(sys.modules.get(base.__module__), "__file__", None))
        own |= {file for file in files if file and not _library(file)}
    return frozenset(Path(file).resolve() for file in own if file and file.endswith(".py") and os.path.isfile(file))


def known(path: str) -> bool:
    """Return whether a file is part of this project or of an installed library, not third-party code."""
    return _own(path) or _library(path) or path.startswith("<")


@cache
def _library(path: str) -> bool:
    return not _own(path) and any(folder in _INSTALLED for folder in map(str, Path(path).resolve().parents))


@cache
def _name(path: str) -> str:
    """Return the path in a form that is the same in every checkout."""
    return os.path.relpath(path, ROOT) if _own(path) else os.path.basename(path)


def _own(path: str) -> bool:
    return path.startswith(_STARTS)


def _content(path: str) -> bytes:
    """Return the digest of a source; it is unique to this process if the file has changed since the first read."""
    try:
        first = _FIRST.get(path) or _FIRST.setdefault(path, _stamp(path))
        held = _held(path)
        if _stamp(path) == first:
            return held
    except OSError:  # it was removed
        held = b""
    return hashlib.sha256(_SALT + held).digest()


@cache
def _held(path: str) -> bytes:
    return hashlib.sha256(Path(path).read_bytes()).digest()


@cache
def _imported(source: str) -> set[str]:
    """Return the sources that a source imports or compiles, and the `__init__` files of their packages."""
    if not source.endswith(".py"):
        return set()
    compiled = {path for path in (f"{source.removesuffix('.py')}{ending}" for ending in COMPILED) if _exists(path)}
    try:
        text = Path(source).read_text(encoding="utf-8", errors="replace")
    except OSError:  # it was removed, which `digest` notes
        return compiled
    run = _TYPES_ALONE.sub("", text)
    return compiled | {path for base, name in _names(run) for path in _found(source, base, name)}


def _names(text: str) -> Iterator[tuple[str, str]]:
    """Yield each imported name as a pair (module, name); the module is "" if the name is a module itself."""
    for found in _IMPORT.finditer(text):
        listed = re.sub(r"#.*|[()\\]", "", found["names"] or found["whole"])
        for entry in listed.split(","):
            if words := entry.split():
                yield found["base"] or "", words[0]


def _found(source: str, base: str, name: str) -> Iterator[str]:
    folder, own = _home(source)
    if base.startswith("."):
        steps = len(base) - len(base.lstrip("."))
        parts = [*own[: len(own) - steps + 1], *base.strip(".").split("."), name]
    else:
        parts = [*base.split("."), *name.split(".")]
    parts = [part for part in parts if part]
    if parts[0] in PACKAGES:
        folder = str(ROOT)
    elif parts[0] not in own[:1] and (_own(source) or folder in _INSTALLED):
        return
    place = folder
    for part in parts:
        place = os.path.join(place, part)
        for path in (f"{place}.py", os.path.join(place, "__init__.py")):
            if _exists(path):
                yield path


def _exists(path: str) -> bool:
    """Return whether there is a source, or was one of ours when this module was imported."""
    return path in _FIRST or (not _own(path) and os.path.isfile(path))


@cache
def _home(source: str) -> tuple[str, list[str]]:
    """Return the folder from which imports of a source are resolved, and the packages between it and the source."""
    folder, packages = os.path.dirname(source), list[str]()
    while os.path.isfile(os.path.join(folder, "__init__.py")):
        folder, package = os.path.split(folder)
        packages.insert(0, package)
    return folder, packages

"""Which sources code depends on, and their digest: what tells kernels, and measurements, of other code apart.

A source depends on itself and on those that its imports lead to, wherever in it they stand: within this project, and
within its own folder or package where it lies elsewhere. It depends as well on what lies beside it under its own name
in a language that is compiled, as `eigen.cpp` and `eigen.hpp` do beside `eigen.py`. Installed libraries are told by
their versions.

A process keeps what it has imported, whatever becomes of the files. So each source counts as it was when this module
was imported, or when it was first asked for: one that was changed since has a digest that no other process has.
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
"""Names of sources that a Python source of the same name compiles end so."""

_INSTALLED = {str(Path(sysconfig.get_path(name)).resolve()) for name in ("stdlib", "purelib", "platlib")}
_TYPES_ALONE = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+\S.*\n|\n)+", re.M)
"""What is imported for the types and never run."""

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
"""Each source's stamp when it was first seen."""


def digest(sources: Iterable[str | Path]) -> str:
    """SHA-256, in hexadecimal digits, of all that the sources depend on."""
    told = hashlib.sha256()
    for name, path in _reached_by(frozenset(os.path.abspath(source) for source in sources)):
        told.update(f"{name}\0".encode() + _content(path))
    return told.hexdigest()


@cache
def _reached_by(sources: frozenset[str]) -> list[tuple[str, str]]:
    """All that sources at absolute paths depend on, by name: a sweep asks the same for each of its runs."""
    paths = {path for source in sources for path in reached(str(Path(source).resolve()))}
    return sorted((_name(path), path) for path in paths)


@cache
def reached(source: str) -> frozenset[str]:
    """The paths of all sources that the one at an absolute path depends on, itself among them."""
    found, todo = {source}, [source]
    while todo:
        new = _imported(todo.pop()) - found
        found |= new
        todo += new
    return frozenset(found)


def everything(package: str) -> str:
    """SHA-256, in hexadecimal digits, of all sources of one of PACKAGES, whatever imports them."""
    start, told = f"{ROOT / package}{os.sep}", hashlib.sha256()
    for path in sorted(path for path in _FIRST if path.startswith(start)):
        told.update(f"{_name(path)}\0".encode() + _content(path))
    return told.hexdigest()


@cache
def of_class(made: type) -> frozenset[Path]:
    """The files that a class is written in, wherever they lie, and those of what it inherits, libraries apart."""
    own = {getattr(sys.modules.get(made.__module__), "__file__", None)}
    for base in made.__mro__:
        # A module that was loaded by hand may be known by its functions alone.
        codes = (getattr(value, "__code__", None) for value in vars(base).values())
        files = {code.co_filename for code in codes if code}
        files.add(getattr(sys.modules.get(base.__module__), "__file__", None))
        own |= {file for file in files if file and not _library(file)}
    return frozenset(Path(file).resolve() for file in own if file and file.endswith(".py") and os.path.isfile(file))


def known(path: str) -> bool:
    """Whether a file is of this project or of an installed library, and not somebody's own."""
    return _own(path) or _library(path) or path.startswith("<")


@cache
def _library(path: str) -> bool:
    return not _own(path) and any(folder in _INSTALLED for folder in map(str, Path(path).resolve().parents))


@cache
def _name(path: str) -> str:
    """The path as it is in every checkout."""
    return os.path.relpath(path, ROOT) if _own(path) else os.path.basename(path)


def _own(path: str) -> bool:
    return path.startswith(_STARTS)


def _content(path: str) -> bytes:
    """What a source holds, as a digest; one that only this process has where it was changed since it was first seen."""
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
    """The paths of the sources that a source imports or compiles, and of the packages that they lie in."""
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
    """Each imported name, in front of it the module that it comes from, "" where it is itself a module."""
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
    """Whether there is a source, or was one of ours when this module was imported."""
    return path in _FIRST or (not _own(path) and os.path.isfile(path))


@cache
def _home(source: str) -> tuple[str, list[str]]:
    """The folder that imports of a source start from, and the packages on the way to it."""
    folder, packages = os.path.dirname(source), list[str]()
    while os.path.isfile(os.path.join(folder, "__init__.py")):
        folder, package = os.path.split(folder)
        packages.insert(0, package)
    return folder, packages

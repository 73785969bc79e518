"""Resolution of names in a config to code: built-in, of an installed package, or named by the config.

    hybrid                        built-in: an entry of one of our tables
    my-method                     installed: an entry point of the table's group, such as `springbench.solvers`
    my_package.module:MyMethod    named: in a module that Python finds
    ./mine.py:MyMethod            named: in a file in the config's folder, or in a folder below it

The last three are imported by `load` only. Until then such a name is a `Plugin`, which states the module
and its version: that of the installed distribution, and 12 hexadecimal digits of a digest of the sources.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, entry_points, packages_distributions, version
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

from solvers import beside, sources

PATTERN = r"^(\./[^:]+\.py|[A-Za-z_][\w.]*):[A-Za-z_]\w*$"
"""The pattern of names by which a config refers to code."""


class Refused(ValueError):
    """An error for a name without code, or with code that a config must not name."""


class Plugin(str):
    """A name in a config that refers to third-party code.

    Attributes:
        target: "module:name", or "path.py:name" with an absolute path.
        module: the module, for display.
        version: version of the code.
        source: source file.
    """

    target: str
    module: str
    version: str
    source: str

    def __new__(cls, name: str, target: str = "", module: str = "", version: str = "", source: str = "") -> Plugin:
        made = super().__new__(cls, name)
        made.target, made.module, made.version, made.source = target, module, version, source
        return made

    def identity(self) -> list[str]:
        """Return what distinguishes this code from other code of the same name."""
        return [str(self), self.module, self.version]


class Table(Mapping[str, Any]):
    """A mapping from names to import targets: built-in ones, installed ones, and every `Plugin`."""

    def __init__(self, group: str, *shipped: Mapping[str, Any]) -> None:
        """Create a table from an entry-point group and tables of "module:name" or of the objects themselves."""
        self._group, self.shipped = group, shipped

    def __getitem__(self, name: str) -> Any:
        if isinstance(name, Plugin):
            return name.target
        for table in self.shipped:
            if name in table:
                return table[name]
        return self._installed()[name].value

    def __contains__(self, name: object) -> bool:
        return isinstance(name, Plugin) or any(name in table for table in self.shipped) or name in self._installed()

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys(chain(*self.shipped, self._installed())))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def named(self, name: str, folder: Path) -> str:
        """Return the name, as a Plugin if it is not built-in; an unknown name is returned unchanged.

        Imports nothing.

        Args:
            name: the name in the config.
            folder: the folder of the config.

        Raises:
            Refused: the name refers to no code, or to code that a config must not name.
        """
        if any(name in table for table in self.shipped):
            return name
        if ":" in name:
            return _written(name, folder)
        found = self._installed().get(name)
        if found is None:
            return name
        return _of_module(name, found.value, found.dist.version if found.dist else "")

    def _installed(self) -> dict[str, EntryPoint]:
        return {entry.name: entry for entry in entry_points(group=self._group)}


def load(target: str) -> Any:
    """Import the module, or run the file, of "module:name" or "path.py:name" and return the named object."""
    place, _, name = target.rpartition(":")
    module = beside.module(Path(place)) if place.endswith(".py") else import_module(place)
    return getattr(module, name)


def identity(name: str) -> str | list[str]:
    """Return what distinguishes the code of a name from other code; a built-in is identified by its name."""
    return name.identity() if isinstance(name, Plugin) else name


def found(names: Iterable[str]) -> list[Plugin]:
    """Return the names that refer to third-party code."""
    return [name for name in names if isinstance(name, Plugin)]


def _written(name: str, folder: Path) -> Plugin:
    place, _, attribute = name.rpartition(":")
    if not attribute.isidentifier():
        raise Refused(f"came {name!r}; wanted `module:Name`, or `./file.py:Name` for a file beside the config")
    if not place.endswith(".py") and "/" not in place:
        if not all(part.isidentifier() for part in place.split(".")):
            raise Refused(f"came {name!r}; wanted the name of a module in front of the colon")
        return _of_module(name, name, None)
    if not place.startswith("./"):
        raise Refused(f"came {name!r}; a file is named from the config's folder on: ./file.py:{attribute}")
    home = folder.resolve()
    path = Path(os.path.normpath(home / place))
    if not path.is_relative_to(home) or path.resolve() != path:
        raise Refused(f"{place} leaves the config's folder, itself or by a link; copy the file beside the config")
    if not path.is_file() or path.suffix != ".py":
        raise Refused(f"there is no file {place} of Python beside the config")
    return Plugin(name, f"{path}:{attribute}", place, sources.digest([path])[:12], str(path))


def _of_module(name: str, target: str, distribution: str | None) -> Plugin:
    """Build the Plugin of a module; `distribution` is looked up if it is None."""
    module = target.partition(":")[0]
    source = source_of(module)
    if source is None:
        raise Refused(f"{name!r} names the module {module}, which Python does not find; install it beside springbench")
    if distribution is None:
        owners = packages_distributions().get(module.partition(".")[0], [])
        distribution = version(owners[0]) if owners else ""
    code = sources.digest([source])[:12] if source.endswith(".py") else ""
    return Plugin(name, target, module, "+".join(filter(None, (distribution, code))), source)


def source_of(module: str) -> str | None:
    """Return the file of a module without importing its parents; None if there is none."""
    first, *rest = module.split(".")
    try:
        spec = find_spec(first)
    except ValueError:  # a module that was started as a script has none
        return None
    for k in range(len(rest)):
        inside = spec.submodule_search_locations if spec else None
        spec = PathFinder.find_spec(".".join([first, *rest[: k + 1]]), inside) if inside else None
    return spec.origin if spec else None

"""Whose code a name leads to: what is shipped, what an installed package brings, what a config names.

    hybrid                        shipped: it stands in one of our tables
    my-method                     installed: an entry point of the table's group, such as `springbench.solvers`
    my_package.module:MyMethod    named: in a module that Python finds
    ./mine.py:MyMethod            named: in a file beside the config, or in a folder below it

Of the last three nothing is imported until `load`. Until then a name is a `Plugin`, which knows the module and its
version: that of the installed distribution, and 12 hexadecimal digits over the sources.
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
"""How a config names code."""


class Refused(ValueError):
    """A name that leads to no code, or to code that a config must not name."""


class Plugin(str):
    """A name as a config writes it, that leads to somebody's own code.

    target: "module:name", or "path.py:name" with an absolute path; module: for people; version: of its code;
    source: its file.
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
        """What tells this code from other code of the name."""
        return [str(self), self.module, self.version]


class Table(Mapping[str, Any]):
    """Names and what they lead to: shipped ones, those of installed packages, and every `Plugin`."""

    def __init__(self, group: str, *shipped: Mapping[str, Any]) -> None:
        """group: of entry points; shipped: tables of "module:name", or of the things themselves."""
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
        """The name, as a Plugin where it is not shipped; one that is not known as it is. folder: of the config.

        Imports nothing. Raises Refused.
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
    """What "module:name" or "path.py:name" names; the module is imported, or the file run, now and no sooner."""
    place, _, name = target.rpartition(":")
    module = beside.module(Path(place)) if place.endswith(".py") else import_module(place)
    return getattr(module, name)


def identity(name: str) -> str | list[str]:
    """What tells the code of a name from other code of that name: a shipped one is told by its name."""
    return name.identity() if isinstance(name, Plugin) else name


def found(names: Iterable[str]) -> list[Plugin]:
    """Those of the names that lead to somebody's own code."""
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
    """distribution: its version; None to look for it."""
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
    """The file of a module, found without importing what it lies in; None where there is none."""
    first, *rest = module.split(".")
    try:
        spec = find_spec(first)
    except ValueError:  # a module that was started as a script has none
        return None
    for k in range(len(rest)):
        inside = spec.submodule_search_locations if spec else None
        spec = PathFinder.find_spec(".".join([first, *rest[: k + 1]]), inside) if inside else None
    return spec.origin if spec else None

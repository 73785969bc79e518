"""Resolution of names in a config to code: built-in, installed, or named by the config.

    hybrid                        built-in: an entry of a built-in table
    my-method                     installed: an entry point of the table's group, such as `springbench.solvers`
    my_package.module:MyMethod    named: in a module that Python finds
    ./mine.py:MyMethod            named: in a file in the config's folder, or in a folder below it

The last three are imported by `load_target` only. Until then such a name is a `PluginName`, which states the module
and its version: that of the installed distribution, and 12 hexadecimal digits of a digest of the sources.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, entry_points, packages_distributions, version
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

from springbench.solvers.jit import source_digest
from springbench.solvers.plugins import file_modules

PLUGIN_PATTERN = r"^(\./[^:]+\.py|[A-Za-z_][\w.]*):[A-Za-z_]\w*$"
"""The pattern of names by which a config refers to code."""


class InvalidPluginName(ValueError):
    """An error for a name without code, or with code that configs must not name."""


class PluginName(str):
    """A name in a config that refers to third-party code.

    Attributes:
        import_target: "module:name", or "path.py:name" with an absolute path.
        module_name: the module, for display.
        code_version: version of the code.
        source_path: source file.
    """

    import_target: str
    module_name: str
    code_version: str
    source_path: str

    def __new__(
        cls, name: str, import_target: str = "", module_name: str = "", code_version: str = "", source_path: str = ""
    ) -> PluginName:
        made = super().__new__(cls, name)
        made.import_target, made.module_name, made.code_version, made.source_path = (
            import_target,
            module_name,
            code_version,
            source_path,
        )
        return made

    def identify_code(self) -> list[str]:
        """Return what distinguishes this code from other code of the same name."""
        return [str(self), self.module_name, self.code_version]


class PluginTable(Mapping[str, Any]):
    """A mapping from names to import targets: built-in ones, installed ones, and every `PluginName`."""

    def __init__(self, entry_point_group: str, *builtin_tables: Mapping[str, Any]) -> None:
        """Create a table from an entry-point group and built-in tables.

        Args:
            entry_point_group: group of installed entry points, such as `springbench.solvers`.
            *builtin_tables: mappings from names to "module:name", or to the objects themselves; the first table that
                contains a name is used.
        """
        self._entry_point_group, self.builtin_tables = entry_point_group, builtin_tables

    def __getitem__(self, name: str) -> Any:
        if isinstance(name, PluginName):
            return name.import_target
        for table in self.builtin_tables:
            if name in table:
                return table[name]
        return self._installed_entry_points()[name].value

    def __contains__(self, name: object) -> bool:
        return (
            isinstance(name, PluginName)
            or any(name in table for table in self.builtin_tables)
            or name in self._installed_entry_points()
        )

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys(chain(*self.builtin_tables, self._installed_entry_points())))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def resolve_name(self, name: str, folder: Path) -> str:
        """Return the name, as a PluginName if it is not built-in.

        An unknown name is returned unchanged. Nothing is imported.

        Args:
            name: the name in the config.
            folder: the folder of the config.

        Raises:
            InvalidPluginName: the name refers to no code, or to code that a config must not name.
        """
        if any(name in table for table in self.builtin_tables):
            return name
        if ":" in name:
            return _parse_plugin_name(name, folder)
        found = self._installed_entry_points().get(name)
        if found is None:
            return name
        return _plugin_of_module(name, found.value, found.dist.version if found.dist else "")

    def _installed_entry_points(self) -> dict[str, EntryPoint]:
        return {
            entry.name: entry for entry in _find_entry_points(tuple(sys.path)).select(group=self._entry_point_group)
        }


@cache
def _find_entry_points(search_path: tuple[str, ...]) -> Any:
    """Return the entry points of all distributions; reading them takes 30 ms or more."""
    return entry_points()


def list_entry_points() -> list[tuple[str, str, str]]:
    """Return group, name and target of all installed entry points of this project's groups, sorted."""
    groups = _find_entry_points(tuple(sys.path))
    ours = (
        entry for group in groups.groups if group.startswith("springbench.") for entry in groups.select(group=group)
    )
    return sorted((entry.group, entry.name, entry.value) for entry in ours)


def load_target(target: str) -> Any:
    """Import the object that "module:name" or "path.py:name" names; a file is executed."""
    place, _, name = target.rpartition(":")
    module = file_modules.load_file_module(Path(place)) if place.endswith(".py") else import_module(place)
    return getattr(module, name)


def identify_code(name: str) -> str | list[str]:
    """Return what distinguishes the code of a name from other code.

    A built-in is identified by its name.
    """
    return name.identify_code() if isinstance(name, PluginName) else name


def identify_plugins(plugins: Iterable[PluginName]) -> frozenset[tuple[str, ...]]:
    """Return the identities of third-party code."""
    return frozenset(tuple(plugin.identify_code()) for plugin in plugins)


def select_plugins(names: Iterable[str]) -> list[PluginName]:
    """Return the names that refer to third-party code."""
    return [name for name in names if isinstance(name, PluginName)]


def _parse_plugin_name(name: str, folder: Path) -> PluginName:
    place, _, attribute = name.rpartition(":")
    if not attribute.isidentifier():
        raise InvalidPluginName(
            f"got {name!r}; expected `module:Name`, or `./file.py:Name` for a file next to the config"
        )
    if not place.endswith(".py") and "/" not in place:
        if not all(part.isidentifier() for part in place.split(".")):
            raise InvalidPluginName(f"got {name!r}; expected the name of a module in front of the colon")
        return _plugin_of_module(name, name, None)
    if not place.startswith("./"):
        raise InvalidPluginName(f"got {name!r}; a file is named from the config's folder on: ./file.py:{attribute}")
    home = folder.resolve()
    path = Path(os.path.normpath(home / place))
    if not path.is_relative_to(home) or path.resolve() != path:
        raise InvalidPluginName(
            f"{place} leaves the config's folder, itself or by a link; copy the file next to the config"
        )
    if not path.is_file() or path.suffix != ".py":
        raise InvalidPluginName(f"there is no file {place} of Python next to the config")
    return PluginName(name, f"{path}:{attribute}", place, source_digest.digest_sources([path])[:12], str(path))


def _plugin_of_module(name: str, target: str, distribution_version: str | None) -> PluginName:
    """Build the PluginName of a module; `distribution_version` is looked up if it is None."""
    module = target.partition(":")[0]
    source = find_module_source(module)
    if source is None:
        raise InvalidPluginName(
            f"{name!r} names the module {module}, which Python does not find; install it next to springbench"
        )
    if distribution_version is None:
        owners = packages_distributions().get(module.partition(".")[0], [])
        distribution_version = version(owners[0]) if owners else ""
    code = source_digest.digest_sources([source])[:12] if source.endswith(".py") else ""
    return PluginName(name, target, module, "+".join(filter(None, (distribution_version, code))), source)


def find_module_source(module: str) -> str | None:
    """Return the file of a module without importing its parents; None if there is none."""
    first, *rest = module.split(".")
    try:
        spec = find_spec(first)
    except ValueError:  # a module that was started as a script has no spec
        return None
    for k in range(len(rest)):
        inside = spec.submodule_search_locations if spec else None
        spec = PathFinder.find_spec(".".join([first, *rest[: k + 1]]), inside) if inside else None
    return spec.origin if spec else None

"""Import hook for Python files next to a config.

The module `<this module>.m<path in hexadecimal>` is the file at that path. Definitions in such a file have a
module that every process can import, so they can be pickled between processes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

__path__: list[str] = []
_MODULE_PREFIX = f"{__name__}.m"
_LOADED_CONTENT: dict[str, bytes] = {}


class _FileModuleFinder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not fullname.startswith(_MODULE_PREFIX):
            return None
        return spec_from_file_location(fullname, bytes.fromhex(fullname.removeprefix(_MODULE_PREFIX)).decode())


sys.meta_path.append(_FileModuleFinder())


def load_file_module(path: Path) -> ModuleType:
    """Return the module in a file.

    The file is executed again if its content has changed since the last call.
    """
    name, content = f"{_MODULE_PREFIX}{str(path).encode().hex()}", path.read_bytes()
    if _LOADED_CONTENT.get(name, content) != content:
        sys.modules.pop(name, None)
    _LOADED_CONTENT[name] = content
    return import_module(name)


def is_file_module(name: str) -> bool:
    """Return whether a module's name is that of a file next to a config."""
    return name.startswith(_MODULE_PREFIX)

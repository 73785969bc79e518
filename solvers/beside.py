"""Files of Python beside a config as modules: `solvers.beside.m<the path, in hexadecimal>` is the file at that path.

So what is defined there has a module that every process can import, and travels between processes like anything else.
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
_PREFIX = f"{__name__}.m"
_READ: dict[str, bytes] = {}


class _Files(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not fullname.startswith(_PREFIX):
            return None
        return spec_from_file_location(fullname, bytes.fromhex(fullname.removeprefix(_PREFIX)).decode())


sys.meta_path.append(_Files())


def module(path: Path) -> ModuleType:
    """The module in a file, which is run, again where the file is another one than when it was last."""
    name, content = f"{_PREFIX}{str(path).encode().hex()}", path.read_bytes()
    if _READ.get(name, content) != content:
        sys.modules.pop(name, None)
    _READ[name] = content
    return import_module(name)

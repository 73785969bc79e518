"""Compiled kernels on disk, by all that they depend on.

Numba's own cache knows the file that a kernel stands in, and neither the kernels in other files that it calls, nor the
constants from there, nor the options that it was compiled with; two processes that compile for one index may also leave
one's code under the other's signature. So a kernel is kept here by the digest of all sources that its module imports
(`solvers.sources`), with its options and signature, the processor and the versions in the key, one file a signature.
What is found is what would be compiled, whoever imports it and in whatever order.

    <folder>/<module>-<digest>/<kernel>-<digest of the key>.nbc

The folder is `NUMBA_CACHE_DIR` where that is set, else `__pycache__` beside the source, else the user's own.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

from solvers import sources
from solvers.linking import rebuilt

_UNUSED = 3600.0
"""Seconds for which no process has looked into a folder of other sources before it goes; what a process that still runs
then compiles is kept anew."""

_SETTINGS = ("OPT", "BOUNDSCHECK", "LOOP_VECTORIZE", "SLP_VECTORIZE", "DEBUGINFO_DEFAULT", "ENABLE_AVX")
"""Of Numba's environment, what alters the code."""


_CONFIG: Any = config
"""Its names come from the environment."""

_CACHE: Any = _Cache
"""Its signatures tell what its subclasses do not do."""


class KernelCache(_CACHE):
    """What one kernel was compiled to, by signature."""

    def __init__(self, function: Any, options: Mapping[str, Any]) -> None:
        """function: of Python; options: of its compilation."""
        self._source = function.__code__.co_filename
        self._module, self._name = function.__module__, function.__qualname__
        cells = tuple(_told(cell.cell_contents) for cell in function.__closure__ or ())
        chosen = sorted((key, sorted(v) if isinstance(v, (set, frozenset)) else v) for key, v in options.items())
        self._fixed = (
            repr(chosen),
            hashlib.sha256(function.__code__.co_code).digest(),
            hashlib.sha256(dumps(cells)).digest() if cells else b"",
            (sys.version, numba.__version__, llvmlite.__version__, np.__version__),
            tuple(str(getattr(_CONFIG, name, "")) for name in _SETTINGS),
        )

    @property
    def cache_path(self) -> str:
        """The folder for the code that today's sources compile to."""
        return str(_folder(_home(os.path.dirname(self._source)), self._module, sources.digest([self._source])))

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """What is kept for a signature, None for nothing."""
        target_context.refresh()
        key = (sig, target_context.codegen().magic_tuple(), self._fixed)
        path = self._path(key)
        try:
            there, kept = pickle.loads(path.read_bytes())
        except Exception:  # nothing is there, or what is there cannot be read: it is compiled and written anew
            return None
        with suppress(OSError):
            os.utime(path.parent)
        return rebuilt(target_context, kept) if there == key else None

    def save_overload(self, sig: Any, data: CompileResult) -> None:
        """Keep what was compiled for a signature, where it can be kept and there is room."""
        if data.library.has_dynamic_globals or not all(lifted.can_cache for lifted in data.lifted):
            return
        for env in data._find_referenced_environments():  # of what it links in
            data.library.codegen.set_env(env.env_name, env)
        key = (sig, data.target_context.codegen().magic_tuple(), self._fixed)
        path = self._path(key)
        with suppress(OSError):
            if not path.parent.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                _clear(path.parent, self._module)
            _write(path, dumps((key, data._reduce())))

    def enable(self) -> None:
        """It always is."""

    def disable(self) -> None:
        """Nothing asks for that."""

    def flush(self) -> None:
        """Forget what is kept; `recompile` of a kernel asks for that."""
        shutil.rmtree(self.cache_path, ignore_errors=True)

    def _path(self, key: Any) -> Path:
        name = self._name.replace("<", "").replace(">", "")
        return Path(self.cache_path) / f"{name}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"


def _told(value: Any) -> Any:
    """What a kernel closes over: other kernels by their names and all that they depend on, what they close over too."""
    function = getattr(value, "py_func", None)
    if function is None:
        return value
    cells = (_told(cell.cell_contents) for cell in function.__closure__ or ())
    return function.__module__, function.__qualname__, sources.digest([function.__code__.co_filename]), *cells


def _folder(home: Path, module: str, digest: str) -> Path:
    return home / f"{module}-{digest[:16]}"


@cache
def _home(source: str) -> Path:
    """The first folder that can be written to; source: the folder of the source."""
    users = Path(AppDirs("springbench", appauthor=False).user_cache_dir)
    for folder in (Path(_CONFIG.CACHE_DIR or os.path.join(source, "__pycache__")), users):
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            return folder
    return users


def _clear(made: Path, module: str) -> None:
    """Remove what other sources of a module compiled to, where no process has used it of late."""
    for other in made.parent.glob(f"{module}-*"):
        with suppress(OSError):
            if made.stat().st_mtime - other.stat().st_mtime > _UNUSED:
                shutil.rmtree(other, ignore_errors=True)


def _write(path: Path, content: bytes) -> None:
    """All of the content or nothing."""
    number, partial = tempfile.mkstemp(dir=path.parent, prefix=".")
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
        os.replace(partial, path)
    except OSError:
        os.unlink(partial)
        raise

"""On-disk cache of compiled kernels, keyed by everything that they depend on.

Numba's own cache considers the kernel's file only. It ignores kernels in other files that the kernel calls, constants
from there, and the compile options. Two processes that compile for one index may also leave the code of one under the
signature of the other. So a kernel is cached here by the digest of all sources that its module imports
(`springbench.solvers.jit.source_digest`). The key also has the options, the signature, the processor and the versions;
each signature has its own file. A cache entry is therefore what a compilation would produce, whichever module imports
the kernel and in whatever order.

    <folder>/<module>-<digest>/<kernel>-<digest of the key>.nbc

The folder is `NUMBA_CACHE_DIR` if that is set, else `kernels` in the user's cache folder, which serves all checkouts,
else `__pycache__` next to the source. Processes that need the same code at the same time compile it once: the others
wait.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Event
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.misc.appdirs import AppDirs
from springbench.solvers.jit import source_digest
from springbench.solvers.jit.inline_linking import rebuild_result
from springbench.solvers.platform_calls import try_lock_byte

_STALE_SECONDS = 7 * 86400.0
"""Age [s] of the last use after which the cache folder of other sources is removed; a process that still runs with such
sources compiles and stores its kernels again."""

_LOCK_POLL_SECONDS = 0.02
_MAX_LOCK_POLLS = 3000
"""Polls of a lock, after which a process compiles by itself: the other one may be stopped."""

_CODEGEN_SETTINGS = ("OPT", "BOUNDSCHECK", "LOOP_VECTORIZE", "SLP_VECTORIZE", "DEBUGINFO_DEFAULT", "ENABLE_AVX")
"""Settings in Numba's environment that change the generated code."""


_NUMBA_CONFIG: Any = config
"""Untyped, because the names are defined from the environment."""

_NUMBA_CACHE: Any = _Cache
"""Untyped, because the declared signatures differ from those of its subclasses."""


class KernelCache(_NUMBA_CACHE):
    """The compiled code of one kernel, by signature."""

    def __init__(self, function: Any, options: Mapping[str, Any]) -> None:
        """Create the cache of a kernel.

        Args:
            function: Python function of the kernel; its code and closure are part of the key.
            options: compile options, also part of the key.
        """
        self._source_file = function.__code__.co_filename
        self._module_name, self._kernel_name = function.__module__, function.__qualname__
        cells = tuple(_closure_key(cell.cell_contents) for cell in function.__closure__ or ())
        chosen = sorted((key, sorted(v) if isinstance(v, (set, frozenset)) else v) for key, v in options.items())
        self._fixed_key = (
            repr(chosen),
            hashlib.sha256(function.__code__.co_code).digest(),
            hashlib.sha256(dumps(cells)).digest() if cells else b"",
            (sys.version, numba.__version__, llvmlite.__version__, np.__version__),
            tuple(str(getattr(_NUMBA_CONFIG, name, "")) for name in _CODEGEN_SETTINGS),
        )

    @property
    def cache_path(self) -> str:
        """Folder of the code compiled from the current sources."""
        return str(
            _cache_folder(
                _writable_root(os.path.dirname(self._source_file)),
                self._module_name,
                source_digest.digest_sources([self._source_file]),
            )
        )

    @property
    def is_writable(self) -> bool:
        """Whether code can be stored."""
        return os.access(_writable_root(os.path.dirname(self._source_file)), os.W_OK)

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """Return the cached code of a signature, or None if there is none.

        Args:
            sig: argument types, or a signature with the return type.
            target_context: Numba's context of the processor.
        """
        rtsys.initialize(target_context)  # Numba refreshes the whole context, in 0.4 s; only compilation needs that
        key = self._entry_key(sig, target_context)
        path = self._entry_path(key)
        try:
            there, compiled = pickle.loads(path.read_bytes())
        except Exception:  # absent or unreadable: the code is compiled and written again
            return None
        with suppress(OSError):
            os.utime(path.parent)
        return rebuild_result(target_context, compiled) if there == key else None

    def compile_once(self, sig: Any, target_context: Any, compile_code: Callable[[], CompileResult]) -> CompileResult:
        """Return the code of a signature, compiled by one process and loaded by the others.

        A process waits while another one compiles the same code.

        Args:
            sig: argument types, or a signature with the return type.
            target_context: Numba's context of the processor, into which loaded code is inserted.
            compile_code: compiles the code; called if none is cached.
        """
        path = self._entry_path(self._entry_key(sig, target_context))
        with suppress(OSError):
            if not path.parent.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                _remove_stale(path.parent, self._module_name)
        with _lock_entry(path):
            if (loaded := self.load_overload(sig, target_context)) is not None:
                target_context.insert_user_function(loaded.entry_point, loaded.fndesc, [loaded.library])
                return loaded
            compiled = compile_code()
            self._store_code(sig, compiled)
            return compiled

    def measure_code(self, sig: Any, target_context: Any) -> int:
        """Return the size of the cached code of a signature [bytes].

        Args:
            sig: argument types, or a signature with the return type.
            target_context: Numba's context of the processor.

        Returns:
            The size, or 0 if there is no code.
        """
        try:
            return self._entry_path(self._entry_key(sig, target_context)).stat().st_size
        except OSError:
            return 0

    def save_overload(self, sig: Any, data: CompileResult) -> None:
        """Do nothing: `compile_once` has stored the code.

        Args:
            sig: argument types of the code.
            data: compiled code.
        """

    def _store_code(self, sig: Any, data: CompileResult) -> None:
        """Store the code of a signature, if it is cacheable and the disk has space."""
        if data.library.has_dynamic_globals or not all(lifted.can_cache for lifted in data.lifted):
            return
        for env in data._find_referenced_environments():  # those of the functions it links, too
            data.library.codegen.set_env(env.env_name, env)
        key = self._entry_key(sig, data.target_context)
        with suppress(OSError):
            _write_atomically(self._entry_path(key), dumps((key, data._reduce())))

    def enable(self) -> None:
        """Do nothing: the cache is always enabled."""

    def disable(self) -> None:
        """Do nothing: the cache cannot be disabled."""

    def flush(self) -> None:
        """Remove the cached code; `recompile` of a kernel calls this."""
        shutil.rmtree(self.cache_path, ignore_errors=True)

    def _entry_key(self, sig: Any, target_context: Any) -> Any:
        return (normalize_signature(sig), target_context.codegen().magic_tuple(), self._fixed_key)

    def _entry_path(self, key: Any) -> Path:
        name = self._kernel_name.replace("<", "").replace(">", "")
        return Path(self.cache_path) / f"{name}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"


def _closure_key(value: Any) -> Any:
    """Return the cache key of a closed-over value.

    That of a kernel consists of its names, its sources and its closure.
    """
    function = getattr(value, "py_func", None)
    if function is None:
        return value
    cells = (_closure_key(cell.cell_contents) for cell in function.__closure__ or ())
    return (
        function.__module__,
        function.__qualname__,
        source_digest.digest_sources([function.__code__.co_filename]),
        *cells,
    )


def _cache_folder(home: Path, module: str, digest: str) -> Path:
    return home / f"{module}-{digest[:16]}"


@cache
def _writable_root(source: str) -> Path:
    """Return the first writable cache folder; `source` is the folder of the source file."""
    users = Path(AppDirs("springbench", appauthor=False).user_cache_dir) / "kernels"
    local = Path(source) / "__pycache__"
    for folder in (Path(_NUMBA_CONFIG.CACHE_DIR or users), local):
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            return folder
    return local


def _remove_stale(made: Path, module: str) -> None:
    """Remove the code of other sources of a module unless it was used recently."""
    for other in made.parent.glob(f"{module}-*"):
        with suppress(OSError):
            if made.stat().st_mtime - other.stat().st_mtime > _STALE_SECONDS:
                shutil.rmtree(other, ignore_errors=True)


@contextmanager
def _lock_entry(path: Path) -> Generator[None]:
    """Lock an entry inside the block, after waiting at most a minute for other processes.

    A kernel is locked while those that it calls are compiled. Kernels do not call each other in a circle, so no two
    processes wait for each other.
    """
    lock_path = path.with_name(f".{path.name}.lock")
    try:
        lock = os.open(lock_path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError:  # nothing can be stored either
        yield
        return
    try:
        for _ in range(_MAX_LOCK_POLLS):
            if try_lock_byte(lock, 0):
                break
            Event().wait(_LOCK_POLL_SECONDS)
        yield
    finally:
        with suppress(OSError):
            lock_path.unlink()  # a process that waits for the lock looks for the code first
        os.close(lock)


def _write_atomically(path: Path, content: bytes) -> None:
    """Write the whole content or nothing."""
    number, partial = tempfile.mkstemp(dir=path.parent, prefix=".")
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
        os.replace(partial, path)
    except OSError:
        os.unlink(partial)
        raise

"""Local-global steps in C++: compiled on demand, cached in the user's cache folder, called by ctypes.

A source has `prepare`, `local`, `global_` and `release`, see `solvers/methods/local_global/eigen.cpp`. If it does not
compile, its solver raises an error with the reason. Springs of length zero, for which the formula defines no direction,
get none.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import weakref
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.sparse import csr_array

from solvers import matrices
from solvers.core.prefactored import PreparedLocalGlobal
from solvers.energies.springs import Springs
from solvers.problem import NotPositiveDefinite, Positions, System, Unsupported

HEADERS = Path(__file__).parent.parent / "methods"
FLAGS = ("-O3", "-march=native", "-DNDEBUG", "-std=c++17")
SYSTEM = ("/usr/include/eigen3", "/usr/include/suitesparse")
"""Header folders of Debian's libraries; those in the compiler's own search path (CPATH) are used as well."""

LIBRARY = ("-shared", "-fPIC")


def compile_cpp(
    source: Path, folder: Path, needs: str, options: Sequence[str] = (), libraries: Sequence[str] = ()
) -> Path:
    """Return the program or library compiled in `folder`; recompile it after a change of the sources or headers.

    Args:
        source: C++ source.
        folder: folder of the result.
        needs: requirements, in words, for the error message.
        options: further compiler options.
        libraries: linker arguments.

    Raises:
        Unsupported: there is no compiler, or the source does not compile.
    """
    compiler = next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), "c++", "g++", "clang++"))), None)
    if compiler is None:
        raise Unsupported("there is no C++ compiler (c++, g++, clang++, or CXX)")
    included = ["-I", str(HEADERS), *(part for path in SYSTEM for part in ("-isystem", path))]
    command = [compiler, *FLAGS, *options, *included, str(source), *libraries]
    content = b"".join(path.read_bytes() for path in (source, *sorted(HEADERS.glob("*.hpp"))))
    name = hashlib.sha256(" ".join([compiler, *FLAGS, *options, *libraries]).encode() + content).hexdigest()[:12]
    made = folder.resolve() / f"{source.stem}-{name}"
    if not made.exists():
        folder.mkdir(parents=True, exist_ok=True)
        partial = made.with_suffix(f".{os.getpid()}.partial")
        told = subprocess.run([*command, "-o", str(partial)], capture_output=True, text=True)
        if told.returncode:
            first = next((line for line in told.stderr.splitlines() if "error" in line), "no message")
            raise Unsupported(f"{source.name} does not compile: {first.strip()}; it needs {needs}")
        os.replace(partial, made)
    return made


def library(source: Path, needs: str, libraries: Sequence[str] = ()) -> ctypes.CDLL:
    """Compile a source and load the library; raise Unsupported if that fails."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench"
    made = ctypes.CDLL(str(compile_cpp(source, cache, needs, LIBRARY, libraries)))
    made.prepare.restype = ctypes.c_void_p
    return made


class Native:
    """The local step and the factor of one system."""

    nonzeros: int | None = None

    def __init__(self, library: ctypes.CDLL, system: System, springs: Springs) -> None:
        """Prepare a system; raise NotPositiveDefinite if Q has no factor."""
        _, pinned, weight = system.penalty
        self.library, self._n, self._free = library, system.vertices, len(system.free)
        given = [np.ascontiguousarray(part, np.int64) for part in (springs.edges, pinned, system.free)]
        given += [
            np.ascontiguousarray(part, np.float64)
            for part in (springs.stiffness, springs.rest_length, system.inertia, weight)
        ]
        sizes = self._n, len(springs.edges), len(pinned), self._free
        made = library.prepare(*map(ctypes.c_int64, sizes), *map(address, given))
        if not made:
            raise NotPositiveDefinite("there is no factor of Q = A'KA + M/dt^2 + w C'C")
        self.made = ctypes.c_void_p(made)
        weakref.finalize(self, library.release, self.made)

    def project(self, p: Positions, y: Positions, out: Positions) -> None:
        """Write y + A'K d(p) to `out`."""
        self.library.local(self.made, ctypes.c_int64(self._n), *map(address, (p, y, out)))

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`, for the free rows and columns of Q."""
        self.library.global_(self.made, ctypes.c_int64(self._free), address(b), address(out))


def address(array: np.ndarray) -> ctypes.c_void_p:
    """Return the address of a contiguous array."""
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


Made = TypeVar("Made", bound=PreparedLocalGlobal)


def prepared(kind: type[Made], system: System, springs: Springs, native: Native, choice: str) -> Made:
    """Prepare the iteration over compiled steps; the norm and the coupling use our own matrices."""
    norm = _Norm(system, springs)
    coupling = norm.coupling if system.pins.exact.any() else csr_array((len(system.free), 0))
    return kind(system, native.project, native, coupling, norm, norm.trace, {}, choice)


class _Norm:
    """The norm, coupling and trace of Q, computed by our own matrices on demand."""

    def __init__(self, system: System, springs: Springs) -> None:
        self._system, self._springs = system, springs

    def __call__(self, e: Positions) -> float:
        """Return |e|_Q [J^(1/2)]."""
        return matrices.energy_norm(self._Q, e)

    @cached_property
    def _Q(self) -> csr_array:
        return matrices.assemble(self._system, [self._springs])

    @property
    def coupling(self) -> csr_array:
        """Q's free rows and exactly pinned columns."""
        exact = self._system.pins.vertices[self._system.pins.exact]
        return csr_array(csr_array(self._Q[self._system.free])[:, exact])

    @property
    def trace(self) -> float:
        """Trace of the unpinned part of Q [N/m]."""
        diagonal = self._system.inertia.copy()
        np.add.at(diagonal, self._springs.edges, self._springs.stiffness[:, None])
        return float(diagonal[self._system.unpinned].sum())

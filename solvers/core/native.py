"""Local-global steps in C++: compiled on the spot where a compiler is, kept in the user's cache, called by ctypes.

A source has `prepare`, `local`, `global_` and `release`, as `solvers/methods/eigen.cpp` shows. Where it does not
compile its solver refuses with the reason. Springs of length zero, whose direction the formula leaves open, get none.
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
"""Where Debian's libraries have their headers; those that the compiler finds by itself (CPATH) will do as well."""

LIBRARY = ("-shared", "-fPIC")


def compile_cpp(
    source: Path, folder: Path, needs: str, options: Sequence[str] = (), libraries: Sequence[str] = ()
) -> Path:
    """The compiled source in `folder`, made anew when it or the solvers' headers have changed.

    needs: what it takes, in words. Raises Unsupported: why not.
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
    """The compiled source, loaded. Raises Unsupported."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench"
    made = ctypes.CDLL(str(compile_cpp(source, cache, needs, LIBRARY, libraries)))
    made.prepare.restype = ctypes.c_void_p
    return made


class Native:
    """The local step and the factor of one system."""

    nonzeros: int | None = None

    def __init__(self, library: ctypes.CDLL, system: System, springs: Springs) -> None:
        """Raises NotPositiveDefinite."""
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
    """Where an array without gaps is."""
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


Made = TypeVar("Made", bound=PreparedLocalGlobal)


def prepared(kind: type[Made], system: System, springs: Springs, native: Native, choice: str) -> Made:
    """The iteration over compiled steps; what is asked of Q besides is answered by our own matrices."""
    norm = _Norm(system, springs)
    coupling = norm.coupling if system.pins.exact.any() else csr_array((len(system.free), 0))
    return kind(system, native.project, native, coupling, norm, norm.trace, {}, choice)


class _Norm:
    """What is asked of Q besides its factor, by our own matrices, and only when it is asked."""

    def __init__(self, system: System, springs: Springs) -> None:
        self._system, self._springs = system, springs

    def __call__(self, e: Positions) -> float:
        """|e|_Q [J^(1/2)]."""
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
        """Of the unpinned part of Q [N/m]."""
        diagonal = self._system.inertia.copy()
        np.add.at(diagonal, self._springs.edges, self._springs.stiffness[:, None])
        return float(diagonal[self._system.unpinned].sum())

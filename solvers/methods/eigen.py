"""Local-global iterations in C++ with Eigen, as a course's assignment has them written (`eigen.hpp`): the yardstick.

It is compiled on the spot where a C++ compiler and Eigen 3.4 are, and kept in the user's cache; where they are not it
refuses with the reason. Springs of length zero, whose direction the formula leaves open, get none.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array

from solvers import matrices
from solvers.about import LIU_2013, LOCAL_GLOBAL, About
from solvers.core.prefactored import PreparedLocalGlobal, only_springs
from solvers.energies.springs import Springs
from solvers.problem import NotPositiveDefinite, Positions, System, Unsupported

HEADERS = Path(__file__).parent
FLAGS = ("-O3", "-march=native", "-DNDEBUG", "-std=c++17")
EIGEN = "/usr/include/eigen3"
"""Where Debian's libeigen3-dev is; one that the compiler finds by itself (CPATH) will do as well."""

LIBRARY = ("-shared", "-fPIC")


@dataclass(frozen=True)
class EigenLocalGlobal:
    """Eigen's sparse matrices and its SimplicialLLT, for springs."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013)

    def prepare(self, system: System) -> PreparedLocalGlobal:
        """Raises Unsupported for energies other than springs and where nothing can be compiled, NotPositiveDefinite."""
        springs = only_springs(system, "eigen")
        compiled = _Compiled(_library(), system, springs)
        norm = _Norm(system, springs)
        coupling = norm.coupling if system.pins.exact.any() else csr_array((len(system.free), 0))
        facts: dict[str, float] = {}
        return PreparedLocalGlobal(
            system, compiled.project, compiled, coupling, norm, norm.trace, facts, "Eigen's SimplicialLLT"
        )


def compile_cpp(source: Path, folder: Path, options: Sequence[str] = ()) -> Path:
    """The compiled source in `folder`, made anew when it or `eigen.hpp` has changed. Raises Unsupported: why not."""
    compiler = next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), "c++", "g++", "clang++"))), None)
    if compiler is None:
        raise Unsupported("there is no C++ compiler (c++, g++, clang++, or CXX)")
    command = [compiler, *FLAGS, *options, "-I", str(HEADERS), "-isystem", EIGEN, str(source)]
    content = source.read_bytes() + (HEADERS / "eigen.hpp").read_bytes()
    name = hashlib.sha256(" ".join([compiler, *FLAGS, *options]).encode() + content).hexdigest()[:12]
    made = folder.resolve() / f"{source.stem}-{name}"
    if not made.exists():
        folder.mkdir(parents=True, exist_ok=True)
        partial = made.with_suffix(f".{os.getpid()}.partial")
        told = subprocess.run([*command, "-o", str(partial)], capture_output=True, text=True)
        if told.returncode:
            first = next((line for line in told.stderr.splitlines() if "error" in line), "no message")
            wanted = "it needs Eigen 3.4 (Debian: libeigen3-dev) and C++17"
            raise Unsupported(f"the yardstick does not compile: {first.strip()}; {wanted}")
        os.replace(partial, made)
    return made


def _library() -> ctypes.CDLL:
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench"
    library = ctypes.CDLL(str(compile_cpp(HEADERS / "eigen.cpp", cache, LIBRARY)))
    library.prepare.restype = ctypes.c_void_p
    return library


class _Compiled:
    """The local step and the factor of one system."""

    nonzeros: int | None = None

    def __init__(self, library: ctypes.CDLL, system: System, springs: Springs) -> None:
        """Raises NotPositiveDefinite."""
        _, pinned, weight = system.penalty
        self._n, self._free, self._library = system.vertices, len(system.free), library
        given = [np.ascontiguousarray(part, np.int64) for part in (springs.edges, pinned, system.free)]
        given += [
            np.ascontiguousarray(part, np.float64)
            for part in (springs.stiffness, springs.rest_length, system.inertia, weight)
        ]
        sizes = self._n, len(springs.edges), len(pinned), self._free
        made = library.prepare(*map(ctypes.c_int64, sizes), *map(_address, given))
        if not made:
            raise NotPositiveDefinite("Eigen finds no factor of Q = A'KA + M/dt^2 + w C'C")
        self._made = ctypes.c_void_p(made)
        weakref.finalize(self, library.release, self._made)

    def project(self, p: Positions, y: Positions, out: Positions) -> None:
        """Write y + A'K d(p) to `out`."""
        self._library.local(self._made, ctypes.c_int64(self._n), *map(_address, (p, y, out)))

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`, for the free rows and columns of Q."""
        self._library.global_(self._made, ctypes.c_int64(self._free), _address(b), _address(out))


def _address(array: np.ndarray) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


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

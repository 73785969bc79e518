"""Local-global steps in C++, compiled on demand and called by ctypes.

Libraries are cached in the user's cache folder. A source has `prepare`, `local`, `global_` and `release`, see
`eigen_local_global.cpp` in this folder. If it does not compile, its solver raises an error with the reason. A spring of
length zero, for which the formula defines no direction, has the projection d = 0.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import weakref
from collections.abc import Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import TypeVar

import llvmlite.binding
import numpy as np
from scipy.sparse import csr_array
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import NotPositiveDefinite, Positions, System, Unsupported

HEADER_FOLDER = Path(__file__).parent
COMPILER_FLAGS = ("-O3", "-march=native", "-DNDEBUG", "-std=c++17")
SYSTEM_INCLUDE_FOLDERS = ("/usr/include/eigen3", "/usr/include/suitesparse")
"""Header folders of Debian's libraries; those in the compiler's own search path (CPATH) are used as well."""

SHARED_LIBRARY_FLAGS = ("-shared", "-fPIC")


def compile_cpp(
    source: Path, folder: Path, requirements: str, options: Sequence[str] = (), libraries: Sequence[str] = ()
) -> Path:
    """Compile a source into `folder` and return the program or library.

    An earlier result is returned if the source, the headers, the options, the compiler's version and the processor are
    unchanged: machines may share the folder, and `-march=native` code runs on processors of one kind only.

    Args:
        source: C++ source.
        folder: folder of the result.
        requirements: requirements, in words, for the error message.
        options: further compiler options.
        libraries: linker arguments.

    Raises:
        Unsupported: there is no compiler, or the source does not compile.
    """
    compiler = next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), "c++", "g++", "clang++"))), None)
    if compiler is None:
        raise Unsupported("there is no C++ compiler (c++, g++, clang++, or CXX)")
    included = ["-I", str(HEADER_FOLDER), *(part for path in SYSTEM_INCLUDE_FOLDERS for part in ("-isystem", path))]
    command = [compiler, *COMPILER_FLAGS, *options, *included, str(source), *libraries]
    content = b"".join(path.read_bytes() for path in (source, *sorted(HEADER_FOLDER.glob("*.hpp"))))
    key = [compiler, _read_compiler_version(compiler), *_describe_processor(), *COMPILER_FLAGS, *options, *libraries]
    digest = hashlib.sha256(" ".join(key).encode() + content).hexdigest()[:12]
    made = folder.resolve() / f"{source.stem}-{digest}"
    if not made.exists():
        folder.mkdir(parents=True, exist_ok=True)
        partial = made.with_suffix(f".{os.getpid()}.partial")
        completed = subprocess.run([*command, "-o", str(partial)], capture_output=True, text=True)
        if completed.returncode:
            first = next((line for line in completed.stderr.splitlines() if "error" in line), "no message")
            raise Unsupported(f"{source.name} does not compile: {first.strip()}; it needs {requirements}")
        os.replace(partial, made)
    return made


@cache
def _read_compiler_version(compiler: str) -> str:
    return subprocess.run([compiler, "--version"], capture_output=True, text=True).stdout


def _describe_processor() -> tuple[str, str]:
    """Return the processor's kind and instruction sets, on which `-march=native` depends."""
    return llvmlite.binding.get_host_cpu_name(), llvmlite.binding.get_host_cpu_features().flatten()


def load_library(source: Path, requirements: str, libraries: Sequence[str] = ()) -> ctypes.CDLL:
    """Compile a C++ source into the user's cache folder and load the library.

    Args:
        source: C++ source that defines `prepare`, `local`, `global_` and `release`.
        requirements: requirements, in words, for the error message.
        libraries: linker arguments, as "-lcholmod".

    Raises:
        Unsupported: there is no compiler, or the source does not compile.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench"
    made = ctypes.CDLL(str(compile_cpp(source, cache, requirements, SHARED_LIBRARY_FLAGS, libraries)))
    made.prepare.restype = ctypes.c_void_p
    return made


class CppBackend:
    """The local step and the factor of one system."""

    nonzeros: int | None = None

    def __init__(self, library: ctypes.CDLL, system: System, springs: Springs) -> None:
        """Prepare a system.

        Args:
            library: library from `load_library`.
            system: masses, pins and time step.
            springs: all energies of the system, as one.

        Raises:
            NotPositiveDefinite: Q has no factor.
        """
        _, pinned, weight = system.penalty_pins
        self.library, self._num_vertices, self._num_free = library, system.num_vertices, len(system.free_vertices)
        given = [np.ascontiguousarray(part, np.int64) for part in (springs.edges, pinned, system.free_vertices)]
        given += [
            np.ascontiguousarray(part, np.float64)
            for part in (springs.stiffness, springs.rest_length, system.inertia_diagonal, weight)
        ]
        sizes = self._num_vertices, len(springs.edges), len(pinned), self._num_free
        made = library.prepare(*map(ctypes.c_int64, sizes), *map(array_address, given))
        if not made:
            raise NotPositiveDefinite("there is no factor of Q = A'KA + M/dt^2 + w C'C")
        self.handle = ctypes.c_void_p(made)
        weakref.finalize(self, library.release, self.handle)

    def apply_local_step(self, p: Positions, y: Positions, out: Positions) -> None:
        """Write y + A'K d(p) to `out`.

        Args:
            p: positions (n, 3) [m].
            y: constant part of the right-hand side (n, 3) [N].
            out: right-hand side of the global step (n, 3) [N].
        """
        self.library.local(self.handle, ctypes.c_int64(self._num_vertices), *map(array_address, (p, y, out)))

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`, for the free rows and columns of Q.

        Args:
            b: right-hand sides of the free vertices (f, 3).
            out: solution (f, 3).
        """
        self.library.global_(self.handle, ctypes.c_int64(self._num_free), array_address(b), array_address(out))


def array_address(array: np.ndarray) -> ctypes.c_void_p:
    """Return the address of a contiguous array."""
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


PreparedType = TypeVar("PreparedType", bound=PreparedLocalGlobal)


def prepare_cpp_backend(
    kind: type[PreparedType], system: System, springs: Springs, native: CppBackend, choice: str
) -> PreparedType:
    """Prepare the iteration over compiled steps.

    The norm and the coupling use matrices assembled in Python.

    Args:
        kind: class to construct.
        system: the system.
        springs: all energies of the system, as one.
        native: compiled local step and factor of the system.
        choice: description of the linear solver.
    """
    norm = _SystemNorm(system, springs)
    coupling = norm.pin_coupling if system.pins.exact_mask.any() else csr_array((len(system.free_vertices), 0))
    return kind(system, native.apply_local_step, native, coupling, norm, norm.unpinned_trace, {}, choice)


class _SystemNorm:
    """The norm, coupling and trace of Q, computed on demand with matrices assembled in Python."""

    def __init__(self, system: System, springs: Springs) -> None:
        self._system, self._springs = system, springs

    def __call__(self, e: Positions) -> float:
        """Return |e|_Q [J^(1/2)]."""
        return system_matrix_assembly.energy_norm(self._Q, e)

    @cached_property
    def _Q(self) -> csr_array:
        return system_matrix_assembly.assemble_system_matrix(self._system, [self._springs])

    @property
    def pin_coupling(self) -> csr_array:
        """Q's free rows and exactly pinned columns."""
        exact = self._system.pins.vertices[self._system.pins.exact_mask]
        return csr_array(csr_array(self._Q[self._system.free_vertices])[:, exact])

    @property
    def unpinned_trace(self) -> float:
        """Trace of the unpinned part of Q [N/m]."""
        diagonal = self._system.inertia_diagonal.copy()
        np.add.at(diagonal, self._springs.edges, self._springs.stiffness[:, None])
        return float(diagonal[self._system.unpinned_mask].sum())

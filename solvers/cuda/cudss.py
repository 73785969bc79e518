"""NVIDIA's cuDSS as the solver of Q x = b: the yardstick for a fixed Q on a device.

    plan, factorize: once a system;    solve: three right-hand sides, each time, from memory of the device into it

It is called through nvmath-python's `DirectSolver`, which takes CuPy's matrix and columns where they are, and solves
for what is in the columns then. CuPy looks at Numba's arrays through the interface that both have, and copies nothing;
all is in one stream, and nobody waits. Q is handed over as what it is, positive definite, by its lower half.
"""

from __future__ import annotations

import weakref
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from scipy.sparse import csr_array, tril

from solvers.cuda import device, sums
from solvers.cuda.run import Stream
from solvers.cuda.target import cuda
from solvers.problem import NotPositiveDefinite, Unsupported

_PACKAGES = {"nvmath-python": "nvmath-python", "cupy": "cupy-cuda12x"}
"""What is imported, by the distribution that has it."""
_INSTALL = device.INSTALL.format("cuda,cudss")


def installed() -> str:
    """The versions that are. Raises Unsupported with the command that installs them."""
    try:
        return ", ".join(f"{name} {version(package)}" for name, package in _PACKAGES.items())
    except PackageNotFoundError as error:
        raise Unsupported(f"cudss: needs {error.name or error}, which is not installed; {_INSTALL}") from error


class Cudss:
    """A factor on the device, which is freed with this. nonzeros: of the factor."""

    def __init__(self, Q: csr_array, stream: Stream) -> None:
        """Q (f, f). Raises NotPositiveDefinite, and Unsupported where a device or its libraries are missing."""
        self._stream, rows, words = stream, Q.shape[0], installed()
        self.choice = f"Q by cuDSS ({words})"
        half = csr_array(tril(Q, format="csr"))
        half.sort_indices()
        # cuDSS takes columns, which are rows of three times so many numbers.
        self._b, self._x = (stream.empty((3, rows), np.float64) for _ in range(2))
        try:
            library: Any = import_module("nvmath.sparse.advanced")
            cupy, sparse = import_module("cupy"), import_module("cupyx.scipy.sparse")
            self._of = stream.pointer
            self._within: Any = cupy.cuda.ExternalStream(self._of)
            self._out = cupy.asarray(self._x).T
            options = library.DirectSolverOptions(
                sparse_system_type=library.DirectSolverMatrixType.SPD,
                sparse_system_view=library.DirectSolverMatrixViewType.LOWER,
            )
            with self._within:
                parts = (half.data, half.indices.astype(np.int32), half.indptr.astype(np.int32))
                lower = sparse.csr_matrix(tuple(map(cupy.asarray, parts)), shape=half.shape)
                self._solver = library.DirectSolver(lower, cupy.asarray(self._b).T, options=options, stream=self._of)
        except Exception as error:  # without a driver, without a device, without its libraries: each has its own
            why = " ".join(str(error).split()).rstrip(":. ")
            raise Unsupported(f"cudss: cannot begin ({type(error).__name__}: {why}); {_INSTALL}") from error
        weakref.finalize(self, self._solver.free)
        self._solver.plan(stream=self._of)
        found = self._solver.factorize(stream=self._of)
        if found.info:
            raise NotPositiveDefinite(f"cudss: Q = A'KA + M/dt^2 + w C'C has no factor: it tells of row {found.info}")
        self.nonzeros = int(found.lu_nnz)

    @property
    def moves(self) -> float:
        """The bytes that a solve must move at least, beside what it is given and writes: the factor's L numbers twice,
        forwards and back, 16 L, and columns of both sides, written and read, the latter twice, 144 f."""
        return 16.0 * self.nonzeros + 144.0 * self._b.shape[1]

    def apply(self, g: Any, out: Any) -> None:
        """Write -Q^-1 g, (f, 3) both and on the device, to `out`; waits for nothing."""
        launch = sums.blocks(len(out)), sums.THREADS, self._stream.queue
        to_columns[launch](g, self._b)
        with self._within:
            self._out[...] = self._solver.solve(stream=self._of)
        from_columns[launch](self._x, out)


@cuda.jit
def to_columns(rows, columns):
    """Write rows (f, 3) to columns (3, f)."""
    i = cuda.grid(1)
    while i < rows.shape[0]:
        for c in range(3):
            columns[c, i] = rows[i, c]
        i += cuda.gridsize(1)


@cuda.jit
def from_columns(columns, rows):
    """Write minus columns (3, f) to rows (f, 3), rounded to their type."""
    i = cuda.grid(1)
    while i < rows.shape[0]:
        for c in range(3):
            rows[i, c] = -columns[c, i]
        i += cuda.gridsize(1)

"""NVIDIA's cuDSS as the solver of Q x = b: the yardstick for a fixed Q on a device.

    plan, factorize: once a system;    reset_operands(b), solve: three right-hand sides, each time

It is called through nvmath-python's `DirectSolver`, which takes SciPy's matrix and NumPy's columns, copies them to the
device and the solution back; these copies are in its times. Q is handed over as what it is, positive definite, by its
lower half.
"""

from __future__ import annotations

import weakref
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from scipy.sparse import csr_array, tril

from solvers.problem import NotPositiveDefinite, Positions, Unsupported

_DISTRIBUTION = "nvmath-python"
_INSTALL = "`.venv/bin/pip install -e '.[cudss]'` in the checkout installs what it needs beside NVIDIA's driver"


def installed() -> str:
    """The version that is. Raises Unsupported with the command that installs it."""
    try:
        return f"{_DISTRIBUTION} {version(_DISTRIBUTION)}"
    except PackageNotFoundError as error:
        raise Unsupported(f"cudss: needs {_DISTRIBUTION}, which is not installed; {_INSTALL}") from error


class Cudss:
    """A factor on the device, which is freed with this. nonzeros: of the factor."""

    def __init__(self, Q: csr_array) -> None:
        """Q (f, f). Raises NotPositiveDefinite, and Unsupported where a device or its libraries are missing."""
        half = csr_array(tril(Q, format="csr"))
        half.sort_indices()
        indices, pointers = (np.asarray(x, np.int32) for x in (half.indices, half.indptr))
        self._b = np.zeros((len(pointers) - 1, 3), order="F")  # cuDSS takes columns
        try:
            library: Any = import_module("nvmath.sparse.advanced")
            options = library.DirectSolverOptions(
                sparse_system_type=library.DirectSolverMatrixType.SPD,
                sparse_system_view=library.DirectSolverMatrixViewType.LOWER,
            )
            lower = csr_array((half.data, indices, pointers), shape=half.shape)
            self._solver = library.DirectSolver(lower, self._b, options=options)
        except Exception as error:  # without a driver, without a device, without its libraries: each has its own
            why = " ".join(str(error).split()).rstrip(":. ")
            raise Unsupported(f"cudss: cannot begin ({type(error).__name__}: {why}); {_INSTALL}") from error
        weakref.finalize(self, self._solver.free)
        self._solver.plan()
        found = self._solver.factorize()
        if found.info:
            raise NotPositiveDefinite(f"cudss: Q = A'KA + M/dt^2 + w C'C has no factor: it tells of row {found.info}")
        self.nonzeros: int | None = int(found.lu_nnz)

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b, shape (f, 3), to `out`."""
        self._b[:] = b
        self._solver.reset_operands(b=self._b)
        out[:] = self._solver.solve()

"""The harness: scenes, sweeps, measurements, recordings and pictures.

Two settings of the libraries must be made before they load, hence here:

OpenMP's idle threads must sleep instead of spin, or Numba's and BLAS's threads slow each other down by several
times where both live in one process.

Numba's compiled code is kept by the state of all solvers' sources: its own key knows neither the functions in other
files that a kernel calls nor the options that it was compiled with.
"""

import hashlib
import os
from pathlib import Path


def _kernels() -> str:
    """The folder for the compiled code of today's sources; older ones beside it are no longer used."""
    solvers = Path(__file__).resolve().parents[1] / "solvers"
    digest = hashlib.sha256()
    for source in sorted(solvers.rglob("*.py")):
        digest.update(source.read_bytes())
    return str(solvers / "__pycache__" / f"numba-{digest.hexdigest()[:12]}")


os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("NUMBA_CACHE_DIR", _kernels())

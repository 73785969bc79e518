"""The harness: scenes, sweeps, measurements, recordings and pictures.

Two settings of the libraries must be made before they load, hence here:

OpenMP's idle threads must sleep instead of spin, or Numba's and BLAS's threads slow each other down by several
times where both live in one process.

Numba's compiled code is kept by the state of all solvers' sources: its own key knows neither the functions in other
files that a kernel calls nor the options that it was compiled with.
"""

import hashlib
import os
import shutil
from contextlib import suppress
from pathlib import Path
from time import time

_UNUSED = 3600.0
"""Seconds for which no process has begun to use a folder before it goes: one that still runs has loaded its kernels,
and what else it compiles Numba keeps anew."""


def kernels(solvers: Path) -> str:
    """The folder for the compiled code of today's sources; those of other sources go when it is made."""
    digest = hashlib.sha256()
    for source in sorted(solvers.rglob("*.py")):
        digest.update(source.read_bytes())
    folder = solvers / "__pycache__" / f"numba-{digest.hexdigest()[:12]}"
    with suppress(OSError):  # where nothing can be written, Numba looks for another place
        if not folder.exists():
            for other in folder.parent.glob("numba-*"):
                if other.stat().st_mtime < time() - _UNUSED:
                    shutil.rmtree(other, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    return str(folder)


os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("NUMBA_CACHE_DIR", kernels(Path(__file__).resolve().parents[1] / "solvers"))

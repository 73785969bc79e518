"""The harness: scenes, sweeps, measurements, recordings and pictures.

OpenMP's idle threads must sleep instead of spin, or Numba's and BLAS's threads slow each other down by
several times where both live in one process; the variable is read when the libraries load, hence here.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

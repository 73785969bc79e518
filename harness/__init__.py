"""The harness: scenes, sweeps, measurements, recordings and pictures.

A setting of OpenMP must be made before it loads, hence here: its idle threads must sleep instead of spin, or Numba's
and BLAS's threads slow each other down by several times where both live in one process.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

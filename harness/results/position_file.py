"""File of the positions of one run (.npz)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from springbench.harness.atomic_files import atomic_write


def save_positions(path: Path, positions: np.ndarray) -> None:
    """Store positions in a partial file and rename it.

    Args:
        path: file (.npz), whose only array is `positions`.
        positions: positions after each step (frames, n, 3) [m].

    Raises:
        WriteError: the file cannot be written.
    """
    with atomic_write(path) as partial:
        np.savez_compressed(partial, positions=positions)

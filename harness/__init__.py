"""The harness: scenes, sweeps, measurements, recordings and pictures. `dir(harness)` lists its interface.

OpenMP reads its settings when it is loaded, so this module sets them. Idle OpenMP threads must sleep instead of
spinning; otherwise the threads of Numba and BLAS slow each other down several times in one process. Everything else is
imported on first use.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.api import (
        IntegratorName,
        OptionKeys,
        PngImage,
        SceneKeys,
        Simulation,
        SolverName,
        SweepKeys,
        UserCodeName,
        draw_picture,
        load_rows,
        load_scene,
        make_scene,
        open_recording,
        run_config,
    )

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__all__ = [
    "IntegratorName",
    "OptionKeys",
    "PngImage",
    "SceneKeys",
    "Simulation",
    "SolverName",
    "SweepKeys",
    "UserCodeName",
    "draw_picture",
    "load_rows",
    "load_scene",
    "make_scene",
    "open_recording",
    "run_config",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module("harness.api"), name)
    raise AttributeError(f"module 'harness' has no {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__

"""The harness: scenes, sweeps, measurements, recordings and pictures; `dir(harness)` is what scripts and notebooks use.

A setting of OpenMP must be made before it loads, hence here: its idle threads must sleep instead of spin, or Numba's
and BLAS's threads slow each other down by several times where both live in one process. All else is imported when it is
first asked for.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.api import (
        IntegratorName,
        OptionKeys,
        OwnName,
        Picture,
        SceneKeys,
        Simulation,
        SolverName,
        SweepKeys,
        draw,
        load_scene,
        make_scene,
        open_recording,
        rows,
        run,
    )

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__all__ = [
    "IntegratorName",
    "OptionKeys",
    "OwnName",
    "Picture",
    "SceneKeys",
    "Simulation",
    "SolverName",
    "SweepKeys",
    "draw",
    "load_scene",
    "make_scene",
    "open_recording",
    "rows",
    "run",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module("harness.api"), name)
    raise AttributeError(f"module 'harness' has no {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__

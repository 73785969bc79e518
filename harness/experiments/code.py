"""By which code a run is done: the digest of all sources that it depends on, wherever they lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.config.sweep import RunSpec
from solvers import sources
from solvers.registry import EVERY, SOLVERS, load

_RUN = Path(__file__).with_name("run.py")
"""What does a run, whatever its parts."""


def solver_class(run: RunSpec) -> Any:
    """The class of a run's solver; its module is imported."""
    return load(EVERY[run.solver.name])


def parts(run: RunSpec) -> frozenset[type]:
    """The classes that a run is put together from by name: the solver, the mesh, the effects, a judge's reference."""
    judge = (load(SOLVERS["newton"]),) if run.judge else ()
    return frozenset([solver_class(run), type(run.scene.mesh), *map(type, run.scene.effects), *judge])


def code(parts: frozenset[type]) -> str:
    """12 hexadecimal digits of SHA-256 over all sources that a run of these parts depends on."""
    return sources.digest([_RUN, *(file for part in parts for file in sources.of_class(part))])[:12]

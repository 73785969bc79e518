"""By which code a run is done: the digest of all sources that it depends on, wherever they lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.config.sweep import RunSpec
from solvers import sources
from solvers.plugins import Plugin
from solvers.registry import EVERY, SOLVERS, load

_RUN = Path(__file__).with_name("run.py")
"""What does a run, whatever its parts."""


def solver_class(run: RunSpec) -> Any:
    """The class of a run's solver; its module is imported."""
    return load(EVERY[run.solver.name])


def parts(run: RunSpec) -> frozenset[type | Plugin]:
    """What a run is put together from by name: the classes of the solver, the mesh, the effects, a judge's reference.
    Somebody's own code is named and not imported."""
    named = {"mesh": run.scene.mesh, **{f"effects[{i}]": effect for i, effect in enumerate(run.scene.effects)}}
    shipped = [type(part) for place, part in named.items() if place not in run.scene.own]
    solver = [] if isinstance(run.solver.name, Plugin) else [solver_class(run)]
    judge = (load(SOLVERS["newton"]),) if run.judge else ()
    return frozenset([*solver, *shipped, *run.own(), *judge])


def code(parts: frozenset[type | Plugin]) -> str:
    """12 hexadecimal digits of SHA-256 over all sources that a run of these parts depends on."""
    return sources.digest([_RUN, *(file for part in parts for file in _files(part))])[:12]


def _files(part: type | Plugin) -> set[Path]:
    if isinstance(part, Plugin):
        return {Path(part.source)} if part.source.endswith(".py") else set()
    return sources.of_class(part)

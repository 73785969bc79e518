"""Fingerprint of a run's source code: the digest of all files it depends on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.config.sweep import RunSpec
from solvers import sources
from solvers.plugins import Plugin, source_of
from solvers.registry import EVERY, load

Part = Path | type | Plugin
"""Source file of a solver; imported class of a mesh or an effect; plug-in of the user."""

TO_ERROR = "harness.experiments.asked.kept:keep_to_error"
"""Import target that executes error-controlled runs; other runs do not depend on it."""

_RUN = Path(__file__).with_name("run.py")
"""Module that executes every run."""


def solver_class(run: RunSpec) -> Any:
    """Import and return the class of a run's solver."""
    return load(EVERY[run.solver.name])


def parts(run: RunSpec) -> frozenset[Part]:
    """Return the source parts of a run, without importing solvers or user code.

    These are the file of the solver, and the classes of the mesh and the effects. Where the run needs them, there are
    also the files of the reference solver and of the solver for initial guesses, and the module of error-controlled
    runs.
    """
    named = {"mesh": run.scene.mesh, **{f"effects[{i}]": effect for i, effect in enumerate(run.scene.effects)}}
    shipped = [type(part) for place, part in named.items() if place not in run.scene.own]
    solver = [] if isinstance(run.solver.name, Plugin) else [run.solver.name]
    judge = ["newton"] if run.judge else []
    guess = ["hybrid"] if run.first_guess == "coarse" else []
    kept = [] if run.accuracy is None else [Path(source_of(TO_ERROR.partition(":")[0]) or _RUN)]
    return frozenset([*map(_file_of, [*solver, *judge, *guess]), *kept, *shipped, *run.own()])


def code(parts: frozenset[Part]) -> str:
    """Return 12 hexadecimal digits of SHA-256 over all source files of these parts."""
    return sources.digest([_RUN, *(file for part in parts for file in files(part))])[:12]


def _file_of(name: str) -> Path:
    """Return the file of a solver of this package; it imports the base classes."""
    return Path(source_of(EVERY[name].partition(":")[0]) or _RUN)


def files(part: Part) -> frozenset[Path]:
    """Return the source files of a part."""
    if isinstance(part, Path):
        return frozenset([part])
    if isinstance(part, Plugin):
        return frozenset([Path(part.source)] if part.source.endswith(".py") else [])
    return sources.of_class(part)

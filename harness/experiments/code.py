"""By which code a run is done: the digest of all sources that it depends on, wherever they lie."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.config.sweep import RunSpec
from solvers import sources
from solvers.plugins import Plugin, source_of
from solvers.registry import EVERY, load

Part = Path | type | Plugin
"""The file of a solver; the class of a mesh or an effect, which is there already; somebody's own code."""

TO_ERROR = "harness.experiments.asked.kept:keep_to_error"
"""What does a run that keeps to an error; other runs depend on none of it."""

_RUN = Path(__file__).with_name("run.py")
"""What does a run, whatever its parts."""


def solver_class(run: RunSpec) -> Any:
    """The class of a run's solver; its module is imported."""
    return load(EVERY[run.solver.name])


def parts(run: RunSpec) -> frozenset[Part]:
    """What a run is put together from by name: the solver's file, the classes of the mesh and the effects, the files of
    a judge's reference and of what guesses, and what keeps to an error. Neither solvers nor somebody's own code are
    imported."""
    named = {"mesh": run.scene.mesh, **{f"effects[{i}]": effect for i, effect in enumerate(run.scene.effects)}}
    shipped = [type(part) for place, part in named.items() if place not in run.scene.own]
    solver = [] if isinstance(run.solver.name, Plugin) else [run.solver.name]
    judge = ["newton"] if run.judge else []
    guess = ["hybrid"] if run.first_guess == "coarse" else []
    kept = [] if run.accuracy is None else [Path(source_of(TO_ERROR.partition(":")[0]) or _RUN)]
    return frozenset([*map(_file_of, [*solver, *judge, *guess]), *kept, *shipped, *run.own()])


def code(parts: frozenset[Part]) -> str:
    """12 hexadecimal digits of SHA-256 over all sources that a run of these parts depends on."""
    return sources.digest([_RUN, *(file for part in parts for file in files(part))])[:12]


def _file_of(name: str) -> Path:
    """The file of a shipped solver; what its class inherits is imported there."""
    return Path(source_of(EVERY[name].partition(":")[0]) or _RUN)


def files(part: Part) -> frozenset[Path]:
    """The files that a part is written in."""
    if isinstance(part, Path):
        return frozenset([part])
    if isinstance(part, Plugin):
        return frozenset([Path(part.source)] if part.source.endswith(".py") else [])
    return sources.of_class(part)

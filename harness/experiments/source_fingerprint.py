"""Fingerprint of a run's source code: the digest of all files it depends on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from springbench.harness.config.sweep_config import RunSpec
from springbench.solvers.jit import source_digest
from springbench.solvers.plugins.plugin_discovery import PluginName, find_module_source
from springbench.solvers.registry import SOLVER_TABLE, load_target

SourcePart = Path | type | PluginName
"""Source file of a solver; imported class of a mesh or an effect; plug-in of the user."""

ERROR_CONTROL_TARGET = "springbench.harness.experiments.error_control.error_controlled_run:run_error_controlled"
"""Import target that executes error-controlled runs; other runs do not depend on it."""

_RUN_MODULE = Path(__file__).with_name("run_pipeline.py")
"""Module that executes every run."""


def load_solver_class(run: RunSpec) -> Any:
    """Import and return the class of a run's solver."""
    return load_target(SOLVER_TABLE[run.solver.name])


def collect_source_parts(run: RunSpec) -> frozenset[SourcePart]:
    """Return the source parts of a run, without importing solvers or user code.

    These are the file of the solver, and the classes of the mesh and the effects. Where the run needs them, there are
    also the files of the reference solver and of the solver for initial guesses, and the module of error-controlled
    runs.
    """
    named = {"mesh": run.scene.mesh, **{f"effects[{i}]": effect for i, effect in enumerate(run.scene.effects)}}
    shipped = [type(part) for place, part in named.items() if place not in run.scene.plugins]
    solver = [] if isinstance(run.solver.name, PluginName) else [run.solver.name]
    verifier = ["newton"] if run.verify else []
    guess = ["hybrid"] if run.initial_guess == "coarse-to-fine" else []
    error_control = (
        []
        if run.error_target is None
        else [Path(find_module_source(ERROR_CONTROL_TARGET.partition(":")[0]) or _RUN_MODULE)]
    )
    return frozenset(
        [*map(_find_solver_file, [*solver, *verifier, *guess]), *error_control, *shipped, *run.find_plugins()]
    )


def compute_source_fingerprint(parts: frozenset[SourcePart]) -> str:
    """Return 12 hexadecimal digits of SHA-256 over all source files of these parts."""
    return source_digest.digest_sources([_RUN_MODULE, *(file for part in parts for file in list_source_files(part))])[
        :12
    ]


def _find_solver_file(name: str) -> Path:
    """Return the file of a solver of this package; it imports the base classes."""
    return Path(find_module_source(SOLVER_TABLE[name].partition(":")[0]) or _RUN_MODULE)


def list_source_files(part: SourcePart) -> frozenset[Path]:
    """Return the source files of a part."""
    if isinstance(part, Path):
        return frozenset([part])
    if isinstance(part, PluginName):
        return frozenset([Path(part.source_path)] if part.source_path.endswith(".py") else [])
    return source_digest.find_class_sources(part)

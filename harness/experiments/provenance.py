"""Columns common to the rows of all experiments: specification, machine, time and source code."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from springbench.harness.config.run_options import RUN_OPTIONS
from springbench.harness.config.sweep_config import RunSpec, SolverSpec
from springbench.harness.execution import machine_info
from springbench.solvers.jit import source_digest
from springbench.solvers.plugins.plugin_discovery import PluginName, find_module_source
from springbench.solvers.registry import SOLVER_TABLE, load_target


def build_run_columns(run: RunSpec) -> dict[str, Any]:
    """Return the columns that are equal in all rows of a run."""
    limits = {"time_limit": run.time_limit, "memory_limit": run.memory_limit, "timing": run.timing}
    return (
        {"run_id": run.compute_run_id(machine_info.describe_machine().machine_id), "sweep": run.sweep}
        | build_specification_columns(run)
        | limits
        | build_provenance_columns(run.solver)
    )


def build_specification_columns(run: RunSpec) -> dict[str, Any]:
    """Return the columns that state the specification of a run."""
    plugins = run.find_plugins()
    return {
        "scene": run.scene_name,
        "size": run.size,
        "solver": run.solver.name,
        "parameters": json.dumps(dict(run.solver.parameters), sort_keys=True),
        "plugins": json.dumps([plugin.identify_code() for plugin in plugins]) if plugins else None,
        **run.solver.metadata_columns,
        **{option.column: getattr(run, name) for name, option in RUN_OPTIONS.items() if option.column},
        "residual_rtol": convert_tolerance(run.rtol),
        "threads": machine_info.choose_threads(run.threads).count,
    }


def convert_tolerance(value: float | str | None) -> float | None:
    """Return the tolerance as the column stores it: 0 for `auto`."""
    return 0.0 if isinstance(value, str) else value


def build_provenance_columns(solver: SolverSpec | None = None) -> dict[str, Any]:
    """Return the columns for the machine, the time and the source code of a measurement.

    Args:
        solver: solver whose package versions are included, where it is an interface to a package.
    """
    here = machine_info.describe_machine()
    return {
        "machine_id": here.machine_id,
        "node_id": machine_info.compute_node_id(),
        "cpu": here.cpu,
        "cores": here.cores,
        "memory_gib": here.memory_gib,
        "operating_system": here.operating_system,
        "versions": json.dumps(
            machine_info.collect_versions(*(solver.third_party_packages if solver else ())), sort_keys=True
        ),
        "commit": machine_info.read_commit(),
        "source_fingerprint": machine_info.hash_sources(),
        "started_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }


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

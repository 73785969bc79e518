"""Columns common to the rows of all experiments.

They state specification, machine, time and source code of a measurement.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

from springbench.harness.config.run_options import RUN_OPTIONS
from springbench.harness.config.sweep_config import RunSpec, SolverSpec
from springbench.harness.execution import machine_info


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

"""Columns common to the rows of all experiments.

They state specification, machine, time and source code of a measurement.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

from harness.base import machine
from harness.config.options import OPTIONS
from harness.config.sweep import RunSpec, SolverSpec


def common(run: RunSpec) -> dict[str, Any]:
    """Return the columns that are equal in all rows of a run."""
    limits = {"time_limit": run.time_limit, "memory_limit": run.memory_limit, "timing": run.timing}
    return (
        {"run_id": run.run_id(machine.describe().id), "sweep": run.sweep} | asked(run) | limits | provenance(run.solver)
    )


def asked(run: RunSpec) -> dict[str, Any]:
    """Return the columns that state the specification of a run."""
    return {
        "scene": run.scene_name,
        "size": run.size,
        "solver": run.solver.name,
        "parameters": json.dumps(dict(run.solver.parameters), sort_keys=True),
        "own": json.dumps([plugin.identity() for plugin in run.own()]) if run.own() else None,
        **run.solver.columns,
        **{option.column: getattr(run, name) for name, option in OPTIONS.items() if option.column},
        "tolerance": tolerance(run.tolerance),
        "threads": machine.threads(run.threads).number,
    }


def tolerance(stated: float | str | None) -> float | None:
    """Return the tolerance as the column stores it: 0 for `auto`."""
    return 0.0 if isinstance(stated, str) else stated


def provenance(solver: SolverSpec | None = None) -> dict[str, Any]:
    """Return the columns for the machine, the time and the source code of a measurement.

    Args:
        solver: solver whose package versions are included, where it is an interface to a package.
    """
    here = machine.describe()
    return {
        "machine": here.id,
        "node": machine.node(),
        "cpu": here.cpu,
        "cores": here.cores,
        "memory_gib": here.memory_gib,
        "system": here.system,
        "versions": json.dumps(machine.versions(*(solver.packages if solver else ())), sort_keys=True),
        "commit": machine.commit(),
        "code": machine.code_hash(),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }

"""Metadata of solvers as columns of rows.

Reports read these columns and need not import the solvers, which may be user code.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from springbench.solvers.registry import SOLVER_TABLE, find_solver_info, is_minimiser, load_target


def list_packages(solver: str) -> tuple[str, ...]:
    """List the third-party distributions that a solver is an interface to."""
    if solver not in SOLVER_TABLE:
        return ()
    package = find_solver_info(load_target(SOLVER_TABLE[solver]), solver).package_name
    return (package,) if package else ()


def read_solver_metadata(solver: str) -> dict[str, Any]:
    """Read the columns `family`, `citation`, `is_minimiser` and `is_substepping` of a solver.

    The result is empty for an unknown name.
    """
    if solver not in SOLVER_TABLE:
        return {}
    method = load_target(SOLVER_TABLE[solver])
    info = find_solver_info(method, solver)
    return {
        "family": info.family,
        "citation": json.dumps(asdict(info.citation), ensure_ascii=False) if info.citation else None,
        "is_minimiser": is_minimiser(method),
        "is_substepping": info.is_substepping,
    }

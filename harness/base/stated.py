"""Metadata of solvers as columns of rows.

Reports therefore need not import the solvers, which may be user code.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from solvers.registry import EVERY, about, load, minimises


def packages(solver: str) -> tuple[str, ...]:
    """List the third-party distributions that a solver is an interface to."""
    if solver not in EVERY:
        return ()
    package = about(load(EVERY[solver]), solver).package
    return (package,) if package else ()


def stated(solver: str) -> dict[str, Any]:
    """Read the columns `family`, `reference`, `minimises` and `own_steps` of a solver.

    Empty for an unknown name.
    """
    if solver not in EVERY:
        return {}
    method = load(EVERY[solver])
    told = about(method, solver)
    return {
        "family": told.family,
        "reference": json.dumps(asdict(told.reference), ensure_ascii=False) if told.reference else None,
        "minimises": minimises(method),
        "own_steps": told.own_steps,
    }

"""What a solver states of itself, as columns of rows: so reports need not import it, which may be someone else's."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from solvers.registry import EVERY, about, load, minimises


def packages(solver: str) -> tuple[str, ...]:
    """The distributions of others that a solver by name is an interface to."""
    if solver not in EVERY:
        return ()
    package = about(load(EVERY[solver]), solver).package
    return (package,) if package else ()


def stated(solver: str) -> dict[str, Any]:
    """The columns `family`, `reference`, `minimises` and `own_steps` of a solver by name; none of what is no solver."""
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

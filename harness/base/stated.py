"""What a solver states of itself, as columns of rows: so reports need not import it, which may be someone else's."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from solvers.registry import SOLVERS, load


def stated(solver: str) -> dict[str, Any]:
    """The columns `family`, `reference`, `minimises` and `own_steps` of a solver by name; none of what is no solver."""
    if solver not in SOLVERS:
        return {}
    method = load(SOLVERS[solver])
    return {
        "family": method.about.family,
        "reference": json.dumps(asdict(method.about.reference), ensure_ascii=False),
        "minimises": method.minimises,
        "own_steps": method.about.own_steps,
    }

"""The validation as a table: closed forms by refinement, textile tests and their published bands.

A closed form is confirmed if the error of the finest level is at most what its discretisation explains: the difference
of the two finest levels over 2^p - 1, p the order, times a safety factor (Roache 1994), plus the difference of the
models and round-off. That estimate has a meaning only if the levels converge, with at least half the order. The error
of a series that diverges, or that tends elsewhere at the last level, is not explained.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from springbench.harness.experiments.validation.closed_forms import (
    ROUNDOFF_FRACTION,
    SAFETY_FACTOR,
    ClosedForm,
    list_closed_forms,
)
from springbench.harness.experiments.validation.fabric_tests import (
    TESTED_FABRICS,
    MeasuredBand,
    measure_bending_length,
    measure_drape,
)
from springbench.harness.scenes.fabric_table import PUBLISHED_FABRICS
from springbench.solvers.model.step_problem import Solver, Unsupported

CONFIRMED, UNEXPLAINED, REFUSED, INSIDE, OUTSIDE = "confirmed", "unexplained", "refused", "in band", "outside band"
"""Verdicts of a closed form and of a textile test."""


def list_case_names() -> list[str]:
    """Return the names of all cases, closed forms first."""
    return [*(case.name for case in list_closed_forms()), *(f"fabric {name}" for name in TESTED_FABRICS)]


def validate_solver(
    solver: Solver, names: Iterable[str], on_case: Callable[[str], None] = lambda name: None
) -> list[dict[str, Any]]:
    """Run cases with a solver, and return a row of plain data for each.

    Args:
        solver: the solver.
        names: names of the cases.
        on_case: called with the name of each case before it runs.
    """
    forms = {case.name: case for case in list_closed_forms()}
    rows = list[dict[str, Any]]()
    for name in names:
        on_case(name)
        rows.append(grade_closed_form(forms[name], solver) if name in forms else _run_fabric(name, solver))
    return rows


def grade_closed_form(case: ClosedForm, solver: Solver) -> dict[str, Any]:
    """Simulate a closed form on its levels, and return its row with the verdict.

    Args:
        case: the closed form.
        solver: the solver; a case that it does not support has the verdict `REFUSED`.
    """
    row: dict[str, Any] = {
        "kind": "closed form", "name": case.name, "quantity": case.quantity, "refined": case.refined,
        "levels": list(case.levels), "order": case.order, "exact": case.exact,
    }  # fmt: skip
    try:
        values = [case.simulate(level, solver) for level in case.levels]
        remark = case.remark(case.levels[-1], solver) if case.remark else ""
    except Unsupported as error:
        return row | {"verdict": REFUSED, "remark": str(error)}
    if not np.isfinite(values).all():
        return row | {"verdict": UNEXPLAINED, "remark": f"diverges: it gives {', '.join(f'{x:.3g}' for x in values)}"}
    errors = [abs(value - case.exact) for value in values]
    roundoff = ROUNDOFF_FRACTION * max(abs(case.exact), *map(abs, values))
    coarse, fine = abs(values[1] - values[0]), abs(values[2] - values[1])
    is_resolved = fine > roundoff and coarse > roundoff
    observed_order = float(np.log2(coarse / fine)) if is_resolved else None
    converges = fine <= roundoff or (observed_order or 0.0) >= case.order / 2.0
    discretisation = fine / (2.0**case.order - 1.0) if converges else 0.0
    explained = SAFETY_FACTOR * discretisation + case.model_error + roundoff
    return row | {
        "values": values,
        "errors": errors,
        "discretisation_error": discretisation,
        "model_error": case.model_error,
        "explained_error": explained,
        "observed_order": observed_order,
        "verdict": CONFIRMED if converges and errors[-1] <= explained else UNEXPLAINED,
        "remark": remark,
    }


def _run_fabric(name: str, solver: Solver) -> dict[str, Any]:
    fabric = PUBLISHED_FABRICS[name.removeprefix("fabric ")]
    row: dict[str, Any] = {"kind": "textile test", "name": name, "source": fabric.source, "use": fabric.description}
    try:
        bending, (drape, p, triangles) = measure_bending_length(fabric, solver), measure_drape(fabric, solver)
    except Unsupported as error:
        return row | {"verdict": REFUSED, "remark": str(error)}
    outside = [one for one, band in (("bending length", bending), ("drape", drape)) if not band.is_inside]
    return row | {
        "bending_length": _to_row(bending),
        "drape_coefficient": _to_row(drape),
        "positions": np.round(p, 5).tolist(),
        "triangles": triangles.tolist(),
        "verdict": f"{OUTSIDE}: {', '.join(outside)}" if outside else INSIDE,
        "remark": "",
    }


def _to_row(band: MeasuredBand) -> dict[str, float]:
    return {"value": float(band.value), "low": float(band.low), "high": float(band.high)}

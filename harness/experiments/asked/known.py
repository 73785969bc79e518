"""Read the trials of earlier searches, to select the methods worth running again.

A row of the kind `way` states in the column `promised` the CPU seconds predicted for the requested error. For a similar
error, methods whose predicted cost was several times the smallest are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import log
from pathlib import Path
from typing import Any

from harness.base import machine, rows, shelf
from harness.config.sweep import SolverSpec
from harness.experiments.accuracy.accuracy_rows import SCHEMA
from harness.experiments.asked.search import Answer
from harness.experiments.asked.ways import Asked, tried

Row = dict[str, Any]

_FAR = 10.0
"""Largest ratio of two errors for which a stored prediction is used; for others it has little value."""
_DEAR = 2.0
"""Largest ratio to the smallest predicted cost of a method that is run again; predictions are no more accurate than
that.
"""


def problem(asked: Asked) -> str:
    """Return an identifier of the simulated problem, including its frames."""
    return f"{asked.scene.stepped(1.0).digest[:12]}-{asked.size}-{asked.horizon:.9g}-{asked.frames}"


def known(folder: Path, asked: Asked) -> list[Row]:
    """Return the stored trials of this motion in a folder of rows.

    They are of the same source code and machine.
    """
    here = {"problem": problem(asked), "machine": machine.describe().id, "code": machine.code_hash()}
    units = [unit for unit in shelf.units(folder) if "-asked-" in unit.name]
    found = rows.read(units, SCHEMA).to_pylist() if units else []
    return [row for row in found if row["kind"] == "way" and here.items() <= row.items()]


def promising(found: Sequence[Row], error: float) -> tuple[float, list[tuple[str, SolverSpec]]]:
    """Return the stored error nearest to `error`, and the methods cheap at it.

    Args:
        found: rows of earlier trials.
        error: relative error to reach.

    Returns: the nearest error, and integrators with solvers; none where no stored error is similar.
    """
    nearest = min((row["asked"] for row in found), key=lambda asked: abs(log(asked / error)), default=0.0)
    if not error / _FAR <= nearest <= error * _FAR:
        return nearest, []
    there = [row for row in found if row["asked"] == nearest]
    most = _DEAR * min(row["promised"] for row in there)
    cheap = {(row["integrator"], row["solver"]) for row in there if row["promised"] <= most}
    return nearest, [(integrator, solver) for integrator, solver in tried() if (integrator, solver.name) in cheap]


def way_rows(answer: Answer, found: Iterable[Row], error: float) -> list[Row]:
    """Build the rows of the trials of a search.

    Stored trials of the same error are added.

    Args:
        answer: result of the search.
        found: rows of earlier trials; methods that were run again are left out.
        error: requested error.
    """
    made = [
        {
            "kind": "way",
            "status": "ok",
            "parameters": "{}",
            "promised": promised,
            "solver": one.way.solver,
            **one.columns,
            "iterations_done": one.path.iterations,
            "seconds": [one.path.seconds],
            "cpu_seconds": one.path.processor,
        }
        for one, promised in answer.tried
    ]
    again = {(row["integrator"], row["solver"]) for row in made}
    kept = [row for row in found if row["asked"] == error and (row["integrator"], row["solver"]) not in again]
    return [*made, *kept]

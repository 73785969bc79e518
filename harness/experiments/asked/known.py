"""What rows measured before say of a scene: which ways to an error are worth trying again.

A row of the kind `way` tells what a way `promised` when an error was asked for, the processor seconds that it would
take to it. For an error that is not far from that one, ways that promised several times the least are left out.
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
"""Times an error, or a part of it: what was promised for others says little."""
_DEAR = 2.0
"""Times the least promise, what a way that is tried again may have promised: promises are no better than that."""


def problem(asked: Asked) -> str:
    """What is simulated, its frames included, in a word."""
    return f"{asked.scene.stepped(1.0).digest[:12]}-{asked.size}-{asked.horizon:.9g}-{asked.frames}"


def known(folder: Path, asked: Asked) -> list[Row]:
    """The rows of ways to errors of this motion, which this code left on this machine in a folder of rows."""
    here = {"problem": problem(asked), "machine": machine.describe().id, "code": machine.code_hash()}
    units = [unit for unit in shelf.units(folder) if "-asked-" in unit.name]
    found = rows.read(units, SCHEMA).to_pylist() if units else []
    return [row for row in found if row["kind"] == "way" and here.items() <= row.items()]


def promising(found: Sequence[Row], error: float) -> tuple[float, list[tuple[str, SolverSpec]]]:
    """The error that was asked for nearest to this one, and the integrators and solvers that were not dear to it; none
    where nothing near was asked for."""
    nearest = min((row["asked"] for row in found), key=lambda asked: abs(log(asked / error)), default=0.0)
    if not error / _FAR <= nearest <= error * _FAR:
        return nearest, []
    there = [row for row in found if row["asked"] == nearest]
    most = _DEAR * min(row["promised"] for row in there)
    cheap = {(row["integrator"], row["solver"]) for row in there if row["promised"] <= most}
    return nearest, [(integrator, solver) for integrator, solver in tried() if (integrator, solver.name) in cheap]


def way_rows(answer: Answer, found: Iterable[Row], error: float) -> list[Row]:
    """Rows of the ways that were tried, by their first settings, and those found of the same error that were not."""
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

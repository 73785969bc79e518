"""Comparison with external engines by the shortest wall time within an error.

Each engine is represented by the best of its settings:

    ratio = (shortest time of an engine's settings within the error) / (shortest time of all own methods within it)

Above 1 the own methods are faster. Meshes without runs of an engine are omitted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from harness.report.accuracy.measured import WorkPoint
from harness.report.accuracy.times import duration, power
from harness.report.accuracy.work_plot import front
from harness.report.page import factor
from harness.report.style import INK, Mark, numbered
from solvers.about import ENGINE

OURS = "springbench"
ERRORS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
"""Relative errors of the positions at the end time."""
WILD = 1.0
"""Relative errors from here on do not represent a motion: nothing moved, or it exploded."""


class Standing(NamedTuple):
    """For one error on one mesh, the cheapest simulation of each program that reaches it."""

    mesh: str
    error: float
    best: dict[str, WorkPoint]

    def ratio(self, engine: str) -> float | None:
        """Return the engine's time divided by the own time.

        The result is None if either does not reach the error.
        """
        if engine not in self.best or OURS not in self.best:
            return None
        return self.best[engine].seconds / self.best[OURS].seconds


def program(work: WorkPoint) -> str:
    """Return the program of a simulation: an engine's name, or OURS."""
    return work.solver if work.family == ENGINE else OURS


def met(works: Iterable[WorkPoint]) -> dict[str, list[WorkPoint]]:
    """Return simulations by mesh, for the meshes with runs of both engines and own methods."""
    meshes: dict[str, list[WorkPoint]] = {}
    for work in works:
        meshes.setdefault(work.mesh, []).append(work)
    return {mesh: here for mesh, here in meshes.items() if {OURS} < {program(work) for work in here}}


def fronts(works: Iterable[WorkPoint]) -> dict[str, list[WorkPoint]]:
    """Return the Pareto front of each program's settings in time and error.

    The cheapest setting comes first, and so do the own methods.
    """
    by_program: dict[str, list[WorkPoint]] = {OURS: []}
    for work in works:
        by_program.setdefault(program(work), []).append(work)
    names = [OURS, *sorted(set(by_program) - {OURS})]
    return {name: [work for work in front(by_program[name]) if work.error < WILD] for name in names}


def standings(works: Iterable[WorkPoint], errors: Sequence[float] = ERRORS) -> list[Standing]:
    """Compare the programs by mesh and error, the largest error first.

    Args:
        works: simulations.
        errors: relative errors.
    """
    found = list[Standing]()
    for mesh, here in met(works).items():
        by_program = fronts(here)
        for error in errors:
            within = {name: [work for work in best if work.error <= error] for name, best in by_program.items()}
            found.append(Standing(mesh, error, {name: kept[0] for name, kept in within.items() if kept}))
    return found


def engines(works: Iterable[WorkPoint]) -> list[str]:
    """Return the sorted names of the engines that were measured."""
    return sorted({program(work) for work in works} - {OURS})


def marks(works: Iterable[WorkPoint]) -> dict[str, Mark]:
    """Assign a style to each program; the own methods are drawn in the text colour."""
    return {OURS: Mark(INK, "o")} | {name: numbered(k)._replace(dash="-") for k, name in enumerate(engines(works))}


def table(works: Sequence[WorkPoint]) -> Iterator[str]:
    """Format the time ratios as a Markdown table.

    There is one row per mesh and error, one column per engine, and a column with the best own setting.
    """
    names = engines(works)
    if not names:
        return
    yield f"| mesh | error | {' | '.join(names)} | ours, a simulated second |"
    yield "|---|---|" + "---|" * (len(names) + 1)
    refused = {mesh: _refused(here) for mesh, here in met(works).items()}
    for one in standings(works):
        if one.best:
            cells = (_cell(one, name, refused[one.mesh]) for name in names)
            ours = one.best.get(OURS)
            told = f"{ours.setting}: {duration(ours.seconds)}" if ours else "does not get there"
            yield f"| {one.mesh} | {power(one.error)} | {' | '.join(cells)} | {told} |"


def settings(works: Iterable[WorkPoint]) -> Iterator[str]:
    """Describe the fastest setting of each engine in sentences."""
    for one in standings(works):
        for name, best in one.best.items():
            if name != OURS:
                yield f"{one.mesh} to {power(one.error)}, {name}: {best.setting}."


def _refused(works: Iterable[WorkPoint]) -> set[str]:
    """Find the programs that do not support the mesh's spring network, or are not installed."""
    by_program: dict[str, set[str]] = {}
    for work in works:
        by_program.setdefault(program(work), set()).add(work.status)
    return {name for name, statuses in by_program.items() if statuses == {"unsupported"}}


def _cell(one: Standing, engine: str, refused: set[str]) -> str:
    if engine in refused:
        return "refused"
    ratio = one.ratio(engine)
    return factor(ratio) if ratio else "alone" if engine in one.best else "–"

"""Outside engines beside ours: the least wall time for which a motion ends within an error, by each one's best setting.

    ratio = least time of an engine's settings within the error / least time of all of our methods within it

Above 1, ours is the faster. Nothing is told of meshes that no engine was tried on.
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
"""Relative errors of the positions at the horizon."""
WILD = 1.0
"""Errors from here on tell of no motion: nothing moved, or it exploded."""


class Standing(NamedTuple):
    """Who ends within one error on one mesh: the cheapest simulation by program, of those that reach it."""

    mesh: str
    error: float
    best: dict[str, WorkPoint]

    def ratio(self, engine: str) -> float | None:
        """How many times as long as ours the engine takes; None where either does not get there."""
        if engine not in self.best or OURS not in self.best:
            return None
        return self.best[engine].seconds / self.best[OURS].seconds


def program(work: WorkPoint) -> str:
    """Whose program did it: an engine's name, or OURS."""
    return work.solver if work.family == ENGINE else OURS


def met(works: Iterable[WorkPoint]) -> dict[str, list[WorkPoint]]:
    """Simulations by mesh, of the meshes on which both engines and ours were tried."""
    meshes: dict[str, list[WorkPoint]] = {}
    for work in works:
        meshes.setdefault(work.mesh, []).append(work)
    return {mesh: here for mesh, here in meshes.items() if {OURS} < {program(work) for work in here}}


def fronts(works: Iterable[WorkPoint]) -> dict[str, list[WorkPoint]]:
    """Each program's settings that none of its others beats in both time and error, the cheapest first; ours first."""
    by_program: dict[str, list[WorkPoint]] = {OURS: []}
    for work in works:
        by_program.setdefault(program(work), []).append(work)
    names = [OURS, *sorted(set(by_program) - {OURS})]
    return {name: [work for work in front(by_program[name]) if work.error < WILD] for name in names}


def standings(works: Iterable[WorkPoint], errors: Sequence[float] = ERRORS) -> list[Standing]:
    """By mesh and error, the largest error first."""
    found = list[Standing]()
    for mesh, here in met(works).items():
        by_program = fronts(here)
        for error in errors:
            within = {name: [work for work in best if work.error <= error] for name, best in by_program.items()}
            found.append(Standing(mesh, error, {name: kept[0] for name, kept in within.items() if kept}))
    return found


def engines(works: Iterable[WorkPoint]) -> list[str]:
    """The engines that were tried, by name."""
    return sorted({program(work) for work in works} - {OURS})


def marks(works: Iterable[WorkPoint]) -> dict[str, Mark]:
    """A look for each program, ours in ink."""
    return {OURS: Mark(INK, "o")} | {name: numbered(k)._replace(dash="-") for k, name in enumerate(engines(works))}


def table(works: Sequence[WorkPoint]) -> Iterator[str]:
    """The ratios as rows of Markdown: a mesh and error in each, an engine in each column, and our best in words."""
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
    """By which setting an engine is fastest, as sentences."""
    for one in standings(works):
        for name, best in one.best.items():
            if name != OURS:
                yield f"{one.mesh} to {power(one.error)}, {name}: {best.setting}."


def _refused(works: Iterable[WorkPoint]) -> set[str]:
    """Programs that could not be asked: the network is beyond them, or they are not installed."""
    by_program: dict[str, set[str]] = {}
    for work in works:
        by_program.setdefault(program(work), set()).add(work.status)
    return {name for name, statuses in by_program.items() if statuses == {"unsupported"}}


def _cell(one: Standing, engine: str, refused: set[str]) -> str:
    if engine in refused:
        return "refused"
    ratio = one.ratio(engine)
    return factor(ratio) if ratio else "alone" if engine in one.best else "–"

"""Comparison with external engines by the shortest wall time within an error.

Each engine is represented by the best of its settings:

    ratio = (shortest time of an engine's settings within the error) / (shortest time of all own methods within it)

Above 1 the own methods are faster. Meshes without runs of an engine are omitted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from springbench.harness.report.accuracy.accuracy_data import WorkPoint
from springbench.harness.report.accuracy.time_to_accuracy import format_duration, format_gap
from springbench.harness.report.accuracy.work_precision import find_pareto_front
from springbench.harness.report.number_format import format_factor
from springbench.harness.report.plot_style import TEXT_COLOUR, SeriesStyle, build_indexed_style
from springbench.solvers.iteration.solver_info import ENGINE_FAMILY

OWN_PROGRAM = "springbench"
ERROR_TARGETS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
"""Relative errors of the positions at the end time."""
MAX_MEANINGFUL_ERROR = 1.0
"""Relative errors of this value or more do not represent a motion: nothing moved, or it exploded."""


class EngineComparison(NamedTuple):
    """For one error on one mesh, the cheapest simulation of each program that reaches it."""

    mesh: str
    error: float
    fastest_by_program: dict[str, WorkPoint]

    def time_ratio(self, engine: str) -> float | None:
        """Return the engine's time divided by the own time.

        The result is None if either does not reach the error.
        """
        if engine not in self.fastest_by_program or OWN_PROGRAM not in self.fastest_by_program:
            return None
        return (
            self.fastest_by_program[engine].seconds_per_simulated_second
            / self.fastest_by_program[OWN_PROGRAM].seconds_per_simulated_second
        )


def program_name(work: WorkPoint) -> str:
    """Return the program of a simulation: an engine's name, or OWN_PROGRAM."""
    return work.solver if work.family == ENGINE_FAMILY else OWN_PROGRAM


def list_engine_meshes(works: Iterable[WorkPoint]) -> dict[str, list[WorkPoint]]:
    """Return simulations by mesh, for the meshes with runs of both engines and own methods."""
    meshes: dict[str, list[WorkPoint]] = {}
    for work in works:
        meshes.setdefault(work.mesh_label, []).append(work)
    return {mesh: here for mesh, here in meshes.items() if {OWN_PROGRAM} < {program_name(work) for work in here}}


def find_pareto_fronts(works: Iterable[WorkPoint]) -> dict[str, list[WorkPoint]]:
    """Return the Pareto front of each program's settings in time and error.

    The front of the own methods is the first one. In each front, the cheapest setting is the first one. Settings with
    errors of MAX_MEANINGFUL_ERROR or more are omitted.
    """
    by_program: dict[str, list[WorkPoint]] = {OWN_PROGRAM: []}
    for work in works:
        by_program.setdefault(program_name(work), []).append(work)
    names = [OWN_PROGRAM, *sorted(set(by_program) - {OWN_PROGRAM})]
    return {
        name: [work for work in find_pareto_front(by_program[name]) if work.error < MAX_MEANINGFUL_ERROR]
        for name in names
    }


def compare_engines(works: Iterable[WorkPoint], errors: Sequence[float] = ERROR_TARGETS) -> list[EngineComparison]:
    """Compare the programs by mesh and error, the largest error first.

    Args:
        works: simulations.
        errors: relative errors.
    """
    found = list[EngineComparison]()
    for mesh, here in list_engine_meshes(works).items():
        by_program = find_pareto_fronts(here)
        for error in errors:
            within = {name: [work for work in best if work.error <= error] for name, best in by_program.items()}
            found.append(EngineComparison(mesh, error, {name: front[0] for name, front in within.items() if front}))
    return found


def engine_names(works: Iterable[WorkPoint]) -> list[str]:
    """Return the sorted names of the engines that were measured."""
    return sorted({program_name(work) for work in works} - {OWN_PROGRAM})


def assign_program_styles(works: Iterable[WorkPoint]) -> dict[str, SeriesStyle]:
    """Assign a style to each program; the own methods are drawn in the text colour."""
    return {OWN_PROGRAM: SeriesStyle(TEXT_COLOUR, "o")} | {
        name: build_indexed_style(k)._replace(dash="-") for k, name in enumerate(engine_names(works))
    }


def format_markdown_table(works: Sequence[WorkPoint]) -> Iterator[str]:
    """Format the time ratios as a Markdown table.

    There is one row per mesh and error, one column per engine, and a column with the best own setting.
    """
    names = engine_names(works)
    if not names:
        return
    yield f"| mesh | error | {' | '.join(names)} | ours, a simulated second |"
    yield "|---|---|" + "---|" * (len(names) + 1)
    refused = {mesh: _find_unsupported(here) for mesh, here in list_engine_meshes(works).items()}
    for one in compare_engines(works):
        if one.fastest_by_program:
            cells = (_format_cell(one, name, refused[one.mesh]) for name in names)
            ours = one.fastest_by_program.get(OWN_PROGRAM)
            notes = (
                f"{ours.setting_label}: {format_duration(ours.seconds_per_simulated_second)}"
                if ours
                else "does not get there"
            )
            yield f"| {one.mesh} | {format_gap(one.error)} | {' | '.join(cells)} | {notes} |"


def describe_best_settings(works: Iterable[WorkPoint]) -> Iterator[str]:
    """Describe the fastest setting of each engine in sentences."""
    for one in compare_engines(works):
        for name, best in one.fastest_by_program.items():
            if name != OWN_PROGRAM:
                yield f"{one.mesh} to {format_gap(one.error)}, {name}: {best.setting_label}."


def _find_unsupported(works: Iterable[WorkPoint]) -> set[str]:
    """Find the programs all of whose runs are unsupported.

    They do not support the mesh's spring network, or are not installed.
    """
    by_program: dict[str, set[str]] = {}
    for work in works:
        by_program.setdefault(program_name(work), set()).add(work.status)
    return {name for name, statuses in by_program.items() if statuses == {"unsupported"}}


def _format_cell(one: EngineComparison, engine: str, refused: set[str]) -> str:
    if engine in refused:
        return "refused"
    ratio = one.time_ratio(engine)
    return format_factor(ratio) if ratio else "alone" if engine in one.fastest_by_program else "–"

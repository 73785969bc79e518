"""SQL over the published set, for templates of pages.

Each study is a view: `hard` has its runs, `winners` its units of work and precision. Tables with names of their own are
`<study>_blocks` and `<study>_rates`. Hyphens in names of studies become underscores. Views that are computed from the
rows are created when a query names them:

    <study>_outcomes   verified runs, one row each, classified by `springbench.harness.report.robustness`
    <study>_times      time and iteration of each curve to each gap of GAP_TARGETS, on steps with a certified minimum
    <study>_costs      cheapest simulation of each family of methods for each error, by mesh and stiffness number
    <study>_ratios     least time of each external engine over that of the own methods, by scene and error
    <study>_paper      own errors and those of Liu et al. 2013, by curve and iterations
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
from springbench.harness.errors import InputError, format_allowed_names
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.engine_comparison import OWN_PROGRAM, compare_engines
from springbench.harness.report.accuracy.liu2013_comparison import compare_with_paper
from springbench.harness.report.accuracy.time_to_accuracy import GAP_TARGETS, find_time_to_accuracy, is_solvable
from springbench.harness.report.accuracy.winner_map import build_winner_cells
from springbench.harness.report.robustness import CORRECT, UNSUPPORTED, read_verified_runs
from springbench.harness.results.published_set import (
    TABLE_FILES,
    PublishedStudy,
    find_changed_tables,
    list_studies,
    open_study_folder,
)


class PublishedQueries:
    """Queries over the studies of a published set."""

    def __init__(self, published: Path) -> None:
        self.studies = {study.study_name: study for study in list_studies(published)}
        self._names = {name.replace("-", "_"): study for name, study in self.studies.items()}
        self._computed: set[str] = set()
        self._connection = duckdb.connect(config={"threads": 1})
        for study in self.studies.values():
            self._create_views(study)

    def find_study(self, name: str) -> PublishedStudy:
        """Return the study of a name.

        Raises:
            InputError: if the published set has no study of this name.
        """
        if name not in self.studies:
            raise InputError(f"unknown study {name!r}; expected {format_allowed_names(name, self.studies)}")
        return self.studies[name]

    def query_records(self, sql: str) -> list[dict[str, Any]]:
        """Return the rows of a query as dictionaries.

        Raises:
            InputError: if the query fails.
        """
        for name, study, build in _COMPUTED_VIEW.findall(sql):
            if name not in self._computed and study in self._names:
                self._computed.add(name)
                rows = COMPUTED_VIEWS[build](self._names[study])
                self._connection.register(name, pa.Table.from_pylist(list(rows)))
        try:
            done = self._connection.execute(sql)
            names = [column[0] for column in done.description or ()]
            return [dict(zip(names, row, strict=True)) for row in done.fetchall()]
        except duckdb.Error as error:
            raise InputError(f"the query {' '.join(sql.split())!r:.200} fails: {error}") from error

    def _create_views(self, study: PublishedStudy) -> None:
        if changed := find_changed_tables(study):
            raise InputError(f"{changed[0]} differs from its checksum in study.json; restore it or publish it again")
        name = study.study_name.replace("-", "_")
        for table in TABLE_FILES:
            if study.find_table(table):
                suffix = f"_{table}" if table in ("blocks", "rates") else ""
                self._connection.register(f"{name}{suffix}", study.read_table(table))


def list_outcomes(study: PublishedStudy) -> Sequence[dict[str, Any]]:
    """List the outcomes of the verified runs of a study."""
    with open_study_folder(study) as folder:
        cells = read_verified_runs(folder)
    return [
        {
            "case_name": cell.case,
            "scene": cell.case.partition(" ")[0],
            "family": cell.case.partition("-")[0],
            "solver": cell.solver,
            "outcome": cell.outcome.label,
            "is_right": cell.outcome is CORRECT,
            "is_supported": cell.outcome is not UNSUPPORTED,
            "same_motion": cell.same_motion,
            "energy_excess": cell.energy_excess,
            "has_other_motion": cell.has_other_motion,
            "has_lowest_energy": cell.has_lowest_energy,
            "worst_error": cell.worst_error,
            "reason": cell.reason,
        }
        for cell in cells
    ]


def list_times(study: PublishedStudy) -> Sequence[dict[str, Any]]:
    """List the times to GAP_TARGETS of all curves of a study [s].

    The time is None if a curve does not reach the gap. Steps without a certified minimum are omitted.
    """
    with open_study_folder(study) as folder:
        curves = read_accuracy(folder).curves
    return [
        {
            "study": study.study_name,
            "step": curve.problem.problem_label,
            "scene": curve.problem.scene,
            "size": curve.problem.size,
            "stiffness_number": curve.problem.stiffness_ratio,
            "initial_guess": curve.initial_guess,
            "solver": curve.label,
            "gap": gap,
            "seconds": reached.seconds if reached else None,
            "iteration": reached.iteration if reached else None,
        }
        for curve in curves
        for gap in GAP_TARGETS
        if is_solvable(curve.problem, gap)
        for reached in (find_time_to_accuracy(curve, gap),)
    ]


def list_costs(study: PublishedStudy) -> Sequence[dict[str, Any]]:
    """List the cost of the cheapest simulation of each family, by mesh and error.

    Costs are processor seconds per simulated second. The cheapest family of a mesh and an error has rank 1.
    """
    with open_study_folder(study) as folder:
        cells = build_winner_cells(read_accuracy(folder).work_points)
    return [
        {
            "vertices": cell.vertices,
            "stiffness_number": cell.stiffness_number,
            "error": cell.error,
            "family": family,
            "solver": work.solver,
            "setting": work.setting_label,
            "cpu_seconds": work.cpu_seconds_per_simulated_second,
            "rank": rank,
        }
        for cell in cells
        for rank, (family, work) in enumerate(
            sorted(cell.cheapest_by_family.items(), key=lambda item: item[1].cpu_seconds_per_simulated_second), 1
        )
    ]


def list_engine_ratios(study: PublishedStudy) -> Sequence[dict[str, Any]]:
    """List the ratios of each engine's least time to that of the own methods.

    Errors that either does not reach are omitted.
    """
    with open_study_folder(study) as folder:
        works = read_accuracy(folder).work_points
    return [
        {"scene": best.scene, "error": one.error, "engine": engine, "ratio": one.time_ratio(engine)}
        for one in compare_engines(works)
        for engine, best in one.fastest_by_program.items()
        if engine != OWN_PROGRAM and one.time_ratio(engine)
    ]


def list_paper_errors(study: PublishedStudy) -> Sequence[dict[str, Any]]:
    """List own relative errors and those of the paper, at the points that both have."""
    with open_study_folder(study) as folder:
        return [one._asdict() for one in compare_with_paper(read_accuracy(folder))]


COMPUTED_VIEWS: dict[str, Callable[[PublishedStudy], Sequence[dict[str, Any]]]] = {
    "outcomes": list_outcomes,
    "times": list_times,
    "costs": list_costs,
    "ratios": list_engine_ratios,
    "paper": list_paper_errors,
}
"""Functions that compute the rows of views, by the ends of their names."""

_COMPUTED_VIEW = re.compile(rf"\b((\w+)_({'|'.join(COMPUTED_VIEWS)}))\b")

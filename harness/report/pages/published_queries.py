"""SQL over the published set, for templates of pages.

Each study is a view: `hard` has its runs, `winners` its units of work and precision. Tables with names of their own are
`<study>_blocks` and `<study>_rates`. A study of verified runs has `<study>_outcomes`, one row per run, classified by
`springbench.harness.report.robustness`. Hyphens in names of studies become underscores.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
from springbench.harness.errors import InputError
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
        self._connection = duckdb.connect(config={"threads": 1})
        for study in self.studies.values():
            self._create_views(study)

    def query_records(self, sql: str) -> list[dict[str, Any]]:
        """Return the rows of a query as dictionaries. Raises InputError if the query fails."""
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
        if study.find_table("rows") and "stationarity" in study.read_table("rows").column_names:
            self._connection.register(f"{name}_outcomes", pa.Table.from_pylist(list_outcomes(study)))


def list_outcomes(study: PublishedStudy) -> Sequence[dict[str, Any]]:
    """List the outcomes of the verified runs of a study: case, family of cases, solver, outcome and worst error."""
    with open_study_folder(study) as folder:
        cells = read_verified_runs(folder)
    return [
        {
            "case_name": cell.case,
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

"""Reference page of the columns of all rows, from their definitions."""

from __future__ import annotations

from collections.abc import Iterable

from springbench.harness.cli.reference_pages.markdown_text import format_table
from springbench.harness.experiments.ablation.ablation_schema import ABLATION_COLUMNS
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_COLUMNS
from springbench.harness.report.robustness import RUN_OUTCOMES
from springbench.harness.results.run_schema import RUN_COLUMNS, ColumnSpec

_INTRODUCTION = """# Columns

For readers of Parquet files and writers of queries: the columns of the three tables `rows`, `accuracy` and `ablation`.

[Rows of a run](#rows-of-a-run), [rows of an accuracy study](#rows-of-an-accuracy-study), [rows of an
ablation](#rows-of-an-ablation), [outcomes](#outcomes-of-verified-runs). [SQL over rows](../howto/sql-over-rows.md)
shows how to use them."""

_RUN_TEXT = """## Rows of a run

Each measured time is a row. `phase` names what was timed: `prepare`, `step` (a whole time step in a timed pass, which
records nothing), `local` and `global` (the two halves of a frame's first iteration, timed in a pass of their own).
Energies, strains and digests come from a second, untimed pass, which must end at bitwise identical positions. A failed
run is one row with the phase `run`, a status and a reason."""

_ACCURACY_TEXT = """## Rows of an accuracy study

Columns that are not listed here have the meaning that they have in rows of a run. The gap of an iterate is
(g - g*)/(g0 - g*), with g its `objective` and g* the lowest `objective` of the known minima."""

_ABLATION_TEXT = """## Rows of an ablation

Columns that are not listed here have the meaning that they have in rows of a run."""

_OUTCOME_TEXT = """## Outcomes of verified runs

`springbench report` gives each verified run one outcome, from its rows. [Certificates](../explanation/certificates.md)
explains the checks."""


def build_column_page() -> str:
    """Build the page of the columns of rows, accuracy studies and ablations."""
    return "\n\n".join(
        [
            _INTRODUCTION,
            _RUN_TEXT,
            _format_columns(RUN_COLUMNS),
            _ACCURACY_TEXT,
            _format_columns(one for one in ACCURACY_COLUMNS if one not in RUN_COLUMNS),
            _ABLATION_TEXT,
            _format_columns(one for one in ABLATION_COLUMNS if one not in RUN_COLUMNS),
            _OUTCOME_TEXT,
            format_table(("outcome", "meaning"), ((one.label, one.description) for one in RUN_OUTCOMES)),
        ]
    )


def _format_columns(columns: Iterable[ColumnSpec]) -> str:
    rows = ((f"`{one.name}`", str(one.type), one.unit, one.description) for one in columns)
    return format_table(("column", "type", "unit", "meaning"), rows)

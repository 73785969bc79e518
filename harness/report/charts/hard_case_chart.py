"""Chart of verified runs: shares of correct runs, and maps of solvers x cases.

There is a map for each family of cases.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CellOutcome,
    MapCell,
    describe_stale_cells,
)
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle, assign_solver_styles
from springbench.harness.report.robustness import (
    CORRECT,
    MAP_NOTE,
    MOTION_MARK,
    RUN_OUTCOMES,
    SolverScore,
    VerifiedRun,
    score_solvers,
)

HARD_CASE_TITLE = "Hard cases"
_SHARE_NOTE = f"Marks: runs that are {CORRECT.label}; lines reach to the share that stayed finite. Of runs not refused."
_MOTION_NOTE = f"{MOTION_MARK}: right, by other minima than the reference."
_FINITE_MARKER = "|"


def build_hard_case_chart(
    cells: Sequence[VerifiedRun], stale_ids: Collection[str] = (), machine_words: str = ""
) -> ChartDescription:
    """Build the chart of a sweep.

    Args:
        cells: verified runs.
        stale_ids: ids of runs that other code executed.
        machine_words: provenance of the rows.
    """
    scores = sorted(score_solvers(cells), key=lambda score: -(score.correct_share or 0.0))
    mixed = {cell.solver for cell in cells if cell.run_id in stale_ids}
    frame = ChartFrame(
        group=("shares",),
        name=("right",),
        subject=f"{len({cell.case for cell in cells})} cases",
        title="",
        series=[*_build_share_series(scores, mixed)],
        notes=[_SHARE_NOTE, *([STALE_NOTE] if mixed else [])],
    )
    return ChartDescription(
        title=HARD_CASE_TITLE,
        note=f"{MAP_NOTE} {_MOTION_NOTE}",
        frames=[frame],
        x=(ChartAxis("share", AxisScale("share of the cases", "linear", "percent")),),
        y=(ChartAxis("place", AxisScale("", "names", place_names=tuple(score.solver for score in scores))),),
        subject_key="cases",
        maps=[*_build_maps(cells, stale_ids, machine_words)],
        hover=(("share_low", "right"), ("share_high", "finite"), ("worst_error", "worst error")),
        machine_words=machine_words,
        citations={cell.solver: cell.citation for cell in cells},
        command="springbench run CONFIG",
    )


def _build_share_series(scores: Sequence[SolverScore], stale_solvers: Collection[str]) -> Iterator[ChartSeries]:
    """Yield, for each solver, the shares of correct and of finite runs."""
    styles = assign_solver_styles(score.worst_run.solver_name for score in scores)
    for place, score in enumerate(scores):
        style = styles[score.worst_run.solver_name]
        shared = {"place": [float(place)], "worst_error": [score.worst_run.error_text]}
        ends = {"share_low": [score.correct_share], "share_high": [score.finite_share]}
        stale, words = score.solver in stale_solvers, f"{sum(score.outcome_counts)} cases"
        right = shared | ends | {"share": [score.correct_share]}
        yield ChartSeries(score.solver, style, right, words, stale, is_connected=False, setting="right")
        finite = shared | {"share": [score.finite_share]}
        bar = SeriesStyle(style.color, _FINITE_MARKER)
        yield ChartSeries(score.solver, bar, finite, words, stale, is_connected=False, setting="finite")


def _build_maps(cells: Sequence[VerifiedRun], stale_ids: Collection[str], machine_words: str) -> Iterator[CellMap]:
    for family in dict.fromkeys(_split_case(cell)[0] for cell in cells):
        mine = [cell for cell in cells if _split_case(cell)[0] == family]
        drawn = [_build_cell(cell, is_stale=cell.run_id in stale_ids) for cell in mine]
        marked = any(cell.mark for cell in drawn)
        yield CellMap(
            group=("map",),
            name=(family,),
            subject="",
            title=family,
            cells=drawn,
            outcomes=[CellOutcome(*outcome) for outcome in RUN_OUTCOMES],
            notes=[*([_MOTION_NOTE] if marked else []), *describe_stale_cells(drawn)],
            machine_words=machine_words,
        )


def _build_cell(cell: VerifiedRun, *, is_stale: bool) -> MapCell:
    return MapCell(
        row=_split_case(cell)[1],
        column=cell.solver,
        outcome=cell.outcome.label,
        color=cell.outcome.color,
        value_text=cell.error_text,
        is_stale=is_stale,
        mark=MOTION_MARK if cell.has_other_motion else "",
        reason=cell.reason,
        run_id=cell.run_id,
    )


def _split_case(cell: VerifiedRun) -> tuple[str, str]:
    """Split the name of a case into its family and the rest."""
    family, _, rest = cell.case.partition("-")
    return family, rest or cell.case

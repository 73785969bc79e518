"""Kinds of figures: the rows that each needs, its panels, and how they are prepared."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from springbench.harness.errors import InputError, InputMistake, RunFailed, SpringbenchError, format_allowed_names
from springbench.harness.report.charts.chart_description import ChartDescription, select_curve_plots, select_panels
from springbench.harness.report.charts.figure_panels import CellMap, FigurePanel, MeshPicture, merge_cell_maps
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.solvers.plugins.plugin_discovery import load_target

if TYPE_CHECKING:
    import pyarrow as pa

# What reads results and builds charts is imported where it is called: a kind needs a few modules of a hundred.

StaleFinder = Callable[["pa.Table"], Collection[str]]
"""Returns the ids of the runs in a table of rows that were measured by other code than the current version."""


class FigureKind(NamedTuple):
    """A kind of figure.

    Attributes:
        title: title of the figure.
        required_rows: description of the rows that it is drawn from.
        list_panels: returns the panels of a folder of results by name, given a function that finds stale runs.
        default_panels: selectors that apply if the command line gives none.
        prepare_panels: builds the panels from the selected entries.
    """

    title: str
    required_rows: str
    list_panels: Callable[[Path, StaleFinder], list[PanelEntry]]
    default_panels: tuple[tuple[str, ...], ...] = ((),)
    prepare_panels: Callable[[Sequence[PanelEntry]], list[FigurePanel]] = lambda entries: [
        entry.build_panel() for entry in entries
    ]


def _list_from(module: str, function: str) -> Callable[..., list[PanelEntry]]:
    """Return a function of a module of figures, which is imported on the first call."""
    return lambda *arguments: getattr(import_module(f"springbench.harness.report.figures.{module}"), function)(
        *arguments
    )


def _align_mesh_pictures(entries: Sequence[PanelEntry]) -> list[FigurePanel]:
    from springbench.harness.report.figures import mesh_panels

    pictures = [panel for panel in (entry.build_panel() for entry in entries) if isinstance(panel, MeshPicture)]
    return [
        one
        for _, of in groupby(pictures, lambda picture: picture.subject)
        for one in mesh_panels.align_pictures(list(of))
    ]


def _prepare_scene_sheet(entries: Sequence[PanelEntry]) -> list[FigurePanel]:
    from springbench.harness.report.figures import mesh_panels

    return [
        *mesh_panels.build_scene_sheet(
            [panel for panel in (e.build_panel() for e in entries) if isinstance(panel, MeshPicture)]
        )
    ]


def _merge_cell_maps(entries: Sequence[PanelEntry]) -> list[FigurePanel]:
    """Merge the families of hard cases into one map."""
    panels = [entry.build_panel() for entry in entries]
    grids = [panel for panel in panels if isinstance(panel, CellMap)]
    rest = [panel for panel in panels if not isinstance(panel, CellMap)]
    return [*rest, *merge_cell_maps(grids)]


def _without_stale(
    panels: Callable[[Path], list[PanelEntry]],
) -> Callable[[Path, StaleFinder], list[PanelEntry]]:
    def read(folder: Path, older: StaleFinder) -> list[PanelEntry]:
        return panels(folder)

    return read


def _list_accuracy_panels(name: str) -> Callable[[Path, StaleFinder], list[PanelEntry]]:
    """Return a function that lists the panels of a chart of an accuracy measurement."""

    def build_chart(folder: Path) -> ChartDescription:
        from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
        from springbench.harness.report.charts.chart_table import build_compared_chart

        return build_compared_chart(name, read_accuracy(folder))

    return _list_chart_panels(build_chart)


def _list_chart_panels(
    build_chart: Callable[[Path], ChartDescription],
) -> Callable[[Path, StaleFinder], list[PanelEntry]]:
    return _without_stale(lambda folder: entries_from_panels(select_panels(build_chart(folder))))


def _build_effect_chart(folder: Path) -> ChartDescription:
    from springbench.harness.report.ablation_summary import read_ablations
    from springbench.harness.report.charts.ablation_charts import build_effect_chart

    return build_effect_chart(read_ablations(folder, "ablated"))


def _build_overhead_chart(folder: Path) -> ChartDescription:
    from springbench.harness.report.ablation_summary import read_ablations
    from springbench.harness.report.charts.ablation_charts import build_overhead_chart

    return build_overhead_chart([row for rows in read_ablations(folder, "overhead").values() for row in rows])


def _build_device_chart(folder: Path) -> ChartDescription:
    from springbench.harness.report.charts.device_chart import build_device_chart
    from springbench.harness.report.device_speedup import read_device_runs
    from springbench.harness.report.figures.timing_panels import read_sweep_rows

    return build_device_chart(read_device_runs(read_sweep_rows(folder)))


def _list_hard_case_panels(folder: Path, find_stale: StaleFinder) -> list[PanelEntry]:
    from springbench.harness.report.charts.hard_case_chart import build_hard_case_chart
    from springbench.harness.report.figures.timing_panels import read_sweep_rows
    from springbench.harness.report.provenance_words import PROVENANCE_COLUMNS, describe_provenance
    from springbench.harness.report.robustness import read_verified_runs

    table = read_sweep_rows(folder)
    provenance = describe_provenance(table.select(PROVENANCE_COLUMNS).to_pylist())
    return entries_from_panels(
        select_panels(build_hard_case_chart(read_verified_runs(folder), find_stale(table), provenance))
    )


def _list_benchmark_panels(folder: Path) -> list[PanelEntry]:
    """Build a panel for each benchmark with enough results, the largest change first."""
    from springbench.harness.report.change_detection import MIN_RESULTS, find_stored_files, read_histories
    from springbench.harness.report.charts.benchmark_chart import RATIO_CHART, TIME_CHART, build_benchmark_chart

    known = [one for one in read_histories(find_stored_files([folder])) if len(one.points) >= MIN_RESULTS]
    charts = (build_benchmark_chart(RATIO_CHART if one.is_ratio else TIME_CHART, [one]) for one in known)
    return entries_from_panels(plot for chart in charts for plot in select_curve_plots(chart))


_ACCURACY_ROWS, _SWEEP_ROWS = "rows of `springbench accuracy CONFIG`", "rows of `springbench run CONFIG`"
_BENCHMARK_RESULTS = "6 stored results of a benchmark, by `pytest tests/bench --benchmark-only` at as many commits"
_GAP_PANELS = (("gap", "time"), ("gap", "iterations"))
_PROFILE_PANELS = tuple(("performance", gap) for gap in ("1e-1", "1e-3", "1e-6"))

FIGURE_KINDS: dict[str, FigureKind] = {
    "convergence": FigureKind("Convergence", _ACCURACY_ROWS, _list_accuracy_panels("convergence"), _GAP_PANELS),
    "times": FigureKind(
        "Time to accuracy",
        _ACCURACY_ROWS,
        _list_accuracy_panels("times"),
        (("alone",), ("over-1",)),
    ),
    "winners": FigureKind(
        "The cheapest method family for an error",
        f"{_ACCURACY_ROWS}, by two families",
        _list_accuracy_panels("winners"),
    ),
    "engines": FigureKind(
        "Outside engines compared with springbench", f"{_ACCURACY_ROWS}, with engines", _list_accuracy_panels("engines")
    ),
    "work": FigureKind("Work and precision", _ACCURACY_ROWS, _list_accuracy_panels("work")),
    "profiles": FigureKind("Profiles", _ACCURACY_ROWS, _list_accuracy_panels("profiles"), _PROFILE_PANELS),
    "growth": FigureKind("Growth with size", _ACCURACY_ROWS, _list_accuracy_panels("growth")),
    "liu2013": FigureKind(
        "Liu et al. 2013, reproduced",
        f"{_ACCURACY_ROWS}, of liu2013.yaml",
        _list_accuracy_panels("liu2013"),
    ),
    "timing": FigureKind(
        "Time a step", _SWEEP_ROWS, _list_from("timing_panels", "list_timing_panels"), (("step",), ("prepare",))
    ),
    "hard": FigureKind(
        "Hard cases",
        f"{_SWEEP_ROWS} with `verify: true`",
        _list_hard_case_panels,
        (("shares",),),
        _merge_cell_maps,
    ),
    "ablation": FigureKind(
        "What effects cost", "rows of `springbench ablate SCENE`", _list_chart_panels(_build_effect_chart)
    ),
    "prices": FigureKind(
        "The price of effects",
        "rows of `springbench ablate SCENE --all-solvers`",
        _list_chart_panels(_build_overhead_chart),
        (("map",),),
    ),
    "speed": FigureKind(
        "Speed",
        "rows of `springbench roofline CONFIG`",
        _without_stale(_list_from("timing_panels", "list_speed_panels")),
        (("step",), ("global",)),
    ),
    "devices": FigureKind(
        "What a device saves",
        f"{_SWEEP_ROWS} on a device, to a residual",
        _list_chart_panels(_build_device_chart),
    ),
    "run": FigureKind(
        "The mesh at the end",
        f"{_SWEEP_ROWS} with recordings",
        _without_stale(_list_from("mesh_panels", "list_last_frame_panels")),
        prepare_panels=_align_mesh_pictures,
    ),
    "comparison": FigureKind(
        "Solvers side by side",
        f"{_SWEEP_ROWS} with recordings",
        _without_stale(_list_from("mesh_panels", "list_solver_comparison_panels")),
        prepare_panels=_align_mesh_pictures,
    ),
    "scenes": FigureKind(
        "Scenes at their end",
        f"{_SWEEP_ROWS} with recordings",
        _without_stale(_list_from("mesh_panels", "list_scene_panels")),
        prepare_panels=_prepare_scene_sheet,
    ),
    "history": FigureKind(
        "Results of a benchmark, by commit",
        _BENCHMARK_RESULTS,
        _without_stale(_list_benchmark_panels),
    ),
}


def find_figure_kind(name: str) -> FigureKind:
    """Find the kind of figure with this name.

    An installed report with a `panels` attribute is a kind too.

    Raises:
        InputError: if there is no such kind.
    """
    if name in FIGURE_KINDS:
        return FIGURE_KINDS[name]
    from springbench.harness.config.sweep_config import REPORT_TABLE

    known = {*FIGURE_KINDS, *(other for other in REPORT_TABLE if other not in REPORT_TABLE.builtin_tables[0])}
    if name not in known:
        raise InputError(InputMistake(f"got {name!r}; expected {format_allowed_names(name, known)}", key="KIND"))
    report: Any = load_target(REPORT_TABLE[name])
    if not callable(getattr(report, "panels", None)):
        why = f"the report {name!r} draws no figure; expected one that has `panels(rows)`, which returns panels"
        raise InputError(InputMistake(why, key="KIND"))
    return FigureKind(name, _SWEEP_ROWS, _without_stale(partial(_plugin_entries, name, report)))


def _plugin_entries(name: str, report: Any, folder: Path) -> list[PanelEntry]:
    from springbench.harness.report.figures.timing_panels import read_sweep_rows

    table = read_sweep_rows(folder)
    try:
        panels: Iterable[FigurePanel] = report.panels(table)
        return entries_from_panels(panels)
    except (SpringbenchError, OSError):
        raise
    except Exception as error:  # user code may raise any exception
        raise RunFailed(f"the report {name} failed: {type(error).__name__}: {error}") from error

# pyright: reportUnknownMemberType=false
# Jinja2's and Matplotlib's stubs do not type most members.
"""Templates of pages: Markdown with fields that queries over the published set fill.

A template is a Jinja2 file next to its page: `hard-cases.md.j2` makes `hard-cases.md`. It has these functions:

    value(sql)         the single value of a query
    rows(sql)          its rows as mappings
    table(sql)         its rows as a table of Markdown, with the columns' names as heading
    bars, lines, heatmap(name, title, sql, alt, ...)
                       a link to a picture, drawn from the columns series, x, y, low and high; `order` selects
                       and orders the series, the other options are those of `PageChartOptions`
    figure(name, title, kind, study, alt, panels)
                       a link to a picture of a kind that `springbench figure` draws
    provenance(study)  command, machine, load, date and commit of a study, in one line; with a remark if `study.json`
                       has the key `record`: its rows were copied, because the measured ones were not stored
    has_study(study)   whether the published set has a study

and the filters `percent`, `sig(digits)` and `count`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.charts.figure_panels import FigurePanel
from springbench.harness.report.figures.figure_kinds import find_figure_kind
from springbench.harness.report.figures.figure_layout import compose_figure
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.figures.panel_selection import select_entries
from springbench.harness.report.pages.page_charts import ChartForm, ChartPoint, PageChartOptions, build_page_panel
from springbench.harness.report.pages.published_queries import PublishedQueries
from springbench.harness.report.provenance_words import abbreviate_commit
from springbench.harness.results.published_set import open_study_folder

TEMPLATE_SUFFIX = ".md.j2"
_CHART_WIDTH = 132.0
"""Width of a chart [mm]: at 85 mm its type is 6 points high."""
PICTURE_FOLDER = "pictures"
"""Folder of a page's pictures, next to the page."""


@dataclass(frozen=True, slots=True)
class PagePicture:
    """Picture of a page.

    Attributes:
        digest: digest of the data, texts and width of the picture.
        draw_png: draws the picture, and returns the content of the PNG file.
    """

    path: Path
    digest: str
    draw_png: Callable[[], bytes]


@dataclass(frozen=True, slots=True)
class RenderedPage:
    """Page made of a template: its path, its text and its pictures."""

    path: Path
    text: str
    pictures: Sequence[PagePicture]


@dataclass(slots=True)
class _PageFields:
    """Functions that a template calls; they collect the page's pictures."""

    page: Path
    queries: PublishedQueries
    pictures: list[PagePicture] = field(default_factory=list[PagePicture])

    def query_value(self, sql: str) -> Any:
        found = self.queries.query_records(sql)
        if len(found) != 1 or len(found[0]) != 1:
            columns = len(found[0]) if found else 0
            raise InputError(
                f"value() expected one value; the query {' '.join(sql.split())!r:.200} gives {len(found)} rows of "
                f"{columns} columns: select one column, and one row by WHERE or an aggregate"
            )
        return next(iter(found[0].values()))

    def build_table(self, sql: str, digits: int = 3) -> str:
        found = self.queries.query_records(sql)
        if not found:
            raise InputError(
                f"table() expected rows; the query {' '.join(sql.split())!r:.200} gives none: correct its WHERE"
            )
        names = list(found[0])
        numeric = [all(isinstance(row[name], int | float | None) for row in found) for name in names]
        lines = [" | ".join(name.replace("_", " ") for name in names)]
        lines.append(" | ".join("---:" if right else "---" for right in numeric))
        lines += [" | ".join(_format_cell(row[name], digits) for name in names) for row in found]
        return "\n".join(f"| {line} |" for line in lines)

    def add_chart(
        self, form: ChartForm, name: str, title: str, sql: str, alt: str, order: Sequence[str] = (), **options: Any
    ) -> str:
        points = [_build_point(row) for row in self.queries.query_records(sql)]
        if order:
            points = sorted((p for p in points if p.series in order), key=lambda p: order.index(p.series))
        if not points:
            raise InputError(f"the picture {name} has no points; its query has no rows")
        panel = build_page_panel(name, form, points, PageChartOptions(**options))
        return self._add_panels(name, alt, title, [panel], _CHART_WIDTH)

    def add_figure(
        self, name: str, title: str, kind: str, study: str, alt: str, panels: str = "", width: float = 170.0
    ) -> str:
        found = find_figure_kind(kind)
        with open_study_folder(self.queries.find_study(study)) as folder:
            entries = found.list_panels(folder, lambda table: set())
            selectors = [tuple(one.split(":")) for one in panels.split(",") if one] or found.default_panels
            drawn = found.prepare_panels(select_entries(entries, selectors))
        return self._add_panels(name, alt, title, drawn, width)

    def describe_study(self, study: str) -> str:
        about = self.queries.find_study(study).metadata
        started = about["started"]
        date = started[-1][:10] if started else "undated"
        commits = ", ".join(map(abbreviate_commit, about["commits"])) or "unknown"
        machines = [f"{one['cpu']}, {one['cores']} core{'s' * (one['cores'] != 1)}" for one in about["machines"]]
        where = " and ".join(dict.fromkeys(machines))  # machines may differ only in their operating system
        requested = about.get("requested_runs")
        count = f"{about['runs']:,}" + (f" of {requested:,}" if requested else "")
        loads = [f"{load:.0f}" for load in about.get("load_average", ())]
        load = f", load {' to '.join(dict.fromkeys(loads))}" if loads else ""
        return f"Data: `{about['command']}`, {count} runs, {where}{load}, {date}, commit {commits}."

    def _add_panels(self, name: str, alt: str, title: str, panels: Sequence[FigurePanel], width: float) -> str:
        path = self.page.parent / PICTURE_FOLDER / f"{name}.png"
        if any(picture.path == path for picture in self.pictures):
            raise InputError(f"the picture name {name} is used twice; rename one of them")
        options = FigureOptions(width_mm=width, formats=("png",), font_size=9.0)
        digest = digest_panels(panels, title, width)
        self.pictures.append(PagePicture(path, digest, lambda: _draw_panels(panels, title, options)))
        return f"![{alt}]({PICTURE_FOLDER}/{name}.png)"


def render_page(template: Path, queries: PublishedQueries) -> RenderedPage:
    """Render a template.

    Args:
        template: file with the suffix TEMPLATE_SUFFIX.
        queries: the published set.

    Raises:
        InputError: if the template has a mistake; the message names the template, and the line of a syntax error.
    """
    page = template.with_name(template.name.removesuffix(TEMPLATE_SUFFIX) + ".md")
    collector = _PageFields(page, queries)
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.globals |= {
        "value": collector.query_value,
        "rows": queries.query_records,
        "table": collector.build_table,
        "figure": collector.add_figure,
        "provenance": collector.describe_study,
        "has_study": queries.studies.__contains__,
    }
    for form in ("bars", "lines", "heatmap"):
        environment.globals[form] = _bind_form(collector, form)
    environment.filters |= {"percent": _format_percent, "sig": _format_significant, "count": _format_count}
    source = template.read_text(encoding="utf-8")
    try:
        text = environment.from_string(source).render()
    except InputError as error:
        raise InputError([InputMistake(one.problem, template) for one in error.mistakes]) from error
    except jinja2.TemplateSyntaxError as error:
        raise InputError(InputMistake(f"{error.message}; see the docs of Jinja2", template, error.lineno)) from error
    except (jinja2.TemplateError, TypeError, KeyError) as error:
        raise InputError(InputMistake(f"a field fails: {type(error).__name__}: {error}", template)) from error
    head = f"<!-- Made by `springbench pages` from {template.name}: edit that file. -->\n"
    return RenderedPage(page, head + text, collector.pictures)


def _bind_form(collector: _PageFields, form: Any) -> Callable[..., str]:
    def add_chart_of_form(name: str, title: str, sql: str, alt: str, **options: Any) -> str:
        return collector.add_chart(form, name, title, sql, alt, **options)

    return add_chart_of_form


def _build_point(row: Mapping[str, Any]) -> ChartPoint:
    """Build a point from a row of a query; decimals of SQL become float."""
    x, *numbers = (row.get(name) for name in ("x", "y", "low", "high"))
    place = x if isinstance(x, str) else float(x or 0.0)
    return ChartPoint(str(row["series"]), place, *(None if value is None else float(value) for value in numbers))


def _format_cell(value: Any, digits: int) -> str:
    if value is None:
        return ""
    return _format_significant(value, digits) if isinstance(value, float) else str(value)


def _format_percent(value: float, digits: int = 0) -> str:
    return f"{100 * value:.{digits}f} %"


def _format_significant(value: float, digits: int = 3) -> str:
    return f"{float(f'{value:.{digits}g}'):g}"  # 250 instead of 2.5e+02


def _format_count(value: int) -> str:
    return f"{value:,}"


def digest_panels(panels: Sequence[FigurePanel], title: str, width: float) -> str:
    """Digest everything that a picture shows.

    Args:
        panels: panels of the picture.
        title: its title.
        width: its width [mm].
    """
    shown = [title, width, *panels]
    return sha256(json.dumps(shown, default=_encode_for_digest).encode()).hexdigest()


def _encode_for_digest(value: Any) -> Any:
    """Encode a panel or one of its parts for a digest.

    The renderer of a mesh is omitted, because the mesh determines it.
    """
    if is_dataclass(value):
        return {one.name: getattr(value, one.name) for one in fields(value) if one.name != "render"}
    return value.tolist() if isinstance(value, np.ndarray) else str(value)


def _draw_panels(panels: Sequence[FigurePanel], title: str, options: FigureOptions) -> bytes:
    from io import BytesIO

    import matplotlib
    from springbench.harness.report.figures.figure_layout import FIGURE_RC

    content = BytesIO()
    figure = compose_figure(panels, title, options)
    with matplotlib.rc_context(FIGURE_RC):
        figure.savefig(content, format="png", dpi=160, metadata={"Software": "springbench"})
    return content.getvalue()


def find_templates(root: Path) -> list[Path]:
    """Find the templates of a checkout, sorted; hidden folders are skipped."""
    folders = [path for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")]
    return sorted({*root.glob(f"*{TEMPLATE_SUFFIX}"), *chain(*(f.rglob(f"*{TEMPLATE_SUFFIX}") for f in folders))})


def index_pictures(pages: Sequence[RenderedPage], root: Path) -> Mapping[str, PagePicture]:
    """Return the pictures of pages by their path relative to the root.

    Args:
        pages: rendered pages.
        root: folder that contains all of their pictures.
    """
    return {picture.path.relative_to(root).as_posix(): picture for page in pages for picture in page.pictures}

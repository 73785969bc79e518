"""What the rows of a sweep say about each run, in milliseconds, and the table that ends a sweep."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import duckdb
import numpy as np
import pyarrow as pa
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from harness.report.page import count, quantity
from harness.report.references import cited


class RunTimes(NamedTuple):
    """One run: what it was, and its times [ms]; None where the rows do not say.

    cold and warm: of preparing; step: median, its quartiles and the least of all steps; local, global_:
    medians of one such step; iterations: median of a step; residual [J^(1/2)]: of the last step;
    largest_strain: of the whole run; interrupted: whether steps were, in any round; adds_up: whether the phases add up
    to an iteration. The fields are the columns of `_SUMMARY`, in order.
    """

    run_id: str
    scene: str
    size: int
    solver: str
    vertices: int | None
    springs: int | None
    status: str
    reason: str | None
    settings: str
    parameters: str | None
    cold: float | None
    warm: float | None
    step: float | None
    lower: float | None
    upper: float | None
    least: float | None
    local: float | None
    global_: float | None
    iterations: float | None
    residual: float | None
    largest_strain: float | None
    interrupted: bool | None
    adds_up: bool | None


_SUMMARY = """
select run_id, any_value(scene), any_value("size"), any_value(solver), any_value(vertices), any_value(springs),
    coalesce(any_value(status) filter (status <> 'ok'), 'ok'), any_value(reason) filter (status <> 'ok'),
    any_value(to_json({'integrator': integrator, 'dt': time_step, 'guess': first_guess, 'iterations': max_iterations,
                       'tolerance': tolerance, 'threads': threads})),
    any_value(parameters),
    1e3 * min(seconds) filter (phase = 'prepare' and round = 0),
    1e3 * median(seconds) filter (phase = 'prepare' and round > 0),
    1e3 * median(seconds) filter (phase = 'step'),
    1e3 * quantile_cont(seconds, 0.25) filter (phase = 'step'),
    1e3 * quantile_cont(seconds, 0.75) filter (phase = 'step'),
    1e3 * min(seconds) filter (phase = 'step'),
    1e3 * median(seconds) filter (phase = 'local'),
    1e3 * median(seconds) filter (phase = 'global'),
    median(iterations) filter (phase = 'step'),
    arg_max(residual, frame) filter (phase = 'step'),
    max(largest_strain), bool_or(interrupted) filter (phase = 'step'), bool_and(adds_up)
from numbered group by run_id order by min(place)
"""


def runs(table: pa.Table) -> list[RunTimes]:
    """The runs in a table of rows (schema: `harness.base.columns.SCHEMA`), in the order of their first rows."""
    numbered = table.append_column("place", pa.array(np.arange(len(table))))
    with duckdb.connect() as connection:
        connection.register("numbered", numbered)
        return [RunTimes(*row) for row in connection.execute(_SUMMARY).fetchall()]


def labels(found: Sequence[RunTimes]) -> dict[str, str]:
    """By run id, the solver's name and those of its settings in which the solver's runs differ."""
    settings = {run.run_id: {**json.loads(run.settings), **json.loads(run.parameters or "{}")} for run in found}
    values: dict[tuple[str, str], set[str]] = defaultdict(set)
    for run in found:
        for key, value in settings[run.run_id].items():
            values[run.solver, key].add(str(value))
    return {
        run.run_id: ", ".join(
            [run.solver]
            + [f"{key} {value}" for key, value in settings[run.run_id].items() if len(values[run.solver, key]) > 1]
        )
        for run in found
    }


_NUMBERS = (
    "vertices",
    "springs",
    "status",
    "prepare\ncold ms",
    "\nwarm ms",
    "step\nms",
    "least\nms",
    "local\nms",
    "global\nms",
    "iter.",
    "residual",
    "largest\nstrain",
)

INTERRUPTED = "! the process was interrupted while steps were timed: its least time is nearest to the truth"
APART = "~ local and global, timed alone, do not add up to an iteration within 15 %"
"""What the marks in the table mean."""
SHARED = "timed beside others, up to {} at once, each on cores of its own: slower than alone by what they share"


def summary_table(table: pa.Table, other_code: Collection[str] = ()) -> Table:
    """One line for each run: what it was, whether it succeeded, and its times [ms], marked where they are doubtful.

    other_code: the ids of the runs that were done by other code than today's, which are marked.
    """
    title = "times are medians over the rounds and over the steps"
    out = Table(
        title=title,
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )
    for name in ("scene", "size", "solver"):
        out.add_column(name, overflow="fold", justify="right" if name == "size" else "left", min_width=len(name))
    for name in _NUMBERS:
        out.add_column(name, justify="left" if name == "status" else "right", no_wrap=True)
    found = runs(table)
    names = labels(found)
    for run in found:
        out.add_row(
            run.scene,
            str(run.size) if run.size else "–",
            names[run.run_id],
            _number(run.vertices, count),
            _number(run.springs, count),
            f"[{'green' if run.status == 'ok' else 'bold red'}]{run.status}[/]"
            + ("[yellow] by other code[/]" if run.run_id in other_code else ""),
            *(_number(value, quantity) for value in (run.cold, run.warm)),
            _number(run.step, quantity) + ("!" if run.interrupted else ""),
            _number(run.least, quantity),
            *(_number(value, quantity) + _apart(run, value) for value in (run.local, run.global_)),
            _number(run.iterations, quantity),
            _number(run.residual, "{:.1e}".format),
            _number(run.largest_strain, lambda strain: f"{100 * strain:.3g} %"),
        )
    marks = {INTERRUPTED: any(run.interrupted for run in found), APART: any(_apart(run, run.local) for run in found)}
    shared = [
        n for how, n in zip(*(table[c].to_pylist() for c in ("timing", "at_once")), strict=True) if how == "shared"
    ]
    marks[SHARED.format(max(shared, default=0))] = bool(shared)
    out.caption = "\n".join([*(words for words, there in marks.items() if there), *_methods(table)]) or None
    # Lines longer than a narrow terminal keep their numbers; Rich would cut them to ellipses.
    out.width = Measurement.get(wide := Console(width=1000), wide.options, out).maximum
    return out


def _apart(run: RunTimes, value: float | None) -> str:
    """The mark of a phase's time where the phases do not add up to an iteration."""
    return "~" if value is not None and run.adds_up is False else ""


def _methods(table: pa.Table) -> list[str]:
    """Where each solver comes from."""
    known = dict(zip(*(table[name].to_pylist() for name in ("solver", "reference")), strict=True))
    return [f"{solver}: {cited(reference)}" for solver, reference in known.items() if reference]


def _number(value: Any, words: Callable[[Any], str]) -> str:
    return "–" if value is None else words(value)

# pyright: reportUnknownMemberType=false
# pyarrow's stubs do not type the kinds of files that Parquet is read from.
"""Summaries of an ablation study: the verdict on each effect follows from its result rows.

An effect matters where removing it displaces some vertex by more than the error that the scene's solver and time step
have in any case. Its cost is a difference of times; where the confidence interval contains zero, no cost was measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results import row_store
from springbench.harness.results.parquet_rows import read_rows

ResultRow = Mapping[str, Any]

ABLATION_CAPTION = (
    "CPU time: mean over frames of medians over rounds; displacements in mean rest lengths, energy of the largest"
)

OVERHEAD_CAPTION = (
    "CPU time, medians over rounds; ≥ lower bound of reading the effect's numbers once; confidence intervals in rows"
)


def read_ablation(path: Path) -> list[dict[str, Any]]:
    """Return the rows of an ablation file."""
    return read_rows([path], pa.schema([])).to_pylist()


def read_ablations(folder: Path, kind: str) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each ablation that has rows of a kind, by file name.

    Args:
        folder: folder of the results, with the subfolder `ablation`.
        kind: value of the column `kind` that an ablation must have; all of its rows are returned.

    Raises:
        InputError: if there are none.
    """
    found = {path.stem: read_ablation(path) for path in row_store.list_units(folder / "ablation")}
    found = {name: rows for name, rows in found.items() if select_kind(rows, kind)}
    if not found:
        command = "springbench ablate SCENE" + (" --all-solvers" if kind == "overhead" else "")
        raise InputError(InputMistake(f"contains nothing of that kind; expected the rows of `{command}`", folder))
    return found


def select_kind(rows: Sequence[ResultRow], kind: str) -> list[ResultRow]:
    """Return the rows of one kind, in their order.

    Args:
        rows: rows of one ablation.
        kind: value of the column `kind`, such as "ablated" or "overhead".
    """
    return [row for row in rows if row["kind"] == kind]


def largest_known_error(rows: Sequence[ResultRow]) -> tuple[float, str]:
    """Return the largest known error of the scene and its source.

    Returns:
        The displacement error [mean rest lengths] and a phrase that names its source; (nan, "") if no error is
        known.
    """
    known = [(row["displacement_max"], row["name"]) for row in select_kind(rows, "error") if row["status"] == "ok"]
    size, name = max(known, default=(float("nan"), ""))
    return size, {"solver": "the solver's own error", "time-step": "the time step's error", "": ""}[name]


def describe_effect(row: ResultRow, rows: Sequence[ResultRow]) -> str:
    """Describe the cost and the influence of one effect in a sentence.

    Args:
        row: row of the effect, of kind `ablated`.
        rows: all rows of the ablation.
    """
    if row["status"] == "unsolvable":
        return f"the scene is impossible without it ({row['reason']})"
    (whole,) = select_kind(rows, "full-scene")
    price, moved = _describe_cost(row, whole["seconds"]), row["displacement_max"]
    if not moved:
        return f"{price}, changes nothing at all: leave it out"
    moves = f"{price}, moves vertices by {_format_two_digits(moved)} rest lengths"
    if moved > row["bounding_box_diagonal"]:
        return f"{moves}, further than the mesh is large: without it this is another scene"
    error, whose = largest_known_error(rows)
    if not whose:
        return f"{moves}; by how much the scene is wrong anyway is not known"
    if moved <= error:
        return (
            f"{moves}, less than {whose} of {_format_two_digits(error)}: this "
            "scene does not call for it at this accuracy"
        )
    return f"{moves}, more than {whose} of {_format_two_digits(error)}: this scene calls for it"


def _describe_cost(row: ResultRow, full_run: float) -> str:
    share, low, high = (row[key] / full_run for key in ("added_seconds", "added_seconds_low", "added_seconds_high"))
    if low <= 0.0 <= high:
        return f"no time that could be measured ({100 * low:+.1f} to {100 * high:+.1f} %)"
    if share < 0.0:
        return f"saves {-100 * share:.0f} % of the time" if share < -0.005 else "hardly any time"
    return f"{100 * share:.0f} % of the time" if share >= 0.095 else f"{100 * share:.1f} % of the time"


def _format_two_digits(value: float) -> str:
    """Format a number with two significant digits, and without an exponent from 100 on."""
    return f"{value:.2g}" if value < 100 else f"{value:.0f}"


def _format_energy_change(value: float) -> str:
    return f"{100 * value:.1f} %" if value < 10.0 else f"{value:.2g} x"


def build_ablation_table(rows: Sequence[ResultRow]) -> Table:
    """Build a table with one row per effect: its cost, and what changes without it."""
    (whole,) = select_kind(rows, "full-scene")
    headings = (
        "without",
        "CPU ms a step",
        "% of the step",
        "95 %",
        "KiB",
        "nnz(L)",
        "displacement_max",
        "RMS",
        "energy_difference",
        "centroid_displacement",
    )
    table = Table(box=SIMPLE_HEAD, caption=ABLATION_CAPTION)
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="right" if i else "left")
    size = f"{whole['memory_bytes'] / 1024:,.0f}"
    table.add_row("nothing", f"{1e3 * whole['seconds']:.3g}", "100", "", size, _format_count(whole["nnz_factor"], ""))
    for row in select_kind(rows, "ablated"):
        if row["status"] != "ok":
            table.add_row(escape(row["name"]), row["status"])
            continue
        share = [
            100 * row[key] / whole["seconds"] for key in ("added_seconds", "added_seconds_low", "added_seconds_high")
        ]
        fill = "" if row["nnz_factor"] is None else _format_count(whole["nnz_factor"] - row["nnz_factor"], "+")
        table.add_row(
            escape(row["name"]),
            f"{1e3 * row['added_seconds']:.3g}",
            f"{share[0]:.1f}",
            f"{share[1]:.1f} to {share[2]:.1f}",
            f"{(whole['memory_bytes'] - row['memory_bytes']) / 1024:+,.0f}",
            fill,
            _format_two_digits(row["displacement_max"]),
            _format_two_digits(row["displacement_rms"]),
            _format_energy_change(row["energy_difference"]),
            _format_two_digits(row["centroid_displacement"]),
        )
    for row in select_kind(rows, "error"):
        ok = row["status"] == "ok"
        found = (
            _format_two_digits(row["displacement_max"]),
            _format_two_digits(row["displacement_rms"]),
            _format_energy_change(row["energy_difference"]),
            _format_two_digits(row["centroid_displacement"]),
        )
        table.add_row(f"error of the {row['name']}", *[""] * 5, *found) if ok else table.add_row(
            f"error of the {row['name']}", row["status"]
        )
    return table


def build_overhead_table(rows: Sequence[ResultRow]) -> Table:
    """Build a table of overheads with one row per effect and one column per solver.

    Each overhead is followed by its lower bound.
    """
    found = {(row["name"], row["solver"]): row for row in select_kind(rows, "overhead")}
    effects, solvers = (list(dict.fromkeys(key[k] for key in found)) for k in (0, 1))
    table = Table(box=SIMPLE_HEAD, title="an iteration with the effect over one without", caption=OVERHEAD_CAPTION)
    for i, heading in enumerate(("effect", *solvers)):
        table.add_column(heading, justify="right" if i else "left")
    for effect in effects:
        cells = [found[effect, solver] for solver in solvers]
        table.add_row(
            escape(effect), *(_format_overhead(row) if row["status"] == "ok" else row["status"] for row in cells)
        )
    return table


def _format_overhead(row: ResultRow) -> str:
    return f"{row['overhead_ratio']:.2f} ≥{row['overhead_ratio_bound']:.2f}"


def summarise_ablation(rows: Sequence[ResultRow]) -> list[str]:
    """Return sentences on all effects, on suggested effects, and on errors that are unknown."""
    sentences = [f"{row['name']}: {describe_effect(row, rows)}" for row in select_kind(rows, "ablated")]
    sentences += [f"not listed: {row['name']}: {row['reason']}" for row in select_kind(rows, "suggestion")]
    unknown = [row for row in select_kind(rows, "error") if row["status"] != "ok"]
    return sentences + [f"error of the {row['name']}: unknown ({row['reason']})" for row in unknown]


def _format_count(number: int | None, sign: str) -> str:
    return "" if number is None else f"{number:{sign},}"

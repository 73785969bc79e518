"""Table of a sweep's runs for the results page: one line per run."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pyarrow as pa

from harness.base import rows, shelf
from harness.base.errors import Mistake
from harness.report.references import bibtex, cited
from harness.report.site.folders import Folder
from harness.report.site.marks import drawn
from harness.report.site.script import column
from harness.report.sql import answers
from harness.report.style import looks
from harness.report.timing_table import labels, runs
from solvers.registry import OPTIONAL, SOLVERS, load

Run = dict[str, Any]

MACHINE = "machine"
"""Solver column of rows that belong to no solver: the limits of the machine itself, in a speed report."""

_NEEDED = ("run_id", "scene", "size", "solver", "phase", "status")

_MORE = """
select run_id, any_value(file) as unit, any_value(family) as family, any_value(reference) as reference,
    any_value(integrator) as integrator, any_value(time_step) as time_step, any_value(first_guess) as first_guess,
    any_value(max_iterations) as max_iterations, any_value(tolerance) as tolerance,
    any_value(asked) as asked, any_value(estimated) as estimated, any_value(threads) as threads,
    max(frame) as frames, 1 + max("round") filter (phase = 'step') as rounds,
    sum(seconds) filter (phase in ('step', 'prepare')) as took,
    arg_max(digest, frame) filter (digest is not null) as digest,
    max(penetration) as penetration, any_value(machine) as machine, any_value(cpu) as cpu, any_value(cores) as cores,
    any_value(memory_gib) as memory, any_value("system") as os, any_value("commit") as "commit",
    any_value(code) as code, any_value(own) as own, any_value(started) as started, any_value(timing) as timing,
    any_value(versions) as versions
from rows_of group by run_id
"""


def read(folder: Folder, left_out: Callable[[Mistake], None]) -> pa.Table:
    """Read the rows of a sweep, with the name of each row's unit.

    Args:
        folder: folder of the sweep's results.
        left_out: called for each invalid unit.
    Raises:
        InputError: if rows are damaged.
    """
    return rows.read(shelf.units(folder.path / "rows"), needed=_NEEDED, named=True, left_out=left_out)


def table_of(folder: Folder, table: pa.Table) -> list[Run]:
    """Build records of the runs, ordered by scene, size and solver.

    A record has the identification, the status, and the times [ms].

    Args:
        folder: folder of the sweep's results.
        table: rows of the sweep.
    """
    there = {
        part: _files(folder.path / part, suffix) for part, suffix in (("pictures", ".png"), ("recordings", ".rrd"))
    }
    timed = [run for run in runs(table) if run.solver != MACHINE]
    names, more = labels(timed), _more(table)
    found: list[Run] = []
    for run in timed:
        told: Run = {**run._asdict(), **more[run.run_id], "label": names[run.run_id]}
        told["global"] = told.pop("global_")
        told["plain"] = int(_is_plain(run.solver, run.parameters))
        told["options"] = names[run.run_id].removeprefix(run.solver).removeprefix(", ")
        told |= {part[:-1]: int(told["unit"] in files) for part, files in there.items()}
        found.append(told)
    found.sort(key=lambda run: (run["scene"], run["size"] or 0, run["label"]))
    for run, how in zip(found, _other_code(found), strict=True):
        run["by"] = how
    return found


def as_script(folder: Folder, found: Sequence[Run], outcomes: Mapping[str, Any]) -> dict[str, Any]:
    """Build the table of runs as columns.

    Args:
        folder: folder of the sweep's results.
        found: records of the runs.
        outcomes: outcome and reason of verified runs by their ids.
    """
    columns = {name: [run[name] for run in found] for name in _SHOWN if found and name in found[0]}
    columns["parameters"] = [run["parameters"] or "{}" for run in found]
    if outcomes:
        columns["outcome"] = [outcomes.get(run["run_id"], {}).get("words") for run in found]
    marks = looks((run["label"], run["solver"]) for run in found)
    exact = {name: [run[name] for run in found] for name in _EXACT}
    return {
        "slug": folder.slug,
        "up": folder.up,
        "n": len(found),
        "columns": {name: column(values) for name, values in columns.items()} | exact,
        "marks": {label: drawn(mark) for label, mark in marks.items()},
        "references": references((run["solver"], run["reference"]) for run in found),
    }


def references(pairs: Any) -> dict[str, dict[str, str]]:
    """Format references by solver, as a line and as BibTeX."""
    known = {solver: reference for solver, reference in pairs if reference}
    return {s: {"cited": cited(reference), "bibtex": bibtex([reference])} for s, reference in known.items()}


_EXACT = ("time_step", "tolerance", "asked")
"""Columns that commands need to the last digit."""

_SHOWN = (
    *("run_id", "unit", "scene", "size", "solver", "label", "options", "plain", "family", "vertices", "springs"),
    *(
        "integrator",
        "time_step",
        "first_guess",
        "max_iterations",
        "tolerance",
        "asked",
        "estimated",
        "threads",
        "frames",
        "rounds",
    ),
    *("status", "reason", "stopped", "iterations", "residual", "cold", "warm", "step", "lower", "upper", "least"),
    *("local", "global", "largest_strain", "strain_99", "penetration", "interrupted", "adds_up", "timing", "digest"),
    *(
        "picture",
        "recording",
        "mesh",
        "replay",
        "by",
        "machine",
        "cpu",
        "commit",
        "code",
        "started",
        "took",
        "own",
        "versions",
    ),
)


def _more(table: pa.Table) -> dict[str, Run]:
    """Query further details of runs, by run id.

    The table at the end of a sweep does not include them.
    """
    return {run.pop("run_id"): run for run in answers(_MORE, table)}


def _is_plain(solver: str, parameters: str | None) -> bool:
    """Return whether a solver has default parameters, so that its name alone identifies it.

    This is known only for solvers of the package, because a report does not import plug-in code.
    """
    given, shipped = json.loads(parameters or "{}"), SOLVERS | OPTIONAL
    if solver not in shipped or not given:
        return not given
    usual = {f.name: f.default for f in fields(load(shipped[solver])) if f.default is not MISSING}
    return all(name in usual and usual[name] == value for name, value in given.items())


def _files(folder: Path, suffix: str) -> set[str]:
    return {path.stem for path in folder.glob(f"*{suffix}")} if folder.is_dir() else set()


def _other_code(found: Sequence[Run]) -> list[str]:
    """Classify each run as `other code`, `earlier commit` or current ("").

    `other code` is relative to the newest run of its scene and solver, `earlier commit` relative to the newest run of
    all.
    """
    newest: dict[Any, Run] = {}
    for run in sorted(found, key=lambda run: run["started"] or ""):
        newest[run["scene"], run["solver"]] = newest[None] = run
    return [
        "other code"
        if run["code"] != newest[run["scene"], run["solver"]]["code"]
        else "earlier commit"
        if run["commit"] != newest[None]["commit"]
        else ""
        for run in found
    ]

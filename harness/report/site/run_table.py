"""Table of a sweep's runs for the results page: one line per run."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pyarrow as pa
from springbench.harness.errors import InputMistake
from springbench.harness.report.citations import format_bibtex, format_citation
from springbench.harness.report.plot_style import assign_label_styles
from springbench.harness.report.site.data_scripts import encode_column
from springbench.harness.report.site.plotly_styles import build_plotly_style
from springbench.harness.report.site.sweep_folders import SweepFolder
from springbench.harness.report.speed.speed_figures import MACHINE_SOLVER
from springbench.harness.report.table_queries import query_records
from springbench.harness.report.timing_table import RunTimes, label_runs, read_run_times
from springbench.harness.results import parquet_rows, row_store
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, load_target

RunRecord = dict[str, Any]

_REQUIRED_COLUMNS = ("run_id", "scene", "size", "solver", "phase", "status")

_RUN_QUERY = """
select run_id, any_value(file) as unit, any_value(family) as family, any_value(citation) as citation,
    any_value(integrator) as integrator, any_value(time_step) as time_step,
    any_value(initial_guess) as initial_guess,
    any_value(max_iterations) as max_iterations, any_value(residual_rtol) as residual_rtol,
    any_value(error_requested) as error_requested, any_value(error_estimated) as error_estimated,
    any_value(threads) as threads,
    max(frame) as frames, 1 + max("round") filter (phase = 'step') as rounds,
    sum(seconds) filter (phase in ('step', 'prepare')) as total_seconds,
    arg_max(positions_digest, frame) filter (positions_digest is not null) as positions_digest,
    max(penetration_depth) as penetration_depth, any_value(machine_id) as machine_id,
    any_value(cpu) as cpu, any_value(cores) as cores,
    any_value(memory_gib) as memory_gib, any_value(operating_system) as operating_system,
    any_value("commit") as "commit",
    any_value(source_fingerprint) as source_fingerprint, any_value(plugins) as plugins,
    any_value(started_at) as started_at, any_value(timing) as timing,
    any_value(versions) as versions
from rows_of group by run_id
"""


def read_run_rows(folder: SweepFolder, on_invalid: Callable[[InputMistake], None]) -> pa.Table:
    """Read the rows of a sweep, with the name of each row's unit.

    Args:
        folder: folder of the sweep's results.
        on_invalid: called for each invalid unit.

    Raises:
        InputError: if rows are damaged.
    """
    return parquet_rows.read_rows(
        row_store.list_units(folder.path / "rows"),
        required_columns=_REQUIRED_COLUMNS,
        with_unit_names=True,
        on_invalid=on_invalid,
    )


def build_run_table(folder: SweepFolder, table: pa.Table) -> list[RunRecord]:
    """Build records of the runs, ordered by scene, size and solver.

    A record has the identification, the status, and the times [ms].

    Args:
        folder: folder of the sweep's results.
        table: rows of the sweep.
    """
    there = {
        part: _file_stems(folder.path / part, suffix) for part, suffix in (("pictures", ".png"), ("recordings", ".rrd"))
    }
    timed = [run for run in read_run_times(table) if run.solver != MACHINE_SOLVER]
    names, more = label_runs(timed), _query_run_details(table)
    found: list[RunRecord] = []
    for run in timed:
        record: RunRecord = {**run._asdict(), **more[run.run_id], "label": names[run.run_id]}
        record["global"] = record.pop("global_")
        record["has_default_parameters"] = int(_has_default_parameters(run.solver, run.parameters_json))
        record["options"] = names[run.run_id].removeprefix(run.solver).removeprefix(", ")
        record |= {part[:-1]: int(record["unit"] in files) for part, files in there.items()}
        found.append(record)
    found.sort(key=lambda run: (run["scene"], run["size"] or 0, run["label"]))
    for run, how in zip(found, _classify_staleness(found), strict=True):
        run["staleness"] = how
    return found


def restore_run_times(record: RunRecord) -> RunTimes:
    """Convert the record of a run to `RunTimes`."""
    return RunTimes(*(record["global" if name == "global_" else name] for name in RunTimes._fields))


def build_run_script(
    folder: SweepFolder, run_records: Sequence[RunRecord], outcomes: Mapping[str, Any]
) -> dict[str, Any]:
    """Build the table of runs as columns.

    Args:
        folder: folder of the sweep's results.
        run_records: records of the runs.
        outcomes: outcome and reason of verified runs by their ids.
    """
    columns = {
        name: [run[name] for run in run_records] for name in _PAGE_COLUMNS if run_records and name in run_records[0]
    }
    columns["parameters"] = [run["parameters_json"] or "{}" for run in run_records]
    if outcomes:
        columns["outcome"] = [outcomes.get(run["run_id"], {}).get("label") for run in run_records]
    marks = assign_label_styles((run["label"], run["solver"]) for run in run_records)
    exact = {name: [run[name] for run in run_records] for name in _EXACT_COLUMNS}
    return {
        "slug": folder.slug,
        "relative_url": folder.relative_url,
        "num_rows": len(run_records),
        "columns": {name: encode_column(values) for name, values in columns.items()} | exact,
        "styles": {label: build_plotly_style(mark) for label, mark in marks.items()},
        "citations": format_references((run["solver"], run["citation"]) for run in run_records),
    }


def format_references(pairs: Any) -> dict[str, dict[str, str]]:
    """Format references by solver, as a line and as BibTeX."""
    known = {solver: reference for solver, reference in pairs if reference}
    return {
        s: {"citation": format_citation(reference), "bibtex": format_bibtex([reference])}
        for s, reference in known.items()
    }


_EXACT_COLUMNS = ("time_step", "residual_rtol", "error_requested")
"""Columns that are not rounded, because commands contain their values."""

_PAGE_COLUMNS = (
    *(
        "run_id",
        "unit",
        "scene",
        "size",
        "solver",
        "label",
        "options",
        "has_default_parameters",
        "family",
        "vertices",
        "springs",
    ),
    *(
        "integrator",
        "time_step",
        "initial_guess",
        "max_iterations",
        "residual_rtol",
        "error_requested",
        "error_estimated",
        "threads",
        "frames",
        "rounds",
    ),
    *(
        "status",
        "reason",
        "termination_reason",
        "num_iterations",
        "residual",
        "cold",
        "warm",
        "step",
        "lower",
        "upper",
        "least",
    ),
    *(
        "local",
        "global",
        "max_strain",
        "strain_p99",
        "provided_energy",
        "damping_share",
        "friction_share",
        "integrator_share",
        "solve_share",
        "engine_share",
        "penetration_depth",
        "preempted",
        "phases_consistent",
        "timing",
        "positions_digest",
    ),
    *(
        "picture",
        "recording",
        "mesh",
        "replay",
        "staleness",
        "machine_id",
        "cpu",
        "commit",
        "source_fingerprint",
        "started_at",
        "total_seconds",
        "plugins",
        "versions",
    ),
)


def _query_run_details(table: pa.Table) -> dict[str, RunRecord]:
    """Query further details of runs, by run id.

    The table at the end of a sweep does not include them.
    """
    return {run.pop("run_id"): run for run in query_records(_RUN_QUERY, table)}


def _has_default_parameters(solver: str, parameters: str | None) -> bool:
    """Return whether a solver has default parameters, so that its name alone identifies it.

    This is known only for solvers of the package, because a report does not import plug-in code.
    """
    given, shipped = json.loads(parameters or "{}"), SOLVERS | OPTIONAL_SOLVERS
    if solver not in shipped or not given:
        return not given
    usual = {f.name: f.default for f in fields(load_target(shipped[solver])) if f.default is not MISSING}
    return all(name in usual and usual[name] == value for name, value in given.items())


def _file_stems(folder: Path, suffix: str) -> set[str]:
    return {path.stem for path in folder.glob(f"*{suffix}")} if folder.is_dir() else set()


def _classify_staleness(run_records: Sequence[RunRecord]) -> list[str]:
    """Classify each run as `stale`, `earlier commit` or current ("").

    `stale` is relative to the newest run of its scene and solver, `earlier commit` relative to the newest run of
    all.
    """
    newest: dict[Any, RunRecord] = {}
    for run in sorted(run_records, key=lambda run: run["started_at"] or ""):
        newest[run["scene"], run["solver"]] = newest[None] = run
    return [
        "stale"
        if run["source_fingerprint"] != newest[run["scene"], run["solver"]]["source_fingerprint"]
        else "earlier commit"
        if run["commit"] != newest[None]["commit"]
        else ""
        for run in run_records
    ]

# pyright: reportUnknownMemberType=false
# pyarrow's stubs do not type every kind of file that Parquet is written to.
"""Data of one sweep for the results page.

These are its entry in the index, and the scripts with its runs and charts.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
from springbench.harness.atomic_files import atomic_write
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.optional_parts import RECORDINGS
from springbench.harness.report import equal_accuracy
from springbench.harness.report.ablation_summary import select_kind, summarise_ablation
from springbench.harness.report.charts.ablation_charts import build_effect_chart, build_overhead_chart
from springbench.harness.report.charts.device_chart import build_device_chart
from springbench.harness.report.charts.hard_case_chart import build_hard_case_chart
from springbench.harness.report.charts.speed_chart import build_speed_chart
from springbench.harness.report.charts.timing_chart import build_compared_timing_chart, build_run_accuracy_chart
from springbench.harness.report.device_speedup import read_device_runs, summarise_runs
from springbench.harness.report.robustness import build_map_headline, has_verification, read_verified_runs
from springbench.harness.report.site import (
    frame_scripts,
    run_table,
)
from springbench.harness.report.site.chart_json import serialise_chart
from springbench.harness.report.site.failure_causes import FailedRun, group_failures
from springbench.harness.report.site.sweep_folders import SweepFolder, find_benchmark_files
from springbench.harness.report.speed.speed_figures import compute_speed_figures, has_machine_limits
from springbench.harness.report.speed.speed_table import describe_speed
from springbench.harness.report.table_queries import query_table
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.folder_ownership import find_config, read_owner

PrintMessage = Callable[[str], None]

_MAX_PICTURES = 3
"""Maximum number of pictures of a sweep in the overview."""

_HASH_SUFFIX = re.compile(r"-[0-9a-f]{12}$")

_MACHINE_COLUMNS = ("machine_id", "cpu", "cores", "memory_gib", "operating_system", "commit")

_PROVENANCE_QUERY = f"""
select {", ".join(f'"{name}"' for name in _MACHINE_COLUMNS)},
    list(distinct source_fingerprint order by source_fingerprint),
    min(started_at), max(started_at), count(distinct {{unit}})
from rows_of where machine_id is not null group by all order by max(started_at) desc
"""


class SweepOverview(NamedTuple):
    """The sweep's entry in the index (`summary`), and its other data by name (`scripts`)."""

    summary: dict[str, Any]
    scripts: dict[str, Any]


class _PageSection(NamedTuple):
    """The contribution of one kind of rows to a sweep's data."""

    scripts: dict[str, Any]
    plots: list[tuple[str, str]]
    findings: list[dict[str, Any]]
    failures: list[dict[str, Any]]
    row_provenance: list[dict[str, Any]]
    summary_fields: dict[str, Any]


_SectionBuilder = Callable[[SweepFolder, Path, bool, PrintMessage], _PageSection]


def build_overview(
    folder: SweepFolder, data_folder: Path, *, with_recordings: bool, print_message: PrintMessage
) -> SweepOverview:
    """Build the data of a sweep from its rows.

    Args:
        folder: folder of the sweep's results.
        data_folder: folder of the page's data, where scripts of single runs are written.
        with_recordings: whether meshes and recordings are converted to scripts, which takes longer.
        print_message: prints a remark.
    """
    kinds = {
        "rows": _build_run_section,
        "accuracy": _build_accuracy_section,
        "ablation": _build_ablation_section,
        "benchmarks": _build_benchmark_section,
    }
    there = [kind for kind in kinds if kind != "benchmarks" and row_store.list_units(folder.path / kind)]
    there += ["benchmarks"] if find_benchmark_files(folder.path) else []
    sections = [
        _build_section(kind, kinds[kind], folder, data_folder, with_recordings, print_message) for kind in there
    ]
    made = [one for each in sections for one in each.row_provenance]
    summary: dict[str, Any] = {
        "slug": folder.slug,
        "name": folder.name,
        "relative_url": folder.relative_url,
        "kinds": there,
        "config": find_config(folder.path),
        "scenes": find_scene_files(folder.path),
        "provenance": made,
        "first_started_at": min((one["first_started_at"] or "" for one in made), default=""),
        "last_started_at": max((one["last_started_at"] or "" for one in made), default=""),
        "plots": [{"id": name, "title": title} for each in sections for name, title in each.plots],
        "findings": [finding for each in sections for finding in each.findings],
        "failures": [cause for each in sections for cause in each.failures],
        "pictures": _select_pictures(folder),
    }
    for each in sections:
        summary |= each.summary_fields
    return SweepOverview(summary, {name: value for each in sections for name, value in each.scripts.items()})


def _build_section(
    kind: str,
    read: _SectionBuilder,
    folder: SweepFolder,
    data_folder: Path,
    with_recordings: bool,
    print_message: PrintMessage,
) -> _PageSection:
    """Build the section of one kind of rows.

    Raises:
        InputError: if the rows are inconsistent.
    """
    try:
        return read(folder, data_folder, with_recordings, print_message)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        problem = f"contains rows of the kind {kind} that do not fit together ({type(error).__name__}: {error})"
        raise InputError(InputMistake(f"{problem}; take them out of the results", folder.path)) from error


def _build_run_section(
    folder: SweepFolder, data_folder: Path, with_recordings: bool, print_message: PrintMessage
) -> _PageSection:
    table = run_table.read_run_rows(folder, _report_skipped(print_message))
    found = run_table.build_run_table(folder, table)
    scripts: dict[str, Any] = {}
    citations = dict(zip(*(table[name].to_pylist() for name in ("solver", "citation")), strict=True))
    stale_ids = {run["run_id"] for run in found if run["staleness"] == "stale"}
    timed_runs = [run_table.restore_run_times(record) for record in found]
    times = build_compared_timing_chart(timed_runs, stale_ids, citations=citations)
    accuracies = build_run_accuracy_chart(timed_runs, stale_ids, citations=citations)
    scripts |= {
        name: serialise_chart(chart) for name, chart in (("size", times), ("accuracy", accuracies)) if chart.frames
    }
    device_runs = read_device_runs(table)
    words = summarise_runs(device_runs, find_config(folder.path))
    findings = [{"text": sentence} for sentence in words] + describe_runs(found)
    devices = build_device_chart(device_runs)
    if devices.frames:
        scripts["devices"] = serialise_chart(devices)
    if has_machine_limits(table):
        candidates = compute_speed_figures(table)
        newest = find_newest_fingerprint(table)
        scripts["speed"] = serialise_chart(build_speed_chart(candidates, newest, citations))
        findings = [{"text": words} for words in describe_speed(candidates)]
    outcomes: dict[str, Any] = {}
    if has_verification(table):
        cells = read_verified_runs(folder.path)
        scripts["hard"] = serialise_chart(build_hard_case_chart(cells, stale_ids))
        outcomes = {cell.run_id: {"label": cell.outcome.label, "reason": cell.reason} for cell in cells}
        findings = [{"text": f"{build_map_headline(cells, folder.name)}.", "plot": "hard"}, *findings[-1:]]
    plots = [(name, chart["title"]) for name, chart in scripts.items()]
    _mark_recordings(folder, data_folder, found, with_recordings, print_message)
    scripts["runs"] = run_table.build_run_script(folder, found, outcomes)
    _write_run_parquet(data_folder / "runs.parquet", found)
    frame_scripts.write_frame_scripts(folder, table, data_folder, _find_outdated_runs(folder, data_folder, found))
    failed = [FailedRun(r["scene"], r["label"], r["status"], r["reason"] or "", r["run_id"]) for r in found]
    facts = {
        "runs": len(found),
        "statuses": Counter(run["status"] for run in found),
        "total_seconds": sum(run["total_seconds"] or 0.0 for run in found),
        "solvers": sorted({run["solver"] for run in found}),
        "sizes": sorted({run["size"] for run in found if run["size"]}),
        "num_stale_runs": sum(run["staleness"] == "stale" for run in found),
    }
    bad = group_failures(one for one in failed if one.status != "ok")
    return _PageSection(scripts, plots, findings, bad, collect_provenance(table, "run_id"), facts)


def describe_runs(run_records: Sequence[run_table.RunRecord]) -> list[dict[str, Any]]:
    """Describe runs in sentences, each with the ids of its runs (`equal_accuracy`)."""
    names = {run["run_id"]: run["label"] for run in run_records}
    sentences = [
        {"text": words, "runs": runs}
        for compared in equal_accuracy.compare_runs(map(run_table.restore_run_times, run_records))
        for words, runs in equal_accuracy.describe_comparison(compared, names)
    ]
    return sentences + list(_describe_unconverged(run_records))


def _describe_unconverged(run_records: Sequence[run_table.RunRecord]) -> Iterator[dict[str, Any]]:
    """Describe how many runs ended a step at the iteration limit or at a saddle."""
    done = [run for run in run_records if run["status"] == "ok" and run["termination_reason"]]
    for reason, words in (
        ("max-iter", "at the limit of iterations: look at residuals"),
        ("saddle", "at a saddle, not a minimum: allow more iterations"),
    ):
        short = [run for run in done if run["termination_reason"] == reason]
        if short:
            text = f"{len(short)} of {len(done)} runs ended a step {words}."
            yield {"text": text, "runs": [short[0]["run_id"]], "filter": {"termination_reason": reason}}


def _mark_recordings(
    folder: SweepFolder,
    data_folder: Path,
    run_records: Sequence[dict[str, Any]],
    include_missing: bool,
    print_message: PrintMessage,
) -> None:
    """Mark whether each run's last frame and recording are in the page's data.

    With `include_missing`, missing ones are added.
    """
    there = {part: {path.stem for path in (data_folder / part).glob("*.js")} for part in ("meshes", "recordings")}
    include_missing = include_missing and RECORDINGS.is_installed()
    if include_missing and (recorded := {run["unit"]: build_run_title(run) for run in run_records if run["recording"]}):
        from springbench.harness.report.site.mesh_scripts import write_last_frames, write_recordings

        there["meshes"] = write_last_frames(folder, data_folder, list(recorded), print_message)
        marks = {f"recordings/{unit}.rrd": words for unit, words in recorded.items()}
        there["recordings"] = {Path(name).stem for name in write_recordings(folder, data_folder, marks)}
    for run in run_records:
        run |= {name: int(run["unit"] in there[part]) for name, part in (("mesh", "meshes"), ("replay", "recordings"))}


def _find_outdated_runs(folder: SweepFolder, data_folder: Path, run_records: Sequence[dict[str, Any]]) -> list[str]:
    """Find the runs whose script is missing or older than their rows."""
    scripts, rows_of = _modification_times(data_folder / "runs"), _modification_times(folder.path / "rows")
    packed = row_store.build_packed_path(folder.path / "rows")
    otherwise = packed.stat().st_mtime_ns if packed.exists() else 0
    return [r["run_id"] for r in run_records if scripts.get(r["run_id"], -1) < rows_of.get(r["unit"], otherwise)]


def _modification_times(folder: Path) -> dict[str, int]:
    """Return the modification time [ns] of each file in a folder by its stem."""
    if not folder.is_dir():
        return {}
    with os.scandir(folder) as entries:
        return {os.path.splitext(entry.name)[0]: entry.stat().st_mtime_ns for entry in entries}


def _write_run_parquet(path: Path, run_records: Sequence[dict[str, Any]]) -> None:
    """Write the table of runs as a Parquet file for other programs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        pq.write_table(
            pa.Table.from_pylist([{k: v for k, v in r.items() if k != "options_json"} for r in run_records]), partial
        )


def _build_accuracy_section(
    folder: SweepFolder, data_folder: Path, with_recordings: bool, print_message: PrintMessage
) -> _PageSection:
    from springbench.harness.report.accuracy.accuracy_data import without_short_curves
    from springbench.harness.report.accuracy.accuracy_findings import list_failures, summarise_findings
    from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
    from springbench.harness.report.site.accuracy_charts import build_page_charts

    table = read_accuracy(folder.path, on_invalid=_report_skipped(print_message))
    scripts, facts = build_page_charts(table, folder.path), dict[str, Any]()
    if with_recordings and RECORDINGS.is_installed():
        from springbench.harness.report.site.mesh_scripts import write_recordings, write_solves

        facts["solves"] = write_solves(folder, data_folder, without_short_curves(table), print_message)
        titles_by_recording = {
            c.recording_path: f"{c.label}, {c.problem.problem_label}"
            for c in table.curves
            if c.recording_path in facts["solves"]
        }
        facts["replays"] = write_recordings(folder, data_folder, titles_by_recording)
    chapters = summarise_findings(table)
    findings = [{"text": w, "chapter": name} for name, some in chapters.items() if name != "Methods" for w in some]
    failed = [FailedRun(row["where"], row["solver"], row["status"], row["reason"]) for row in list_failures(table)]
    plots = [(name, chart["title"]) for name, chart in scripts.items()]
    facts |= {"curves": len(table.curves), "work_points": len(table.work_points)}
    return _PageSection(
        scripts,
        plots,
        findings,
        group_failures(failed),
        collect_provenance(_read_rows(folder, "accuracy"), "unit_id"),
        facts,
    )


def _build_ablation_section(
    folder: SweepFolder, data_folder: Path, with_recordings: bool, print_message: PrintMessage
) -> _PageSection:
    table = _read_rows(folder, "ablation", print_message)
    ablations: dict[str, list[dict[str, Any]]] = {}
    for row in table.to_pylist():
        ablations.setdefault(row[row_store.FILE_COLUMN], []).append(row)
    rows = [row for some in ablations.values() for row in some]
    newest = find_newest_fingerprint(table)
    charts = {"ablation": build_effect_chart(ablations, newest), "prices": build_overhead_chart(rows, newest)}
    scripts = {name: serialise_chart(chart) for name, chart in charts.items() if chart.frames or chart.maps}
    words = [
        f"{whole['scene']}: {sentence}"
        for some in ablations.values()
        for whole in select_kind(some, "full-scene")
        if whole["status"] == "ok"
        for sentence in summarise_ablation(some)
    ]
    plots = [(name, chart["title"]) for name, chart in scripts.items()]
    findings = [{"text": f"{one}.", "chapter": "Effects"} for one in words]
    return _PageSection(
        scripts,
        plots,
        findings,
        [],
        collect_provenance(table, row_store.FILE_COLUMN),
        {"ablations": len(words)},
    )


def _build_benchmark_section(
    folder: SweepFolder, data_folder: Path, with_recordings: bool, print_message: PrintMessage
) -> _PageSection:
    from springbench.harness.report.site import benchmark_charts

    known = benchmark_charts.read_benchmark_files(find_benchmark_files(folder.path), print_message)
    scripts, found = benchmark_charts.build_benchmark_charts(known)
    plots = [(name, chart["title"]) for name, chart in scripts.items()]
    facts = {"benchmarks": len({item["benchmark"] for chart in scripts.values() for item in chart["items"]})}
    return _PageSection(scripts, plots, found, [], benchmark_charts.collect_benchmark_provenance(known), facts)


def collect_provenance(table: pa.Table, unit: str) -> list[dict[str, Any]]:
    """Collect machines and commits of rows, the newest first.

    Args:
        table: rows.
        unit: column whose distinct values are counted.
    """
    lacking = [
        name for name in (*_MACHINE_COLUMNS, "source_fingerprint", "started_at", unit) if name not in table.column_names
    ]
    for name in lacking:
        table = table.append_column(name, pa.nulls(len(table), pa.string()))
    names = (*_MACHINE_COLUMNS, "source_fingerprints", "first_started_at", "last_started_at", "count")
    return [dict(zip(names, row, strict=True)) for row in query_table(_PROVENANCE_QUERY.format(unit=unit), table)]


def find_newest_fingerprint(table: pa.Table) -> str:
    """Return the fingerprint of the newest row's code; "" if it is unknown."""
    dated = zip(*(table[name].to_pylist() for name in ("started_at", "source_fingerprint")), strict=True)
    return max(((started or "", code or "") for started, code in dated), default=("", ""))[1]


def find_scene_files(folder: Path) -> dict[str, str]:
    """Find the scene files that a sweep's config lists, by scene name.

    Paths are relative to the same folder as that of the config.
    """
    from springbench.harness.schema.yaml_loader import read_yaml

    owner = read_owner(folder)
    if owner is None:
        return {}
    called, data = find_config(folder), read_yaml(owner).data
    if "mesh" in data:
        return {Path(called).stem: called}
    listed = [str(scene) for scene in data.get("scenes") or ()]
    return {Path(scene).stem: (Path(called).parent / scene).as_posix() for scene in listed}


def _read_rows(folder: SweepFolder, kind: str, print_message: PrintMessage = lambda words: None) -> pa.Table:
    units = row_store.list_units(folder.path / kind)
    return parquet_rows.read_rows(
        units, pa.schema([]), with_unit_names=True, promote="permissive", on_invalid=_report_skipped(print_message)
    )


def _report_skipped(print_message: PrintMessage) -> Callable[[InputMistake], None]:
    """Return a function that prints a remark on each skipped unit of rows."""
    return lambda mistake: print_message(f"not on the page: {mistake}")


def build_run_title(run: dict[str, Any]) -> str:
    """Return the scene, size and label of a run."""
    return f"{run['scene']}{' ' + str(run['size']) if run['size'] else ''}, {run['label']}"


def _select_pictures(folder: SweepFolder) -> list[dict[str, str]]:
    """Select pictures of a sweep: solver comparisons before single runs, large meshes before small ones."""
    found = sorted((folder.path / "pictures").glob("*.png"), key=_picture_rank, reverse=True)
    found += [p for name in ("convergence", "work") for p in sorted((folder.path / "report").glob(f"{name}/*.png"))][:2]
    times = [path for path in found if path.stem == "timing"]
    shown = [*[path for path in found if path.stem != "timing"][: _MAX_PICTURES - len(times)], *times]
    return [
        {"path": p.relative_to(folder.path).as_posix(), "text": _HASH_SUFFIX.sub("", p.stem).replace("-", " ")}
        for p in shown
    ]


def _picture_rank(path: Path) -> tuple[bool, int, str]:
    sizes = [int(part) for part in path.stem.split("-") if part.isdigit()]
    return path.stem.endswith("-solvers"), max(sizes, default=0), path.stem

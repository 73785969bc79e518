# pyright: reportUnknownMemberType=false
# pyarrow's stubs do not type every kind of file that Parquet is written to.
"""Data of one sweep for the results page.

These are its entry in the index, and the scripts with its runs and charts.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from harness.base import rows, shelf
from harness.base.errors import InputError, Mistake
from harness.base.files import replacing
from harness.report.devices import told as of_devices
from harness.report.site import ablation, frames, hard, provenance, runs, speed
from harness.report.site.failures import Failed, causes
from harness.report.site.folders import Folder, stored
from harness.report.site.sentences import sentences

Say = Callable[[str], None]

_PICTURES = 3
"""Maximum number of pictures of a sweep in the overview."""

_HASH = re.compile(r"-[0-9a-f]{12}$")


class Overview(NamedTuple):
    """The sweep's entry in the index (`summary`), and its other data by name (`scripts`)."""

    summary: dict[str, Any]
    scripts: dict[str, Any]


_Read = Callable[[Folder, Path, bool, Say], "_Told"]


class _Told(NamedTuple):
    """The contribution of one kind of rows to a sweep's data."""

    scripts: dict[str, Any]
    plots: list[tuple[str, str]]
    findings: list[dict[str, Any]]
    failures: list[dict[str, Any]]
    made: list[dict[str, Any]]
    facts: dict[str, Any]


def overview(folder: Folder, home: Path, *, recorded: bool, say: Say) -> Overview:
    """Build the data of a sweep from its rows.

    Args:
        folder: folder of the sweep's results.
        home: folder of the page's data, where scripts of single runs are written.
        recorded: whether meshes and recordings are converted to scripts, which takes longer.
        say: prints a remark.
    """
    kinds = {"rows": _runs, "accuracy": _accuracy, "ablation": _ablation, "gates": _gates}
    there = [kind for kind in kinds if kind != "gates" and shelf.units(folder.path / kind)]
    there += ["gates"] if stored(folder.path) else []
    told = [_of_kind(kind, kinds[kind], folder, home, recorded, say) for kind in there]
    made = [one for each in told for one in each.made]
    summary: dict[str, Any] = {
        "slug": folder.slug,
        "name": folder.name,
        "up": folder.up,
        "kinds": there,
        "config": provenance.config_of(folder.path),
        "scenes": provenance.scenes_of(folder.path),
        "made": made,
        "from": min((one["from"] or "" for one in made), default=""),
        "to": max((one["to"] or "" for one in made), default=""),
        "plots": [{"id": name, "title": title} for each in told for name, title in each.plots],
        "findings": [said for each in told for said in each.findings],
        "failures": [cause for each in told for cause in each.failures],
        "pictures": _pictures(folder),
    }
    for each in told:
        summary |= each.facts
    return Overview(summary, {name: value for each in told for name, value in each.scripts.items()})


def _of_kind(kind: str, read: _Read, folder: Folder, home: Path, recorded: bool, say: Say) -> _Told:
    """Build the section of one kind of rows.

    Raises:
        InputError: if the rows are inconsistent.
    """
    try:
        return read(folder, home, recorded, say)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        problem = f"holds rows of the kind {kind} that do not fit together ({type(error).__name__}: {error})"
        raise InputError(Mistake(f"{problem}; take them out of the results", folder.path)) from error


def _runs(folder: Folder, home: Path, recorded: bool, say: Say) -> _Told:
    table = runs.read(folder, _remark(say))
    found = runs.table_of(folder, table)
    scripts: dict[str, Any] = {}
    findings = [{"words": words} for words in of_devices(table, provenance.config_of(folder.path))] + sentences(found)
    if speed.is_speed(table):
        scripts["speed"], said = speed.chart(table)
        findings = [{"words": words} for words in said]
    outcomes: dict[str, Any] = {}
    if hard.judged(table):
        scripts["hard"] = hard.chart(folder)
        outcomes = hard.outcomes(scripts["hard"])
        findings = [{"words": f"{scripts['hard']['headline']}.", "plot": "hard"}, *findings[-1:]]
    plots = [(name, chart["title"]) for name, chart in scripts.items()]
    _add_recorded(folder, home, found, recorded, say)
    scripts["runs"] = runs.as_script(folder, found, outcomes)
    _parquet(home / "runs.parquet", found)
    frames.write(folder, table, home, _without(folder, home, found))
    failed = [Failed(r["scene"], r["label"], r["status"], r["reason"] or "", r["run_id"]) for r in found]
    facts = {
        "runs": len(found),
        "statuses": Counter(run["status"] for run in found),
        "took": sum(run["took"] or 0.0 for run in found),
        "solvers": sorted({run["solver"] for run in found}),
        "sizes": sorted({run["size"] for run in found if run["size"]}),
        "other": sum(run["by"] == "other code" for run in found),
    }
    bad = causes(one for one in failed if one.status != "ok")
    return _Told(scripts, plots, findings, bad, provenance.made(table, "run_id"), facts)


def _add_recorded(folder: Folder, home: Path, found: Sequence[dict[str, Any]], anew: bool, say: Say) -> None:
    """Mark whether each run's last frame and recording are in the page's data.

    With `anew`, missing ones are added.
    """
    there = {part: {path.stem for path in (home / part).glob("*.js")} for part in ("meshes", "recordings")}
    if anew and (recorded := {run["unit"]: title(run) for run in found if run["recording"]}):
        from harness.report.site.meshes import write_last, write_recordings

        there["meshes"] = write_last(folder, home, list(recorded), say)
        kept = {f"recordings/{unit}.rrd": words for unit, words in recorded.items()}
        there["recordings"] = {Path(name).stem for name in write_recordings(folder, home, kept)}
    for run in found:
        run |= {name: int(run["unit"] in there[part]) for name, part in (("mesh", "meshes"), ("replay", "recordings"))}


def _without(folder: Folder, home: Path, found: Sequence[dict[str, Any]]) -> list[str]:
    """Find the runs whose script is missing or older than their rows."""
    scripts, rows_of = _written(home / "runs"), _written(folder.path / "rows")
    packed = shelf.packed_file(folder.path / "rows")
    otherwise = packed.stat().st_mtime_ns if packed.exists() else 0
    return [r["run_id"] for r in found if scripts.get(r["run_id"], -1) < rows_of.get(r["unit"], otherwise)]


def _written(folder: Path) -> dict[str, int]:
    """Return the modification time [ns] of each file in a folder by its stem."""
    if not folder.is_dir():
        return {}
    with os.scandir(folder) as entries:
        return {os.path.splitext(entry.name)[0]: entry.stat().st_mtime_ns for entry in entries}


def _parquet(path: Path, found: Sequence[dict[str, Any]]) -> None:
    """Write the table of runs as a Parquet file for other programs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        pq.write_table(pa.Table.from_pylist([{k: v for k, v in r.items() if k != "settings"} for r in found]), partial)


def _accuracy(folder: Folder, home: Path, recorded: bool, say: Say) -> _Told:
    from harness.report.accuracy.findings import failures, findings
    from harness.report.accuracy.measured import without_short
    from harness.report.accuracy.reading import read
    from harness.report.site.accuracy import charts

    table = read(folder.path, left_out=_remark(say))
    scripts, facts = charts(table, folder.path), dict[str, Any]()
    if recorded:
        from harness.report.site.meshes import write_recordings, write_solves

        facts["solves"] = write_solves(folder, home, without_short(table), say)
        kept = {c.recording: f"{c.label}, {c.problem.name}" for c in table.curves if c.recording in facts["solves"]}
        facts["replays"] = write_recordings(folder, home, kept)
    chapters = findings(table)
    told = [{"words": w, "chapter": name} for name, some in chapters.items() if name != "Methods" for w in some]
    failed = [Failed(row["where"], row["solver"], row["status"], row["reason"]) for row in failures(table)]
    plots = [(name, chart["title"]) for name, chart in scripts.items()]
    facts |= {"curves": len(table.curves), "works": len(table.works)}
    return _Told(scripts, plots, told, causes(failed), provenance.made(_plain(folder, "accuracy"), "unit"), facts)


def _ablation(folder: Folder, home: Path, recorded: bool, say: Say) -> _Told:
    table = _plain(folder, "ablation", say)
    scripts, words = ablation.charts(table.to_pylist())
    plots = [(name, chart["title"]) for name, chart in scripts.items()]
    said = [{"words": f"{one}.", "chapter": "Effects"} for one in words]
    return _Told(dict(scripts), plots, said, [], provenance.made(table, shelf.FILE), {"ablations": len(words)})


def _gates(folder: Folder, home: Path, recorded: bool, say: Say) -> _Told:
    from harness.report.site import gates

    known = gates.read(stored(folder.path), say)
    scripts, found = gates.charts(known)
    plots = [(name, chart["title"]) for name, chart in scripts.items()]
    facts = {"gates": len({item["gate"] for chart in scripts.values() for item in chart["items"]})}
    return _Told(scripts, plots, found, [], gates.made(known), facts)


def _plain(folder: Folder, kind: str, say: Say = lambda words: None) -> pa.Table:
    units = shelf.units(folder.path / kind)
    return rows.read(units, pa.schema([]), named=True, promote="permissive", left_out=_remark(say))


def _remark(say: Say) -> Callable[[Mistake], None]:
    """Return a function that prints a remark on each skipped unit of rows."""
    return lambda mistake: say(f"not on the page: {mistake}")


def title(run: dict[str, Any]) -> str:
    """Return the scene, size and label of a run."""
    return f"{run['scene']}{' ' + str(run['size']) if run['size'] else ''}, {run['label']}"


def _pictures(folder: Folder) -> list[dict[str, str]]:
    """Select pictures of a sweep: solver comparisons before single runs, large meshes before small ones."""
    found = sorted((folder.path / "pictures").glob("*.png"), key=_worth, reverse=True)
    found += [p for name in ("convergence", "work") for p in sorted((folder.path / "report").glob(f"{name}/*.png"))][:2]
    times = [path for path in found if path.stem == "timing"]
    shown = [*[path for path in found if path.stem != "timing"][: _PICTURES - len(times)], *times]
    return [
        {"path": p.relative_to(folder.path).as_posix(), "words": _HASH.sub("", p.stem).replace("-", " ")} for p in shown
    ]


def _worth(path: Path) -> tuple[bool, int, str]:
    sizes = [int(part) for part in path.stem.split("-") if part.isdigit()]
    return path.stem.endswith("-solvers"), max(sizes, default=0), path.stem

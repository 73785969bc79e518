"""What the end of a sweep says: what was learned, in sentences, and what to do next, in commands."""

from __future__ import annotations

import shlex
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from textwrap import wrap

import pyarrow as pa

from harness.report.page import quantity
from harness.report.timing_table import WIDTH, RunTimes, labels, runs

SAME = 10.0
"""Residuals within this factor of the lowest are called equal, here and on the page."""

GROWS = 1.5
"""The largest strain is said to grow where it does by this factor, and by as much more than what 99 % stay below."""


def closing(table: pa.Table, config: Path, results: Path, folder: Path) -> list[str]:
    """The last lines of a sweep, none longer than WIDTH but for paths: what was learned, what to do next, the page.

    table: its rows; config: what was run; results: the folder of all sweeps' results; folder: that of this one's.
    """
    found, page = runs(table), results / "index.html"
    told = sentences(found)
    lines = ["what was learned:", *(f"  {line}" for line in told)] if told else []
    lines += ["what to do next:", *commands(found, config, results, folder / "recordings")]
    return [*lines, f"everything on one page: {page.resolve().as_uri()}"] if page.is_file() else lines


def sentences(found: Sequence[RunTimes]) -> list[str]:
    """What runs say of which solver is fastest, of how they stopped and of their strain; each a line or more."""
    fine, names = [run for run in found if run.status == "ok"], labels(found)
    told = [*_fastest(fine, names), *_stopped(fine), *_strain(fine)]
    return [line for sentence in told for line in wrap(sentence, WIDTH - 2, subsequent_indent="  ")]


def commands(found: Sequence[RunTimes], config: Path, results: Path, recordings: Path) -> list[str]:
    """What to do next, with a word on each: replay a run, find the fastest at equal accuracy, see everything.

    config: what was run; recordings: the folder of the sweep's.
    """
    told: list[tuple[str, Path | str, str]] = []
    if best := _to_see(found, recordings):
        told.append(("springbench view", best, "replay the fastest run of the largest mesh"))
    scenes = {run.scene: None for run in found}
    if scene := next(filter(None, (_scene(config, name) for name in scenes)), None):
        told.append(("springbench recommend --error 1e-2", scene, "the cheapest way to an error of 1 %"))
    told.append(("springbench report", results, "bring the page up to date, with recordings that it replays"))
    return [line for words, path, why in told for line in (f"  # {why}", f"  {words} {shlex.quote(str(path))}")]


def _fastest(fine: Iterable[RunTimes], names: dict[str, str]) -> Iterator[str]:
    """For each scene, at the largest of the sizes that most solvers did on one machine: how much longer the others
    took there."""
    by_place: dict[str, dict[tuple[int, str, str], list[RunTimes]]] = defaultdict(lambda: defaultdict(list))
    for run in fine:
        if run.least:
            by_place[run.scene][run.size, run.machine or "", run.node or ""].append(run)
    for scene, sizes in by_place.items():
        (size, *_), there = max(sizes.items(), key=lambda item: (len(item[1]), item[0]))
        first, *others = sorted(there, key=lambda run: run.least or 0.0)
        if others:
            slower = [f"{names[r.run_id]} {quantity((r.least or 0.0) / (first.least or 1.0))} times" for r in others]
            where = f"{scene} {size}" if size else scene
            yield f"{where}, {_equal(there)}: a step by {names[first.run_id]} is shortest; {', '.join(slower)} as long."


def _equal(runs: Iterable[RunTimes]) -> str:
    residuals = [run.residual for run in runs if run.residual is not None]
    if not residuals:
        return "no residuals to compare"
    low, high = min(residuals), max(residuals)
    return f"equal residuals, {high:.1e}" if high <= SAME * low else f"unequal residuals, {low:.1e} to {high:.1e}"


def _stopped(fine: Sequence[RunTimes]) -> Iterator[str]:
    limited = [run for run in fine if run.stopped == "iterations"]
    if limited:
        many = f"All {len(fine)} runs" if len(limited) == len(fine) else f"{len(limited)} of {len(fine)} runs"
        yield f"{many} stopped at the limit of iterations, at no tolerance: where they agree, all may be wrong alike."


def _strain(fine: Iterable[RunTimes]) -> Iterator[str]:
    """Where the largest strain tells of the mesh more than of the material."""
    by_scene: dict[str, dict[int, tuple[float, float]]] = defaultdict(dict)
    for run in fine:
        if run.largest_strain is not None and run.strain_99:
            by_scene[run.scene][run.size] = (run.largest_strain, run.strain_99)
    for scene, sizes in by_scene.items():
        (largest, most), (finer, below) = sizes[min(sizes)], sizes[max(sizes)]
        if finer > GROWS * largest and finer / largest > GROWS * below / most:
            low, high = f"{100 * most:.3g}", f"{100 * below:.3g}"
            yield (
                f"{scene}: the largest strain grows with the mesh, from {100 * largest:.3g} to {100 * finer:.3g} %, "
                f"where 99 % of the springs stay below {low} and {high} %: the material is the same, "
                "but a single vertex that bears a load, such as a pin, is a point load, near which strain has no limit."
            )


def _to_see(found: Iterable[RunTimes], recordings: Path) -> Path | None:
    """The recording of the fastest run of the largest mesh."""
    order = sorted((run for run in found if run.least), key=lambda run: (-(run.vertices or 0), run.least))
    there = (next(recordings.glob(f"*-{run.run_id}.rrd"), None) for run in order)
    return next(filter(None, there), None)


def _scene(config: Path, name: str) -> Path | None:
    """The file of a scene, where it lies as the project's own do."""
    known = (config, *(folder / f"{name}.yaml" for folder in (config.parent, config.parent / "scenes")))
    return next((path for path in known if path.stem == name and path.is_file()), None)

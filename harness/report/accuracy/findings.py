"""Findings of an accuracy measurement, in words (`findings.md`) and as a table for programs (`summary.json`)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from harness.report.accuracy import engines, work_plot
from harness.report.accuracy.convergence import GUESSES, remarks
from harness.report.accuracy.growth import TARGET, growths
from harness.report.accuracy.measured import Curve, Measurements, Values, by_self_converged, without_short
from harness.report.accuracy.paper import FAR, FIGURE_2, ITERATIONS, PaperComparison, comparisons
from harness.report.accuracy.profiles import least_ratios
from harness.report.accuracy.times import STEPS, TARGETS, crossings, power, races, reach, seconds_to
from harness.report.page import factor
from harness.report.references import cited

Chapters = dict[str, list[str]]


def findings(table: Measurements) -> Chapters:
    """Summarise the findings as sentences by chapter title; chapters without sentences are omitted."""
    compared = without_short(table)
    chapters = {
        "Over all steps": list(_profiles(compared)),
        "Time to accuracy": list(_times(compared)),
        "Work and precision": list(_works(table)),
        "Outside engines: times as long as ours, by the best setting of each": list(engines.table(table.works)),
        "Best settings of outside engines": list(engines.settings(table.works)),
        "Growth with size": list(_growth(compared)),
        "Liu et al. 2013": list(_paper(table)),
        "References that are not certified": [f"{p.name}: {p.doubt}" for p in table.problems if p.doubt],
        "Other minima": [f"{c.problem.name}: {words}" for c in table.curves if c.branch for words in remarks([c])],
    }
    chapters["Methods"] = list(_methods(table))
    return {title: sentences for title, sentences in chapters.items() if sentences}


def failures(table: Measurements) -> list[dict[str, str]]:
    """List the runs whose status is not ok, with status and reason."""
    curves = [
        (f"{c.problem.name}, {GUESSES.get(c.first_guess, c.first_guess)}", c.label, c.status, c.reason)
        for c in table.curves
    ]
    works = [(w.mesh, w.setting, w.status, w.reason) for w in table.works]
    keys = ("where", "solver", "status", "reason")
    return [dict(zip(keys, row, strict=True)) for row in dict.fromkeys(curves + works) if row[2] != "ok"]


def summary(table: Measurements) -> list[dict[str, Any]]:
    """Build a summary entry for each curve.

    It has the identification, the result, and the seconds to each accuracy (null if not reached).
    """
    return [_entry(curve) for curve in table.curves]


def write_findings(path: Path, title: str, chapters: Chapters, failed: list[dict[str, str]]) -> None:
    """Write the chapters and the failures as Markdown.

    Args:
        path: target file.
        title: heading of the file.
        chapters: sentences by chapter title.
        failed: failures, as `failures` returns them.
    """
    lines = [f"# {title}", ""]
    for chapter, sentences in chapters.items():
        lines += [f"## {chapter}", "", *(s if s.startswith("|") else f"- {s}" for s in sentences), ""]
    if failed:
        lines += ["## What did not succeed", "", "| where | solver | status | reason |", "|---|---|---|---|"]
        lines += [
            "| " + " | ".join(" ".join(v.split()).replace("|", "\\|") for v in row.values()) + " |" for row in failed
        ]
        lines += [""]
    path.write_text("\n".join(lines), encoding="utf-8")


def write_summary(path: Path, table: Measurements) -> None:
    """Write the summary as JSON."""
    path.write_text(json.dumps(summary(table), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _entry(curve: Curve) -> dict[str, Any]:
    problem = curve.problem
    found = {power(target): reach(curve, target) for target in TARGETS}
    ended = np.flatnonzero(np.isfinite(curve.gap))
    return {
        "scene": problem.scene,
        "size": problem.size,
        "vertices": problem.vertices,
        "moment": problem.moment,
        "problem": problem.digest,
        "certified": not problem.doubt,
        "integrator": problem.integrator,
        "time_step": problem.time_step,
        "solver": curve.solver,
        "parameters": json.loads(curve.parameters),
        "threads": curve.threads,
        "first_guess": curve.first_guess,
        "status": curve.status,
        "reason": curve.reason,
        "minimum": curve.branch,
        "iterations": int(curve.iterations[-1]) if len(curve.iterations) else None,
        "gap": float(curve.gap[ended[-1]]) if len(ended) else None,
        "set_up_seconds": _finite(curve.warm),
        "set_up_cold_seconds": _finite(curve.cold),
        "to_gap": {
            name: reached
            and {"iterations": reached.iteration, "seconds": reached.seconds}
            | {"lower_quartile": reached.lower, "upper_quartile": reached.upper}
            | {f"with_set_up_over_{n}": _finite(seconds_to(curve, float(name), n)) for n in STEPS}
            for name, reached in found.items()
        },
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _methods(table: Measurements) -> Iterator[str]:
    """Yield the citation of each solver."""
    references = {each.solver: each.reference for each in (*table.curves, *table.works)}
    for solver, reference in references.items():
        if reference:
            yield f"{solver}: {cited(reference)}."


def _times(table: Measurements) -> Iterator[str]:
    for (_, guess), race in races(table).items():
        problem = race[0].problem
        sentences = crossings(race)
        if sentences:
            doubt = " (reference not certified)" if problem.doubt else ""
            yield f"{problem.name}, {GUESSES.get(guess, guess)}{doubt}: {'; '.join(sentences)}."


def _profiles(table: Measurements) -> Iterator[str]:
    for target in TARGETS:
        found = {label: values for label, values in least_ratios(table, target).items() if len(values)}
        if found:
            wins = {label: int(np.sum(values <= 1.0)) for label, values in found.items()}
            count = len(next(iter(found.values())))
            first = sorted(wins, key=lambda label: -wins[label])[:3]
            told = ", ".join(f"{label} on {wins[label]} ({_times_of(found[label])})" for label in first if wins[label])
            yield f"To {power(target)}, of {count} problems: fastest is {told}."


def _times_of(values: Values) -> str:
    worst = float(np.max(values))
    return f"at worst {factor(worst)} times the fastest" if np.isfinite(worst) else "and not there on all"


def _works(table: Measurements) -> Iterator[str]:
    for mesh in dict.fromkeys(work.mesh for work in table.works):
        for sentence in work_plot.findings([work for work in table.works if work.mesh == mesh]):
            yield f"{mesh}: {sentence}."
    yield from by_self_converged(table.works)


def _growth(table: Measurements) -> Iterator[str]:
    for g in growths(table):
        if np.isfinite(g.exponent):
            sizes = f"{g.vertices[0]} to {g.vertices[-1]} vertices"
            where = f"{g.scene}, {GUESSES[g.first_guess]}"
            yield f"{where}: {g.label} grows as n^{g.exponent:.2f} to {power(TARGET)} ({sizes})."


def _paper(table: Measurements) -> Iterator[str]:
    """Yield a Markdown table with one row per curve of both figures.

    Cells show own error / the paper's error, bold where they differ strongly.
    """
    by_curve: dict[str, dict[int, PaperComparison]] = {}
    for found in comparisons(table):
        by_curve.setdefault(found.curve, {})[found.iterations] = found
    if not by_curve:
        return
    counts = sorted({*FIGURE_2, *ITERATIONS})
    yield "| curve | frames | " + " | ".join(f"after {n}" for n in counts) + " |"
    yield "|---|---|" + "---|" * len(counts)
    for curve, points in by_curve.items():
        frames = next(iter(points.values())).frames
        cells = (_cell(points[n]) if n in points else "" for n in counts)
        yield f"| {curve} | {frames} | " + " | ".join(cells) + " |"


def _cell(found: PaperComparison) -> str:
    """Format the own error, the paper's error and their ratio."""
    far = "**" if max(found.ratio, 1 / found.ratio) > FAR else ""
    return f"{found.ours:.2g} / {found.theirs:.2g} = {far}{found.ratio:.2g}{far}"

"""Findings of an accuracy measurement, in words (`findings.md`) and as a table for programs (`summary.json`)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from springbench.harness.report.accuracy import engine_comparison, work_precision
from springbench.harness.report.accuracy.accuracy_data import (
    INITIAL_GUESS_LABELS,
    AccuracyData,
    ConvergenceCurve,
    FloatArray,
    describe_self_converged,
    without_short_curves,
)
from springbench.harness.report.accuracy.liu2013_comparison import (
    LIU2013_FIGURE_2,
    LIU2013_ITERATIONS,
    MAX_ERROR_RATIO,
    PaperComparison,
    compare_with_paper,
)
from springbench.harness.report.accuracy.performance_profiles import compute_performance_ratios
from springbench.harness.report.accuracy.size_scaling import GAP_TARGET, fit_scalings
from springbench.harness.report.accuracy.time_to_accuracy import (
    AMORTISATION_STEPS,
    GAP_TARGETS,
    compute_amortised_seconds,
    describe_crossings,
    find_time_to_accuracy,
    format_gap,
    group_by_start,
)
from springbench.harness.report.citations import format_citation
from springbench.harness.report.number_format import format_factor

FindingChapters = dict[str, list[str]]


def summarise_findings(table: AccuracyData) -> FindingChapters:
    """Summarise the findings as sentences by chapter title; chapters without sentences are omitted."""
    compared = without_short_curves(table)
    chapters = {
        "Over all steps": list(_describe_profiles(compared)),
        "Time to accuracy": list(_describe_times(compared)),
        "Work and precision": list(_describe_work_precision(table)),
        "Outside engines: times as long as ours, by the best setting of each": list(
            engine_comparison.format_markdown_table(table.work_points)
        ),
        "Best settings of outside engines": list(engine_comparison.describe_best_settings(table.work_points)),
        "Growth with size": list(_describe_scaling(compared)),
        "Liu et al. 2013": list(_describe_liu2013(table)),
        "References that are not certified": [
            f"{p.problem_label}: {p.uncertified_reason}" for p in table.problems if p.uncertified_reason
        ],
        "Other minima": [
            f"{c.problem.problem_label}: {words}"
            for c in table.curves
            if c.minimum_index
            for words in describe_failures([c])
        ],
    }
    chapters["Methods"] = list(_describe_methods(table))
    return {title: sentences for title, sentences in chapters.items() if sentences}


def list_failures(table: AccuracyData) -> list[dict[str, str]]:
    """List the runs whose status is not ok, with status and reason."""
    curves = [
        (
            f"{c.problem.problem_label}, {INITIAL_GUESS_LABELS.get(c.initial_guess, c.initial_guess)}",
            c.label,
            c.status,
            c.reason,
        )
        for c in table.curves
    ]
    works = [(w.mesh_label, w.setting_label, w.status, w.reason) for w in table.work_points]
    keys = ("where", "solver", "status", "reason")
    return [dict(zip(keys, row, strict=True)) for row in dict.fromkeys(curves + works) if row[2] != "ok"]


def build_curve_summary(table: AccuracyData) -> list[dict[str, Any]]:
    """Build a summary entry for each curve.

    It has the identification, the result, and the seconds to each accuracy (null if not reached).
    """
    return [_build_entry(curve) for curve in table.curves]


def write_findings(path: Path, title: str, chapters: FindingChapters, failed: list[dict[str, str]]) -> None:
    """Write the chapters and the failures as Markdown.

    Args:
        path: target file.
        title: heading of the file.
        chapters: sentences by chapter title.
        failed: failures, as `list_failures` returns them.
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


def write_summary(path: Path, table: AccuracyData) -> None:
    """Write the summary as JSON.

    Args:
        path: target file, overwritten.
        table: data of an accuracy measurement.

    Raises:
        ValueError: a value of the summary is not finite.
    """
    path.write_text(json.dumps(build_curve_summary(table), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _build_entry(curve: ConvergenceCurve) -> dict[str, Any]:
    problem = curve.problem
    found = {format_gap(target): find_time_to_accuracy(curve, target) for target in GAP_TARGETS}
    ended = np.flatnonzero(np.isfinite(curve.gap))
    return {
        "scene": problem.scene,
        "size": problem.size,
        "vertices": problem.vertices,
        "snapshot": problem.snapshot,
        "problem_digest": problem.problem_digest,
        "is_certified": not problem.uncertified_reason,
        "integrator": problem.integrator,
        "time_step": problem.time_step,
        "solver": curve.solver,
        "parameters": json.loads(curve.parameters),
        "threads": curve.threads,
        "initial_guess": curve.initial_guess,
        "status": curve.status,
        "reason": curve.reason,
        "minimum_index": curve.minimum_index,
        "last_iteration": int(curve.iterations[-1]) if len(curve.iterations) else None,
        "last_gap": float(curve.gap[ended[-1]]) if len(ended) else None,
        "setup_seconds": _finite_or_none(curve.warm_seconds),
        "setup_cold_seconds": _finite_or_none(curve.cold_seconds),
        "time_to_gap": {
            name: reached
            and {"iteration": reached.iteration, "seconds": reached.seconds}
            | {"lower_quartile": reached.lower, "upper_quartile": reached.upper}
            | {
                f"with_setup_over_{n}": _finite_or_none(compute_amortised_seconds(curve, float(name), n))
                for n in AMORTISATION_STEPS
            }
            for name, reached in found.items()
        },
    }


def _finite_or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _describe_methods(table: AccuracyData) -> Iterator[str]:
    """Yield the citation of each solver."""
    references = {each.solver: each.citation for each in (*table.curves, *table.work_points)}
    for solver, reference in references.items():
        if reference:
            yield f"{solver}: {format_citation(reference)}."


def _describe_times(table: AccuracyData) -> Iterator[str]:
    for (_, guess), curves in group_by_start(table).items():
        problem = curves[0].problem
        sentences = describe_crossings(curves)
        if sentences:
            doubt = " (reference not certified)" if problem.uncertified_reason else ""
            yield f"{problem.problem_label}, {INITIAL_GUESS_LABELS.get(guess, guess)}{doubt}: {'; '.join(sentences)}."


def _describe_profiles(table: AccuracyData) -> Iterator[str]:
    for target in GAP_TARGETS:
        found = {label: values for label, values in compute_performance_ratios(table, target).items() if len(values)}
        if found:
            wins = {label: int(np.sum(values <= 1.0)) for label, values in found.items()}
            count = len(next(iter(found.values())))
            first = sorted(wins, key=lambda label: -wins[label])[:3]
            description = ", ".join(
                f"{label} on {wins[label]} ({_format_factor(found[label])})" for label in first if wins[label]
            )
            yield f"To {format_gap(target)}, of {count} problems: fastest is {description}."


def _format_factor(values: FloatArray) -> str:
    worst = float(np.max(values))
    return f"at worst {format_factor(worst)} times the fastest" if np.isfinite(worst) else "and not there on all"


def _describe_work_precision(table: AccuracyData) -> Iterator[str]:
    for mesh in dict.fromkeys(work.mesh_label for work in table.work_points):
        for sentence in work_precision.describe_cheapest_settings(
            [work for work in table.work_points if work.mesh_label == mesh]
        ):
            yield f"{mesh}: {sentence}."
    yield from describe_self_converged(table.work_points)


def _describe_scaling(table: AccuracyData) -> Iterator[str]:
    for g in fit_scalings(table):
        if np.isfinite(g.exponent):
            sizes = f"{g.vertices[0]} to {g.vertices[-1]} vertices"
            where = f"{g.scene}, {INITIAL_GUESS_LABELS[g.initial_guess]}"
            yield f"{where}: {g.label} grows as n^{g.exponent:.2f} to {format_gap(GAP_TARGET)} ({sizes})."


def _describe_liu2013(table: AccuracyData) -> Iterator[str]:
    """Yield a Markdown table with one row per curve of both figures.

    Cells show own error / the paper's error = ratio; the ratio is bold beyond MAX_ERROR_RATIO.
    """
    by_curve: dict[str, dict[int, PaperComparison]] = {}
    for found in compare_with_paper(table):
        by_curve.setdefault(found.curve, {})[found.iterations] = found
    if not by_curve:
        return
    counts = sorted({*LIU2013_FIGURE_2, *LIU2013_ITERATIONS})
    yield "| curve | frames | " + " | ".join(f"after {n}" for n in counts) + " |"
    yield "|---|---|" + "---|" * len(counts)
    for curve, points in by_curve.items():
        frames = next(iter(points.values())).frames
        cells = (_format_comparison(points[n]) if n in points else "" for n in counts)
        yield f"| {curve} | {frames} | " + " | ".join(cells) + " |"


def _format_comparison(comparison: PaperComparison) -> str:
    """Format the own error, the paper's error and their ratio."""
    far = "**" if max(comparison.error_ratio, 1 / comparison.error_ratio) > MAX_ERROR_RATIO else ""
    return f"{comparison.own_error:.2g} / {comparison.published_error:.2g} = {far}{comparison.error_ratio:.2g}{far}"


def describe_failures(curves: Sequence[ConvergenceCurve]) -> list[str]:
    """Describe failures and convergence to another minimum, one sentence each."""
    words: list[str] = []
    for curve in curves:
        if curve.status != "ok":
            why = f": {curve.reason}" if curve.reason else ""
            words.append(
                f"× {curve.label}, {INITIAL_GUESS_LABELS.get(curve.initial_guess, curve.initial_guess)}, "
                f"{curve.status}{why}"
            )
        if curve.minimum_index:
            words.append(
                f"{curve.label}, {INITIAL_GUESS_LABELS.get(curve.initial_guess, curve.initial_guess)}, "
                f"ended in minimum {curve.minimum_index}, "
                "higher than the lowest known (minimum 0); its vertex errors refer to the minimum that it reached"
            )
    return words

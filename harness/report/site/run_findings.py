"""Sentences on the runs of a sweep: fastest at equal accuracy, unconverged runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from springbench.harness.report import equal_accuracy
from springbench.harness.report.site.run_table import RunRecord, restore_run_times


def describe_runs(run_records: Sequence[RunRecord]) -> list[dict[str, Any]]:
    """Describe runs in sentences, each with the ids of its runs (`equal_accuracy`)."""
    names = {run["run_id"]: run["label"] for run in run_records}
    sentences = [
        {"text": words, "runs": runs}
        for compared in equal_accuracy.compare_runs(map(restore_run_times, run_records))
        for words, runs in equal_accuracy.describe_comparison(compared, names)
    ]
    return sentences + list(_describe_unconverged(run_records))


def _describe_unconverged(run_records: Sequence[RunRecord]) -> Iterator[dict[str, Any]]:
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

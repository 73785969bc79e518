"""Live study: real performance tests of a checkout against itself, to validate the replay study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from statistics import median
from typing import Any

import pyarrow as pa
from springbench.harness.experiments.regression.abba_benchmark import run_confirmed_benchmark
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest, SequentialVerdict
from springbench.harness.experiments.regression.replay_study import run_background_load
from springbench.harness.experiments.regression.revision_comparison import (
    ComparisonOptions,
    WorkRequest,
    start_revisions,
)
from springbench.harness.experiments.regression.revision_process import GitRevision
from springbench.harness.results import parquet_rows, run_schema

LIVE_STUDY_SCHEMA = run_schema.build_schema(
    (
        run_schema.ColumnSpec("gate", pa.string(), "", "what takes turns"),
        run_schema.ColumnSpec("condition", pa.string(), "", "what was run beside it: nothing, busy or bursty"),
        run_schema.ColumnSpec("planted", pa.float64(), "", "extra work of the candidate, as a part of its iterations"),
        run_schema.ColumnSpec("limit", pa.float64(), "", "ratio of times from which on it counts as slower"),
        run_schema.ColumnSpec("answer", pa.string(), "", "holds, fails or undecided"),
        run_schema.ColumnSpec("ratio", pa.float64(), "", "median ratio of times over the turns"),
        run_schema.ColumnSpec("low", pa.float64(), "", "lower end of its confidence sequence"),
        run_schema.ColumnSpec("high", pa.float64(), "", "upper end"),
        run_schema.ColumnSpec("seconds", pa.float64(), "s", "until the answer"),
        run_schema.ColumnSpec("load", pa.float64(), "", "load average over a minute, at the end"),
    )
)


def run_live_study(
    path: Path,
    checkout: Path,
    requests: Sequence[WorkRequest],
    background_load: str,
    options: ComparisonOptions,
    *,
    num_repeats: int,
    injected_slowdown: float,
    print_message: Callable[[str], None],
) -> None:
    """Run performance tests of each request, and store each result at once.

    Earlier results in the file remain.

    Args:
        path: Parquet file of the results.
        checkout: folder of the checkout.
        requests: work to test.
        background_load: "nothing", "busy" or "bursty".
        options: limits of each test.
        num_repeats: number of tests of each request.
        injected_slowdown: extra work of the candidate, as a fraction of its iterations.
        print_message: receives one line per result.
    """
    found = parquet_rows.read_rows([path], LIVE_STUDY_SCHEMA).to_pylist() if path.exists() else []
    sides = GitRevision("the one", checkout, injected_slowdown=injected_slowdown), GitRevision("the other", checkout)
    rule = SequentialTest(options.max_ratio, options.alpha)
    told = cache(print_message)  # what differs is found at each start, and told once
    with run_background_load(background_load):
        for number in range(num_repeats):
            for request in requests:
                result = run_confirmed_benchmark(
                    partial(start_revisions, sides, request, options, told), rule, time_budget=options.budget
                )
                print_message(f"{number + 1} of {num_repeats}, {request.title}: {result}")
                held = {
                    "gate": request.title,
                    "condition": background_load,
                    "planted": injected_slowdown,
                    "limit": options.max_ratio,
                }
                held |= {"answer": result.verdict.name.lower(), "ratio": result.interval.ratio}
                held |= {"low": result.interval.low, "high": result.interval.high}
                found.append(held | {"seconds": result.elapsed_seconds, "load": result.load_average})
                parquet_rows.write_rows(path, found, LIVE_STUDY_SCHEMA)


def summarise_live_study(path: Path) -> list[tuple[str, ...]]:
    """Summarise the stored results by kind of test.

    A row has the conditions of the test, and the number of each verdict.
    """
    by: dict[tuple[str, str, float, float], list[dict[str, Any]]] = {}
    for row in parquet_rows.read_rows([path], LIVE_STUDY_SCHEMA).to_pylist():
        by.setdefault((row["gate"], row["condition"], row["planted"], row["limit"]), []).append(row)
    table: list[tuple[str, ...]] = []
    for (gate, condition, planted, limit), held in by.items():
        load, seconds = (median(row[name] for row in held) for name in ("load", "seconds"))
        answers = [row["answer"] for row in held]
        counts = [
            str(answers.count(answer.name.lower()))
            for answer in (SequentialVerdict.FAIL, SequentialVerdict.PASS, SequentialVerdict.INCONCLUSIVE)
        ]
        cells = [f"{load:.1f}", f"{planted:.0%}", f"{limit - 1:.0%}", str(len(held)), *counts, f"{seconds:.1f}"]
        table.append((gate, condition, *cells))
    return table

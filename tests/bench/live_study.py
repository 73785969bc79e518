"""Run real performance regression tests of a checkout against itself, to validate the replay study.

    python -m tests.bench.regress_study live RESULTS CONFIG

Both programs have the same code, so that each test without an injected slowdown should pass. The results are the
verdicts with their confidence sequences, and the conditions of each test.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from statistics import median
from typing import Any

import pyarrow as pa
from springbench.harness.experiments.regression.abba_benchmark import run_confirmed_benchmark
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest
from springbench.harness.experiments.regression.revision_comparison import (
    ComparisonOptions,
    WorkRequest,
    start_revisions,
)
from springbench.harness.experiments.regression.revision_process import GitRevision
from springbench.harness.results import parquet_rows, run_schema
from springbench.harness.results.regression_verdict import RegressionVerdict

from tests.bench.replay_study import run_background_load

LIVE_STUDY_SCHEMA = run_schema.build_schema(
    (
        run_schema.ColumnSpec("benchmark", pa.string(), "", "the benchmarked work"),
        run_schema.ColumnSpec("background_load", pa.string(), "", "background load: nothing, busy or bursty"),
        run_schema.ColumnSpec(
            "injected_slowdown", pa.float64(), "", "extra work of the candidate, as a fraction of its iterations"
        ),
        run_schema.ColumnSpec("max_ratio", pa.float64(), "", "ratio of times that counts as slower"),
        run_schema.ColumnSpec("verdict", pa.string(), "", "pass, fail or inconclusive"),
        run_schema.ColumnSpec("ratio", pa.float64(), "", "median ratio of times over the blocks"),
        run_schema.ColumnSpec("ratio_low", pa.float64(), "", "lower bound of its confidence sequence"),
        run_schema.ColumnSpec("ratio_high", pa.float64(), "", "upper bound"),
        run_schema.ColumnSpec("seconds", pa.float64(), "s", "until the verdict"),
        run_schema.ColumnSpec("load_average", pa.float64(), "", "load average over a minute, at the end"),
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
    """Run regression tests of each request, and store each result as soon as it is known.

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
    print_once = cache(print_message)  # each start reports the same differences
    with run_background_load(background_load):
        for number in range(num_repeats):
            for request in requests:
                result = run_confirmed_benchmark(
                    partial(start_revisions, sides, request, options, print_once), rule, time_budget=options.budget
                )
                print_message(f"{number + 1} of {num_repeats}, {request.title}: {result}")
                found.append(
                    {
                        "benchmark": request.title,
                        "background_load": background_load,
                        "injected_slowdown": injected_slowdown,
                        "max_ratio": options.max_ratio,
                        "verdict": result.verdict,
                        "ratio": result.interval.ratio,
                        "ratio_low": result.interval.low,
                        "ratio_high": result.interval.high,
                        "seconds": result.elapsed_seconds,
                        "load_average": result.load_average,
                    }
                )
                parquet_rows.write_rows(path, found, LIVE_STUDY_SCHEMA)


def summarise_live_study(path: Path) -> list[tuple[str, ...]]:
    """Summarise the stored results of tests under the same conditions.

    A row has the conditions of the tests, the number of each verdict, and the median duration.
    """
    grouped: dict[tuple[str, str, float, float], list[dict[str, Any]]] = {}
    for row in parquet_rows.read_rows([path], LIVE_STUDY_SCHEMA).to_pylist():
        grouped.setdefault(
            (row["benchmark"], row["background_load"], row["injected_slowdown"], row["max_ratio"]), []
        ).append(row)
    table: list[tuple[str, ...]] = []
    for (gate, condition, slowdown, max_ratio), rows in grouped.items():
        load, seconds = (median(row[name] for row in rows) for name in ("load_average", "seconds"))
        verdicts = [row["verdict"] for row in rows]
        counts = [
            str(verdicts.count(verdict))
            for verdict in (RegressionVerdict.FAIL, RegressionVerdict.PASS, RegressionVerdict.INCONCLUSIVE)
        ]
        cells = [f"{load:.1f}", f"{slowdown:.0%}", f"{max_ratio - 1:.0%}", str(len(rows)), *counts, f"{seconds:.1f}"]
        table.append((gate, condition, *cells))
    return table

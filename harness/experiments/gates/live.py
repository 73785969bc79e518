"""Live study: real performance tests of a checkout against itself, to validate the replay study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from statistics import median
from typing import Any

import pyarrow as pa

from harness.base import columns, rows
from harness.experiments.gates.abba import confirmed
from harness.experiments.gates.against import Options, Request, started
from harness.experiments.gates.pair import Side
from harness.experiments.gates.sequential import Rule, Verdict
from harness.experiments.gates.study import competing

SCHEMA = columns.schema_of(
    (
        columns.Column("gate", pa.string(), "", "what takes turns"),
        columns.Column("condition", pa.string(), "", "what was run beside it: nothing, busy or bursty"),
        columns.Column("planted", pa.float64(), "", "extra work of the candidate, as a part of its iterations"),
        columns.Column("limit", pa.float64(), "", "ratio of times from which on it counts as slower"),
        columns.Column("answer", pa.string(), "", "holds, fails or undecided"),
        columns.Column("ratio", pa.float64(), "", "median ratio of times over the turns"),
        columns.Column("low", pa.float64(), "", "lower end of its confidence sequence"),
        columns.Column("high", pa.float64(), "", "upper end"),
        columns.Column("seconds", pa.float64(), "s", "until the answer"),
        columns.Column("load", pa.float64(), "", "load average over a minute, at the end"),
    )
)


def hold(
    path: Path,
    checkout: Path,
    requests: Sequence[Request],
    condition: str,
    options: Options,
    *,
    gates: int,
    planted: float,
    say: Callable[[str], None],
) -> None:
    """Run performance tests of each request, and store each result at once.

    Earlier results in the file remain.

    Args:
        path: Parquet file of the results.
        checkout: folder of the checkout.
        requests: work to test.
        condition: "nothing", "busy" or "bursty".
        options: limits of each test.
        gates: number of tests of each request.
        planted: extra work of the candidate, as a fraction of its iterations.
        say: receives one line per result.
    """
    found = rows.read([path], SCHEMA).to_pylist() if path.exists() else []
    sides = Side("the one", checkout, extra=planted), Side("the other", checkout)
    rule = Rule(options.limit, options.alpha)
    told = cache(say)  # what differs is found at each start, and told once
    with competing(condition):
        for number in range(gates):
            for request in requests:
                result = confirmed(partial(started, sides, request, options, told), rule, budget=options.budget)
                say(f"{number + 1} of {gates}, {request.title}: {result}")
                held = {"gate": request.title, "condition": condition, "planted": planted, "limit": options.limit}
                held |= {"answer": result.answer.name.lower(), "ratio": result.interval.ratio}
                held |= {"low": result.interval.low, "high": result.interval.high}
                found.append(held | {"seconds": result.elapsed, "load": result.load})
                rows.write(path, found, SCHEMA)


def summary(path: Path) -> list[tuple[str, ...]]:
    """Summarise the stored results by kind of test.

    A row has the conditions of the test, and the number of each verdict.
    """
    by: dict[tuple[str, str, float, float], list[dict[str, Any]]] = {}
    for row in rows.read([path], SCHEMA).to_pylist():
        by.setdefault((row["gate"], row["condition"], row["planted"], row["limit"]), []).append(row)
    table: list[tuple[str, ...]] = []
    for (gate, condition, planted, limit), held in by.items():
        load, seconds = (median(row[name] for row in held) for name in ("load", "seconds"))
        answers = [row["answer"] for row in held]
        counts = [
            str(answers.count(answer.name.lower())) for answer in (Verdict.FAILS, Verdict.HOLDS, Verdict.UNDECIDED)
        ]
        cells = [f"{load:.1f}", f"{planted:.0%}", f"{limit - 1:.0%}", str(len(held)), *counts, f"{seconds:.1f}"]
        table.append((gate, condition, *cells))
    return table

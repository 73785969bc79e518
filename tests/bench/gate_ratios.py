"""Ratios of times of the gates whose names begin with given words, interleaved, next to their limits.

    python -m tests.bench.gate_ratios [accuracy ...] [--rounds 3] [--publish results/published/gate-ratios]

Candidate and baseline of a gate alternate in one process on one thread. A row is one round. A gate whose scene is not
there is left out. `pytest tests/bench --benchmark-only` decides whether a ratio is below its limit; this states how
large it is.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from statistics import median
from time import thread_time
from typing import Any

import pytest
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.execution.machine_info import limit_threads

from tests.bench.accuracy import ACCURACY
from tests.bench.gates import GATES, Gate, Work
from tests.bench.scripted_study import describe_moment, publish_rows

CONFIG = Path(__file__).parents[2] / "configs" / "accuracy.yaml"


def measure_gate(gate: Gate, num_rounds: int) -> list[dict[str, Any]]:
    """Measure a gate: one row for each round, or none if its scene is not there."""
    try:
        candidate, baseline = gate.candidate(), gate.yardstick()
    except pytest.skip.Exception as skipped:
        print(f"{gate.name}: left out, {skipped}", file=sys.stderr)
        return []

    def measure(work: Work) -> float:
        began = thread_time()
        work()
        return thread_time() - began

    measure(candidate)  # compiles
    return [
        {"gate": gate.name, "limit": gate.limit, "round": number, "time_ratio": measure(candidate) / measure(baseline)}
        for number in range(num_rounds)
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", default=["accuracy"], help="first words of the gates' names")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_moment(), list[dict[str, Any]]()
    table = Table("gate", "ratio", "limit", box=SIMPLE_HEAD)
    with limit_threads(1):
        for gate in (*GATES, *ACCURACY):
            if gate.name.startswith(tuple(options.names)) and (found := measure_gate(gate, options.rounds)):
                ratio = median(row["time_ratio"] for row in found)
                table.add_row(gate.name, f"{ratio:.2g}", f"{gate.limit:.2g}")
                rows += found
    Console(width=120).print(table)
    publish_rows(options.publish, CONFIG, "python -m tests.bench.gate_ratios", rows, begin)


if __name__ == "__main__":
    main()

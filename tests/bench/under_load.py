"""How often our own gates are wrong while other programs keep the machine busy: each is held so many times.

    python -m tests.bench.under_load [--times 50] [--condition busy] [--budget 10] [GATE ...]

A program on each core goes through memory beside them, always (`busy`) or in bursts (`bursty`); `nothing` leaves the
load to others. The work of both sides is prepared anew for each race. None may fail: what they compare lies below
their limits by more than a load moves ratios by.
"""

from __future__ import annotations

import argparse
from collections import Counter
from statistics import median

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.regression.abba_benchmark import BenchmarkResult, ProgramPair, run_paired_benchmark
from springbench.harness.experiments.regression.answer_agreement import describe_difference
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest, SequentialVerdict
from springbench.harness.experiments.regression.solver_pair import build_timer, choose_num_calls

from tests.bench.contact import CONTACT
from tests.bench.gates import GATES, THREADS, Gate
from tests.bench.replay_study import run_background_load

NAMED = {gate.name: gate for gate in (*GATES, *CONTACT)}
ASKED = ("harness-against-bare-solver-64", "numba-against-sparse-64", "idle-contact-against-none-64")


def held(gate: Gate, budget: float) -> BenchmarkResult:
    """One race of a gate, as `paired_benchmark` of the plugin for pytest has it."""
    candidate, yardstick = gate.candidate(), gate.yardstick()
    assert gate.tolerance is not None, f"{gate.name}: has no answers to compare"
    if said := describe_difference(candidate(), yardstick(), gate.tolerance):
        raise AssertionError(f"{gate.name}: {said}")
    calls = choose_num_calls(candidate, yardstick)
    a, b = (build_timer(work, calls, gate.clock) for work in (candidate, yardstick))
    return run_paired_benchmark(ProgramPair(a, b), SequentialTest(gate.limit, gate.error), time_budget=budget)


def main() -> None:
    """Print a row for each gate."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("gates", nargs="*", metavar="GATE", help=f"of {', '.join(NAMED)}")
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--condition", default="busy")
    parser.add_argument("--budget", type=float, default=10.0)
    asked = parser.parse_args()
    if unknown := sorted({*asked.gates} - NAMED.keys()):
        parser.error(f"{', '.join(unknown)}: no such gate; there are {', '.join(NAMED)}")
    console = Console(width=120)
    found: dict[str, list[BenchmarkResult]] = {name: [] for name in asked.gates or ASKED}
    with limit_threads(THREADS), run_background_load(asked.condition):
        for number in range(asked.times):
            for name, results in found.items():
                results.append(held(NAMED[name], asked.budget))
                console.print(f"{number + 1} of {asked.times}, {name}: {results[-1]}", style="dim")
    table = Table("gate", "limit", "fails", "holds", "cannot tell", "ratio", "median s", "load", box=SIMPLE_HEAD)
    for name, results in found.items():
        answers = Counter(result.verdict for result in results)
        counts = (
            str(answers[verdict])
            for verdict in (SequentialVerdict.FAIL, SequentialVerdict.PASS, SequentialVerdict.INCONCLUSIVE)
        )
        ratio, seconds, load = (
            median(values)
            for values in zip(*((r.interval.ratio, r.elapsed_seconds, r.load_average) for r in results), strict=True)
        )
        table.add_row(name, f"{NAMED[name].limit}", *counts, f"{ratio:.3f}", f"{seconds:.1f}", f"{load:.1f}")
    console.print(table)


if __name__ == "__main__":
    main()

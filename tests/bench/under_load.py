"""Measure how often this project's performance regression tests give a wrong verdict on a busy machine.

    python -m tests.bench.under_load [--times 50] [--background-load busy] [--budget 10] [GATE ...]

Each gate is run several times under a background load: a process on each core that sweeps over memory, constantly
(`busy`) or in bursts (`bursty`). `nothing` adds no load to that of other programs. Candidate and baseline are prepared
again for each run. A verdict `fail` is wrong, since each gate's ratio is below its limit by more than the effect of
the load. The table counts the verdicts, and has medians of ratio, duration and load average.
"""

from __future__ import annotations

import argparse
from collections import Counter
from statistics import median

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.regression.abba_benchmark import BenchmarkResult, run_paired_benchmark
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest
from springbench.harness.experiments.regression.program_pair import build_program_pair, require_agreement
from springbench.harness.results.regression_verdict import RegressionVerdict

from tests.bench.contact import CONTACT
from tests.bench.gates import GATES, THREADS, Gate
from tests.bench.replay_study import run_background_load

GATES_BY_NAME = {gate.name: gate for gate in (*GATES, *CONTACT)}
MEASURED_GATES = ("harness-against-bare-solver-64", "numba-against-sparse-64", "idle-contact-against-none-64")


def run_gate(gate: Gate, budget: float) -> BenchmarkResult:
    """Run the benchmark of a gate once, in the same way as `paired_benchmark` of the pytest plugin."""
    candidate, baseline = gate.candidate(), gate.baseline()
    assert gate.tolerance is not None, f"{gate.name}: has no results to compare"
    require_agreement(candidate(), baseline(), gate.tolerance)
    programs = build_program_pair(candidate, baseline, gate.clock)
    return run_paired_benchmark(programs, SequentialTest(gate.limit, gate.error), time_budget=budget)


def main() -> None:
    """Print a row for each gate."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("gates", nargs="*", metavar="GATE", help=f"of {', '.join(GATES_BY_NAME)}")
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--background-load", default="busy")
    parser.add_argument("--budget", type=float, default=10.0)
    options = parser.parse_args()
    if unknown := sorted({*options.gates} - GATES_BY_NAME.keys()):
        parser.error(f"{', '.join(unknown)}: no such gate; there are {', '.join(GATES_BY_NAME)}")
    console = Console(width=120)
    found: dict[str, list[BenchmarkResult]] = {name: [] for name in options.gates or MEASURED_GATES}
    with limit_threads(THREADS), run_background_load(options.background_load):
        for number in range(options.times):
            for name, results in found.items():
                results.append(run_gate(GATES_BY_NAME[name], options.budget))
                console.print(f"{number + 1} of {options.times}, {name}: {results[-1]}", style="dim")
    table = Table("gate", "limit", "fail", "pass", "inconclusive", "ratio", "median s", "load", box=SIMPLE_HEAD)
    for name, results in found.items():
        verdicts = Counter(result.verdict for result in results)
        counts = (
            str(verdicts[verdict])
            for verdict in (RegressionVerdict.FAIL, RegressionVerdict.PASS, RegressionVerdict.INCONCLUSIVE)
        )
        ratio, seconds, load = (
            median(values)
            for values in zip(*((r.interval.ratio, r.elapsed_seconds, r.load_average) for r in results), strict=True)
        )
        table.add_row(name, f"{GATES_BY_NAME[name].limit}", *counts, f"{ratio:.3f}", f"{seconds:.1f}", f"{load:.1f}")
    console.print(table)


if __name__ == "__main__":
    main()

"""Estimate error rates of performance regression tests by replay of recorded blocks.

    python -m tests.bench.regress_study record SAMPLES CONFIG
    python -m tests.bench.regress_study replay SAMPLES...

A record has the four times of each block of two processes A and B of the same code, for several process pairs. A replay
draws stretches of successive blocks, so that bursts of load are preserved, and concatenates them up to the budget. It
multiplies A's times by the slowdown and evaluates the test after every block. Every RESTART_SECONDS it continues with
the blocks of another process pair. It confirms failures with further blocks, as the test itself does.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from random import Random
from time import perf_counter, process_time, sleep
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from springbench.harness.errors import InputError
from springbench.harness.execution.worker_process import tie_to_parent
from springbench.harness.experiments.regression.abba_benchmark import (
    CONFIRMATION_ALPHA,
    RESTART_SECONDS,
    LayoutRandomiser,
    draw_block_orders,
)
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest, compute_critical_count
from springbench.harness.experiments.regression.revision_comparison import (
    ComparisonOptions,
    WorkRequest,
    start_revisions,
)
from springbench.harness.experiments.regression.revision_process import GitRevision
from springbench.harness.results import parquet_rows, run_schema
from springbench.harness.results.regression_verdict import RegressionVerdict

RECORD_COLUMNS = (
    run_schema.ColumnSpec("benchmark", pa.string(), "", "the benchmarked work"),
    run_schema.ColumnSpec("background_load", pa.string(), "", "background load: nothing, busy or bursty"),
    run_schema.ColumnSpec("process_pair", pa.int64(), "", "number of the process pair, from 0"),
    run_schema.ColumnSpec("order", pa.string(), "", "ABBA or BAAB"),
    *(run_schema.ColumnSpec(f"call_{k}", pa.float64(), "s", f"time of call {k} of the block") for k in range(4)),
    run_schema.ColumnSpec(
        "wall_seconds", pa.float64(), "s", "wall time of the block, and of rebuilding the work after it"
    ),
    run_schema.ColumnSpec("load_average", pa.float64(), "", "load average over a minute"),
    run_schema.ColumnSpec("injected_slowdown", pa.float64(), "", "extra work of A, as a fraction of its iterations"),
)
RECORD_SCHEMA = run_schema.build_schema(RECORD_COLUMNS)

BACKGROUND_LOADS = ("nothing", "busy", "bursty")
REPLAY_STRETCH = 25
"""Number of successive blocks of a stretch: some seconds, the duration of most bursts."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RecordedBlocks:
    """Recorded blocks of one process pair.

    log_ratios: (n,).
    a, b: times of A and of B (n, 2) [s].
    wall_seconds: mean wall time of a block [s].
    load_average: median load average of the machine.
    """

    log_ratios: FloatArray
    a: FloatArray
    b: FloatArray
    wall_seconds: float
    load_average: float


@dataclass(frozen=True, slots=True)
class ReplayRates:
    """Rates of the three verdicts of many replays, and the median duration [s]."""

    fail_rate: float
    pass_rate: float
    inconclusive_rate: float
    median_seconds: float


def record_blocks(
    path: Path,
    checkout: Path,
    requests: Sequence[WorkRequest],
    background_load: str,
    *,
    duration: float,
    num_process_pairs: int,
    injected_slowdown: float = 0.0,
) -> None:
    """Record blocks of the requests, alternating between them, under a background load.

    The file is written after each process pair. Its earlier rows remain, and the numbering of the pairs continues.

    Args:
        path: Parquet file of the blocks.
        checkout: folder of the checkout, which both programs run.
        requests: work to record.
        background_load: "nothing", "busy" or "bursty".
        duration: total time [s].
        num_process_pairs: number of starts of both processes.
        injected_slowdown: extra work of A, as a fraction of its iterations.
    """
    found = parquet_rows.read_rows([path], RECORD_SCHEMA).to_pylist() if path.exists() else []
    first = max((row["process_pair"] for row in found), default=-1) + 1
    sides = GitRevision("the one", checkout, injected_slowdown=injected_slowdown), GitRevision("the other", checkout)
    with run_background_load(background_load):
        for start in range(first, first + num_process_pairs):
            with ExitStack() as alive:
                pairs = [
                    alive.enter_context(start_revisions(sides, request, ComparisonOptions(duration), lambda line: None))
                    for request in requests
                ]
                randomisers = [LayoutRandomiser(programs.rebuild_work) for programs in pairs]
                until = perf_counter() + duration / num_process_pairs
                for order in draw_block_orders():
                    for request, programs, randomiser in zip(requests, pairs, randomisers, strict=True):
                        began = perf_counter()
                        calls = [{"A": programs.a, "B": programs.b}[name]() for name in order]
                        randomiser.rebuild_after(perf_counter() - began)
                        row = {
                            "benchmark": request.title,
                            "background_load": background_load,
                            "process_pair": start,
                            "order": order,
                        }
                        row |= {f"call_{k}": call for k, call in enumerate(calls)}
                        wall_seconds = perf_counter() - began
                        found.append(
                            row
                            | {
                                "wall_seconds": wall_seconds,
                                "load_average": os.getloadavg()[0],
                                "injected_slowdown": injected_slowdown,
                            }
                        )
                    if perf_counter() > until:
                        break
            parquet_rows.write_rows(path, found, RECORD_SCHEMA)


@contextmanager
def run_background_load(background_load: str) -> Generator[None]:
    """Run a background load on each core inside the block.

    It is constant (busy), intermittent (bursty) or absent (nothing).
    """
    if background_load not in BACKGROUND_LOADS:
        raise InputError(f"--background-load: got {background_load}; expected one of {', '.join(BACKGROUND_LOADS)}")
    with ExitStack() as cleanup:
        for core in os.sched_getaffinity(0) if background_load != "nothing" else ():
            process = get_context("spawn").Process(
                target=_generate_load, args=(background_load == "bursty", core, os.getpid()), daemon=True
            )
            process.start()
            cleanup.callback(process.join)
            cleanup.callback(process.terminate)
        yield


def _generate_load(is_bursty: bool, seed: int, parent_pid: int) -> None:
    """Sweep over 16 MB repeatedly.

    Bursts last 0.5 to 3 s, with pauses of 1 to 6 s.
    """
    tie_to_parent(parent_pid)
    rng, memory = Random(seed), np.ones(2**21)
    while True:
        until = process_time() + (rng.uniform(0.5, 3.0) if is_bursty else 60.0)
        while process_time() < until:
            memory *= 1.0
        if is_bursty:
            sleep(rng.uniform(1.0, 6.0))


def read_recorded_blocks(paths: Sequence[Path]) -> dict[tuple[str, str], list[RecordedBlocks]]:
    """Read the recorded process pairs by test and background load; raise InputError."""
    table = parquet_rows.read_rows(paths, RECORD_SCHEMA).to_pylist()
    grouped: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for row in table:
        grouped.setdefault((row["benchmark"], row["background_load"], row["process_pair"]), []).append(row)
    found: dict[tuple[str, str], list[RecordedBlocks]] = {}
    for (gate, condition, _), blocks in grouped.items():
        times = np.array([[row[f"call_{k}"] for k in range(4)] for row in blocks])
        abba = np.array([row["order"] == "ABBA" for row in blocks])[:, None]
        outer, inner = times[:, [0, 3]], times[:, 1:3]
        a, b = np.where(abba, outer, inner), np.where(abba, inner, outer)
        wall = float(np.mean([row["wall_seconds"] for row in blocks]))
        load = float(np.median([row["load_average"] for row in blocks]))
        start = RecordedBlocks(np.log(a.sum(axis=1) / b.sum(axis=1)), a, b, wall, load)
        found.setdefault((gate, condition), []).append(start)
    return found


def replay_tests(
    recorded_blocks: Sequence[RecordedBlocks],
    slowdown: float,
    sequential_test: SequentialTest,
    budget: float,
    num_replays: int,
    seed: int = 0,
) -> ReplayRates:
    """Replay tests with A slowed down by a factor.

    Args:
        recorded_blocks: recorded process pairs.
        slowdown: factor on A's times.
        sequential_test: test to evaluate.
        budget: seconds of a test.
        num_replays: number of replays.
        seed: seed of the random generator.
    Returns: rates of the verdicts.
    """
    rng, verdicts, seconds = np.random.default_rng(seed), list[RegressionVerdict](), list[float]()
    for _ in range(num_replays):
        verdict, spent = _replay_test(rng, recorded_blocks, slowdown, sequential_test, budget)
        if verdict is RegressionVerdict.FAIL:
            confirmation, more = _replay_test(
                rng, recorded_blocks, slowdown, replace(sequential_test, alpha=CONFIRMATION_ALPHA), budget - spent
            )
            is_confirmed = confirmation is RegressionVerdict.FAIL
            verdict = RegressionVerdict.FAIL if is_confirmed else RegressionVerdict.INCONCLUSIVE
            spent += more
        verdicts.append(verdict)
        seconds.append(spent)
    fail_rate, pass_rate, inconclusive_rate = (
        verdicts.count(verdict) / num_replays
        for verdict in (RegressionVerdict.FAIL, RegressionVerdict.PASS, RegressionVerdict.INCONCLUSIVE)
    )
    return ReplayRates(fail_rate, pass_rate, inconclusive_rate, float(np.median(seconds)))


def _replay_test(
    rng: np.random.Generator,
    recorded_blocks: Sequence[RecordedBlocks],
    slowdown: float,
    sequential_test: SequentialTest,
    budget: float,
) -> tuple[RegressionVerdict, float]:
    """Replay one test, and return its verdict and its duration [s].

    It draws another process pair every RESTART_SECONDS.
    """
    drawn, walls, left = list[FloatArray](), list[FloatArray](), budget
    while left > 0.0 or not drawn:
        start = recorded_blocks[int(rng.integers(len(recorded_blocks)))]
        indices = _draw_stretches(
            rng, len(start.log_ratios), max(1, int(min(RESTART_SECONDS, left) / start.wall_seconds))
        )
        drawn.append(start.log_ratios[indices])
        walls.append(np.full(len(indices), start.wall_seconds))
        left -= RESTART_SECONDS
    verdict, used = find_first_verdict(sequential_test, np.log(slowdown) + np.concatenate(drawn))
    return verdict, float(np.concatenate(walls)[:used].sum())


def find_first_verdict(sequential_test: SequentialTest, log_ratios: FloatArray) -> tuple[RegressionVerdict, int]:
    """Find the first decision of a test that is evaluated after every block.

    It equals `decide_verdict` block by block, but takes one pass.

    Args:
        sequential_test: the test.
        log_ratios: log ratios of the blocks (n,).
    Returns: the decision and its number of blocks, n if there is no decision.
    """
    limit, n = np.log(sequential_test.max_ratio), len(log_ratios)
    needed = _tabulate_critical_counts(1 << n.bit_length(), sequential_test.alpha)[
        :n
    ]  # powers of two, so that few tables are computed
    above, below = (np.cumsum(side) >= needed for side in (log_ratios > limit, log_ratios < limit))
    decided = np.flatnonzero(above | below)
    if not len(decided):
        return RegressionVerdict.INCONCLUSIVE, n
    first = int(decided[0])
    return (RegressionVerdict.FAIL if above[first] else RegressionVerdict.PASS), first + 1


@lru_cache(maxsize=64)
def _tabulate_critical_counts(n: int, alpha: float) -> NDArray[np.int64]:
    return np.array([compute_critical_count(num_blocks, alpha) for num_blocks in range(1, n + 1)], np.int64)


def _draw_stretches(rng: np.random.Generator, length: int, num_blocks: int) -> NDArray[np.int64]:
    """Draw indices of stretches of successive blocks, num_blocks in total; a record is periodic."""
    begins = rng.integers(length, size=max(1, -(-num_blocks // REPLAY_STRETCH)))
    return ((begins[:, None] + np.arange(REPLAY_STRETCH)) % length).ravel()[:num_blocks]


def _is_slower_by_asv(new: FloatArray, old: FloatArray) -> bool:
    """Apply the rule of asv continuous with a factor of 1.05.

    The medians differ by that factor, and the Mann-Whitney test gives p < .002.
    """
    from scipy.stats import mannwhitneyu  # the import takes a second, which other commands do not need

    return float(np.median(new)) > 1.05 * float(np.median(old)) and float(mannwhitneyu(new, old).pvalue) < 0.002


OTHER_COMPARISONS: dict[str, Callable[[FloatArray, FloatArray], bool]] = {
    "pytest-benchmark min:5%": lambda new, old: float(new.min()) > 1.05 * float(old.min()),
    "pytest-benchmark mean:5%": lambda new, old: float(new.mean()) > 1.05 * float(old.mean()),
    "asv continuous 1.05": _is_slower_by_asv,
}
"""Comparisons of two sessions that ran one after the other: whether the new one is classified as slower."""


def replay_comparison(
    is_slower: Callable[[FloatArray, FloatArray], bool],
    recorded_blocks: Sequence[RecordedBlocks],
    slowdown: float,
    duration: float,
    num_replays: int,
) -> float:
    """Compute the fraction of comparisons that classify A as slower.

    Each comparison has two sessions of equal duration, A's and then B's.

    Args:
        is_slower: rule of the comparison, for the times of A and of B.
        recorded_blocks: recorded process pairs.
        slowdown: factor on A's times.
        duration: seconds of one session.
        num_replays: number of comparisons.
    """
    rng, num_slower = np.random.default_rng(0), 0
    for _ in range(num_replays):
        start = recorded_blocks[int(rng.integers(len(recorded_blocks)))]
        num_blocks = max(1, min(int(duration / start.wall_seconds), len(start.a) // 2))
        begin = int(rng.integers(len(start.a)))
        first, second = ((begin + k * num_blocks + np.arange(num_blocks)) % len(start.a) for k in range(2))
        num_slower += is_slower(slowdown * start.a[first].ravel(), start.b[second].ravel())
    return num_slower / num_replays

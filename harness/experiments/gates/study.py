"""Error rates of the performance tests, by replay of recorded blocks.

A record has the four times of each block of two processes of the same code, for several process pairs. A replay draws
stretches of successive blocks, so that bursts of load are preserved, and concatenates them up to the budget. It
multiplies the candidate's times by the slowdown and evaluates the test after every block. Every PAIR it
continues with the blocks of another process pair. It confirms failures with further blocks, as the test itself does.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from random import Random
from time import perf_counter, process_time, sleep
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.stats import mannwhitneyu

from harness.base import columns, rows
from harness.base.errors import InputError
from harness.base.worker import tie
from harness.experiments.gates.abba import CONFIRMS, PAIR, Renewing, orders
from harness.experiments.gates.against import Options, Request, started
from harness.experiments.gates.pair import Side
from harness.experiments.gates.sequential import Rule, Verdict

COLUMNS = (
    columns.Column("gate", pa.string(), "", "what takes turns"),
    columns.Column("condition", pa.string(), "", "what was run beside it: nothing, busy or bursty"),
    columns.Column("start", pa.int64(), "", "which pair of processes, from 0"),
    columns.Column("order", pa.string(), "", "ABBA or BAAB"),
    *(columns.Column(f"call_{k}", pa.float64(), "s", f"time of the turn's call {k}") for k in range(4)),
    columns.Column("wall", pa.float64(), "s", "wall time of the whole turn, and of making the work anew after it"),
    columns.Column("load", pa.float64(), "", "load average over a minute"),
    columns.Column("planted", pa.float64(), "", "extra work of A, as a part of its iterations"),
)
SCHEMA = columns.schema_of(COLUMNS)

CONDITIONS = ("nothing", "busy", "bursty")
STRETCH = 25
"""Number of successive blocks of a stretch: some seconds, the duration of most bursts."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PairTurns:
    """Recorded blocks of one process pair.

    log_ratios: (n,).
    a, b: times of A and of B (n, 2) [s].
    wall: mean wall time of a block [s].
    load: median load average of the machine.
    """

    log_ratios: Array
    a: Array
    b: Array
    wall: float
    load: float


@dataclass(frozen=True, slots=True)
class Found:
    """Rates of the three verdicts of many replays, and the median duration [s]."""

    fails: float
    holds: float
    undecided: float
    seconds: float


def record(
    path: Path,
    checkout: Path,
    requests: Sequence[Request],
    condition: str,
    *,
    seconds: float,
    starts: int,
    planted: float = 0.0,
) -> None:
    """Record blocks of the requests, alternating between them, under a background load.

    The file is written after each process pair. Its earlier rows remain, and the numbering of the pairs continues.

    Args:
        path: Parquet file of the blocks.
        checkout: folder of the checkout, which both programs run.
        requests: work to record.
        condition: "nothing", "busy" or "bursty".
        seconds: total time [s].
        starts: number of starts of both processes.
        planted: extra work of A, as a fraction of its iterations.
    """
    found = rows.read([path], SCHEMA).to_pylist() if path.exists() else []
    first = max((row["start"] for row in found), default=-1) + 1
    sides = Side("the one", checkout, extra=planted), Side("the other", checkout)
    with competing(condition):
        for start in range(first, first + starts):
            with ExitStack() as alive:
                pairs = [
                    alive.enter_context(started(sides, request, Options(seconds), lambda line: None))
                    for request in requests
                ]
                renewing = [Renewing(racers.renew) for racers in pairs]
                until = perf_counter() + seconds / starts
                for order in orders():
                    for request, racers, renewed in zip(requests, pairs, renewing, strict=True):
                        at = perf_counter()
                        calls = [{"A": racers.a, "B": racers.b}[who]() for who in order]
                        renewed.after(perf_counter() - at)
                        row = {"gate": request.title, "condition": condition, "start": start, "order": order}
                        row |= {f"call_{k}": call for k, call in enumerate(calls)}
                        took = perf_counter() - at
                        found.append(row | {"wall": took, "load": os.getloadavg()[0], "planted": planted})
                    if perf_counter() > until:
                        break
            rows.write(path, found, SCHEMA)


@contextmanager
def competing(condition: str) -> Generator[None]:
    """Run a background load on each core inside the block.

    It is constant (busy), intermittent (bursty) or absent (nothing).
    """
    if condition not in CONDITIONS:
        raise InputError(f"--condition: came {condition}; wanted one of {', '.join(CONDITIONS)}")
    with ExitStack() as cleanup:
        for core in os.sched_getaffinity(0) if condition != "nothing" else ():
            process = get_context("spawn").Process(
                target=_compete, args=(condition == "bursty", core, os.getpid()), daemon=True
            )
            process.start()
            cleanup.callback(process.join)
            cleanup.callback(process.terminate)
        yield


def _compete(bursts: bool, seed: int, parent: int) -> None:
    """Sweep over 16 MB repeatedly.

    Bursts last 0.5 to 3 s, with pauses of 1 to 6 s.
    """
    tie(parent)
    rng, memory = Random(seed), np.ones(2**21)
    while True:
        until = process_time() + (rng.uniform(0.5, 3.0) if bursts else 60.0)
        while process_time() < until:
            memory *= 1.0
        if bursts:
            sleep(rng.uniform(1.0, 6.0))


def read(paths: Sequence[Path]) -> dict[tuple[str, str], list[PairTurns]]:
    """Read the recorded process pairs by test and background load; raise InputError."""
    table = rows.read(paths, SCHEMA).to_pylist()
    by: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for row in table:
        by.setdefault((row["gate"], row["condition"], row["start"]), []).append(row)
    found: dict[tuple[str, str], list[PairTurns]] = {}
    for (gate, condition, _), turns in by.items():
        times = np.array([[row[f"call_{k}"] for k in range(4)] for row in turns])
        abba = np.array([row["order"] == "ABBA" for row in turns])[:, None]
        outer, inner = times[:, [0, 3]], times[:, 1:3]
        a, b = np.where(abba, outer, inner), np.where(abba, inner, outer)
        wall = float(np.mean([row["wall"] for row in turns]))
        load = float(np.median([row["load"] for row in turns]))
        start = PairTurns(np.log(a.sum(axis=1) / b.sum(axis=1)), a, b, wall, load)
        found.setdefault((gate, condition), []).append(start)
    return found


def replay(starts: Sequence[PairTurns], slower: float, rule: Rule, budget: float, replays: int, seed: int = 0) -> Found:
    """Replay tests with A slowed down by a factor.

    Args:
        starts: recorded process pairs.
        slower: factor on A's times.
        rule: test to evaluate.
        budget: seconds of a test.
        replays: number of replays.
        seed: seed of the random generator.
    Returns: rates of the verdicts.
    """
    rng, answers, seconds = np.random.default_rng(seed), list[Verdict](), list[float]()
    for _ in range(replays):
        answer, spent = _race(rng, starts, slower, rule, budget)
        if answer is Verdict.FAILS:  # which is believed when it comes twice
            again, more = _race(rng, starts, slower, replace(rule, alpha=CONFIRMS), budget - spent)
            answer, spent = (Verdict.FAILS if again is Verdict.FAILS else Verdict.UNDECIDED), spent + more
        answers.append(answer)
        seconds.append(spent)
    fails, holds, undecided = (answers.count(a) / replays for a in (Verdict.FAILS, Verdict.HOLDS, Verdict.UNDECIDED))
    return Found(fails, holds, undecided, float(np.median(seconds)))


def _race(
    rng: np.random.Generator, starts: Sequence[PairTurns], slower: float, rule: Rule, budget: float
) -> tuple[Verdict, float]:
    """Replay one test, and return its verdict and its duration [s].

    It draws another process pair every PAIR.
    """
    drawn, walls, left = list[Array](), list[Array](), budget
    while left > 0.0 or not drawn:
        start = starts[int(rng.integers(len(starts)))]
        turns = _stretches(rng, len(start.log_ratios), max(1, int(min(PAIR, left) / start.wall)))
        drawn.append(start.log_ratios[turns])
        walls.append(np.full(len(turns), start.wall))
        left -= PAIR
    answer, used = rule.first(np.log(slower) + np.concatenate(drawn))
    return answer, float(np.concatenate(walls)[:used].sum())


def _stretches(rng: np.random.Generator, length: int, turns: int) -> NDArray[np.int64]:
    """Draw indices of stretches of successive blocks, turns in total; a record is periodic."""
    begins = rng.integers(length, size=max(1, -(-turns // STRETCH)))
    return ((begins[:, None] + np.arange(STRETCH)) % length).ravel()[:turns]


def _asv(new: Array, old: Array) -> bool:
    """Apply the rule of asv continuous with a factor of 1.05.

    The medians differ by that factor, and the Mann-Whitney test gives p < .002.
    """
    return float(np.median(new)) > 1.05 * float(np.median(old)) and float(mannwhitneyu(new, old).pvalue) < 0.002


OTHERS: dict[str, Callable[[Array, Array], bool]] = {
    "pytest-benchmark min:5%": lambda new, old: float(new.min()) > 1.05 * float(old.min()),
    "pytest-benchmark mean:5%": lambda new, old: float(new.mean()) > 1.05 * float(old.mean()),
    "asv continuous 1.05": _asv,
}
"""Comparisons of two sessions that ran one after the other: whether the new one is classified as slower."""


def replay_other(
    slower_than: Callable[[Array, Array], bool],
    starts: Sequence[PairTurns],
    slower: float,
    seconds: float,
    replays: int,
) -> float:
    """Compute the fraction of comparisons that classify A as slower.

    Each comparison has two sessions of equal duration, A's and then B's.

    Args:
        slower_than: rule of the comparison, for the times of A and of B.
        starts: recorded process pairs.
        slower: factor on A's times.
        seconds: seconds of one session.
        replays: number of comparisons.
    """
    rng, said = np.random.default_rng(0), 0
    for _ in range(replays):
        start = starts[int(rng.integers(len(starts)))]
        turns = max(1, min(int(seconds / start.wall), len(start.a) // 2))
        at = int(rng.integers(len(start.a)))
        first, second = ((at + k * turns + np.arange(turns)) % len(start.a) for k in range(2))
        said += slower_than(slower * start.a[first].ravel(), start.b[second].ravel())
    return said / replays

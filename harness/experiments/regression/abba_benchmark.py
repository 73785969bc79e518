"""Interleaved paired benchmark (ABBA) of two programs with a sequential test.

It ends when the test decides, or with the time budget. The order of each block, A B B A or B A A B, is random. A test
detects any difference between two running programs. Two programs of the same code differ slightly by the memory layout
of their data (Mytkowicz et al. 2009). Between blocks the work of both is therefore rebuilt at other addresses, in an
eighth of the time (after Curtsinger and Berger 2013). The effect of the layout becomes noise with many samples.
Properties that a process has all its life, such as the addresses of its compiled code, become noise likewise: both
programs are restarted every RESTART_SECONDS. A slowdown is reported only if a second benchmark, with restarted
programs, confirms it. The first benchmark alone excludes chance, so the second needs fewer blocks. The guarantee of the
test is for the ratio of one pair of processes. For several pairs it is valid only as far as their ratios agree; the
study measures the error rate for these.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import count
from random import Random, SystemRandom
from time import perf_counter
from typing import Literal

from springbench.harness.experiments.regression.confidence_sequence import (
    RatioInterval,
    SequentialTest,
    compute_interval,
    compute_log_ratio,
)
from springbench.harness.results.regression_verdict import RegressionVerdict
from springbench.solvers.platform_calls import read_load_average

BLOCK_ORDERS = ("ABBA", "BAAB")

TIME_BUDGET = 240.0
"""Time budget [s] of a test, after which the result is inconclusive."""

REBUILD_TIME_SHARE = 0.125
"""Fraction of the time for rebuilding the work. The layout changes the times of blocks by 1 to 2 %, and other programs
change them by 3 to 7 %. Some twenty layouts are therefore as good as hundreds; the number of blocks matters more.
"""

RESTART_SECONDS = 30.0
"""Benchmark time [s] after which both programs are restarted. Two processes of the same code can differ by up to 1 %
all their lives, and a restart samples that difference again. Most benchmarks end earlier, and a start takes two or
three seconds.
"""

CONFIRMATION_ALPHA = 0.05
"""Error probability of the benchmark that confirms a first one; a false alarm requires an error of both."""

MIN_CALL_SECONDS = 0.01
"""Minimum work of a call [s], for which the overhead of a clock is negligible. Longer calls have no less variance: with
seven other programs on two cores, blocks of 10 and of 40 ms have the same spread, and five times as many of them fit.
"""

ClockName = Literal["cpu", "wall"]
TimedCall = Callable[[], float]
"""Function that performs some work and returns its time [s] by some clock."""


@dataclass(frozen=True, slots=True)
class ProgramPair:
    """Two programs after warm-up.

    Attributes:
        a, b: perform the work `num_calls` times and return the time [s] of all calls.
        rebuild_work: rebuilds the work of both at other addresses and warms it up; None if that is impossible.
        num_calls: number of times that a call of `a` or `b` performs the work.
    """

    a: TimedCall
    b: TimedCall
    rebuild_work: Callable[[], None] | None = None
    num_calls: int = 1


StartPrograms = Callable[[], AbstractContextManager[ProgramPair]]
"""Context manager that starts both programs and stops them at its end."""


@dataclass(slots=True)
class LayoutRandomiser:
    """Rebuilds the programs' work between blocks, limited to its share of the time."""

    rebuild_work: Callable[[], None] | None
    _earned_seconds: float = 0.0

    def rebuild_after(self, seconds: float) -> None:
        """Rebuild the work after a block, if the share of the time permits.

        Args:
            seconds: duration of the block [s].
        """
        self._earned_seconds += REBUILD_TIME_SHARE / (1.0 - REBUILD_TIME_SHARE) * seconds
        if self.rebuild_work and self._earned_seconds >= 0.0:
            began = perf_counter()
            self.rebuild_work()
            self._earned_seconds -= perf_counter() - began


@dataclass(frozen=True, slots=True)
class TimedBlock:
    """One block: its order, and the times [s] of its four calls in that order."""

    order: str
    seconds: tuple[float, ...]

    def program_seconds(self, program: str) -> list[float]:
        """Return the two times [s] of program "A" or "B"."""
        return [seconds for name, seconds in zip(self.order, self.seconds, strict=True) if name == program]

    @property
    def log_ratio(self) -> float:
        """Log of the ratio of A's time to B's."""
        return compute_log_ratio(self.program_seconds("A"), self.program_seconds("B"))


@dataclass(frozen=True, slots=True)
class BenchmarkResult:
    """Result of a performance test.

    Attributes:
        verdict: decision of the sequential test.
        sequential_test: the test, with its limit and error probability.
        interval: estimated ratio of times, with its confidence interval.
        blocks: all timed blocks.
        elapsed_seconds: duration of the blocks [s].
        load_average: load average of the machine at the end.
        num_process_pairs: number of pairs of started programs, one every RESTART_SECONDS and those of the confirmation.
    """

    verdict: RegressionVerdict
    sequential_test: SequentialTest
    interval: RatioInterval
    blocks: tuple[TimedBlock, ...]
    elapsed_seconds: float
    load_average: float
    num_process_pairs: int = 1

    def __str__(self) -> str:
        limit, found = self.sequential_test.max_ratio, self.interval
        if self.verdict is RegressionVerdict.INCONCLUSIVE:
            ratios = (
                f"ratio {found.low:.3g} to {found.high:.3g}" if found.low > 0 else f"{len(self.blocks)} blocks only"
            )
            after = f"after {self.elapsed_seconds:.0f} s, load average {self.load_average:.0f}"
            return f"inconclusive: {ratios} (limit {limit:.3g}) {after}"
        if not 0.9 <= limit <= 1.5 or found.ratio >= 2 or found.high < 1:
            return f"{self.verdict}: ratio {found.ratio:.3g} [{found.low:.3g}, {found.high:.3g}] (limit {limit:.3g})"
        low, high, allowed = (_format_percent(ratio) for ratio in (found.low, found.high, limit))
        if self.verdict is RegressionVerdict.PASS:
            return f"pass: at most {high} % slower (limit {allowed} %)"
        return f"fail: slower by {_format_percent(found.ratio)} % [{low}, {high}] (limit {allowed} %)"


def run_paired_benchmark(
    programs: ProgramPair,
    sequential_test: SequentialTest,
    *,
    time_budget: float = TIME_BUDGET,
    rng: Random | None = None,
    earlier_blocks: Sequence[TimedBlock] = (),
) -> BenchmarkResult:
    """Time both programs, after warm-up, until the test decides or the budget ends.

    Args:
        programs: the two programs.
        sequential_test: test on the ratio A / B.
        time_budget: time limit [s].
        rng: chooses the orders; by default the system's random source, which no other program can predict.
        earlier_blocks: blocks of earlier processes of the same programs, which count too.
    """
    blocks = iterate_paired_benchmark(
        programs.b,
        sequential_test,
        time_budget=time_budget,
        rng=rng,
        rebuild_work=programs.rebuild_work,
        earlier_blocks=earlier_blocks,
    )
    next(blocks)
    while True:
        try:
            blocks.send(programs.a())
        except StopIteration as done:
            return done.value


def iterate_paired_benchmark(
    b: TimedCall,
    sequential_test: SequentialTest,
    *,
    time_budget: float = TIME_BUDGET,
    rng: Random | None = None,
    rebuild_work: Callable[[], None] | None = None,
    earlier_blocks: Sequence[TimedBlock] = (),
) -> Generator[None, float, BenchmarkResult]:
    """Run a paired benchmark as a generator, for a caller that times A itself.

    Each `yield` expects the seconds of one call of A; the generator returns the result.

    Args:
        b: times one call of B.
        sequential_test: test on the ratio A / B.
        time_budget: time limit [s].
        rng: chooses the orders.
        rebuild_work: rebuilds the work of both programs.
        earlier_blocks: blocks of earlier processes of the same programs, which count too.
    """
    start, blocks, layout = perf_counter(), list(earlier_blocks), LayoutRandomiser(rebuild_work)
    for order in draw_block_orders(rng):
        block_start, seconds = perf_counter(), list[float]()
        for program in order:
            seconds.append((yield) if program == "A" else b())
        blocks.append(TimedBlock(order, tuple(seconds)))
        verdict, now = sequential_test.decide_verdict([block.log_ratio for block in blocks]), perf_counter()
        if verdict is not RegressionVerdict.INCONCLUSIVE or now - start >= time_budget:
            return build_result(sequential_test, blocks, now - start)
        layout.rebuild_after(now - block_start)
    raise AssertionError("orders do not end")


def draw_block_orders(rng: Random | None = None) -> Iterator[str]:
    """Draw the orders of blocks, without end."""
    rng = rng or SystemRandom()
    while True:
        yield rng.choice(BLOCK_ORDERS)


def build_result(sequential_test: SequentialTest, blocks: list[TimedBlock], elapsed: float) -> BenchmarkResult:
    """Build the result of at least one block.

    Args:
        sequential_test: test on the ratio A / B.
        blocks: all blocks so far.
        elapsed: their duration [s].
    """
    x = [t.log_ratio for t in blocks]
    return BenchmarkResult(
        sequential_test.decide_verdict(x),
        sequential_test,
        compute_interval(x, sequential_test.alpha),
        tuple(blocks),
        elapsed,
        read_load_average(),
    )


def run_confirmed_benchmark(
    start_programs: StartPrograms, sequential_test: SequentialTest, *, time_budget: float = TIME_BUDGET
) -> BenchmarkResult:
    """Benchmark programs that are restarted every RESTART_SECONDS, and confirm a failure with other processes.

    The confirmation has an error probability of its own, CONFIRMATION_ALPHA. If it disagrees, the result is
    inconclusive.

    Args:
        start_programs: starts both programs.
        sequential_test: test on the ratio A / B.
        time_budget: time limit of both benchmarks together, without the starts of programs [s].
    """
    first = _run_restarted_benchmark(start_programs, sequential_test, time_budget)
    if first.verdict is not RegressionVerdict.FAIL:
        return first
    second = _run_restarted_benchmark(
        start_programs,
        replace(sequential_test, alpha=max(sequential_test.alpha, CONFIRMATION_ALPHA)),
        max(time_budget - first.elapsed_seconds, 0.0),
    )
    verdict = RegressionVerdict.FAIL if second.verdict is RegressionVerdict.FAIL else RegressionVerdict.INCONCLUSIVE
    both, elapsed = (*first.blocks, *second.blocks), first.elapsed_seconds + second.elapsed_seconds
    # Each benchmark's interval has its own error; the wider bounds contain both.
    low, high = (f(getattr(r.interval, end) for r in (first, second)) for f, end in ((min, "low"), (max, "high")))
    found = RatioInterval(compute_interval([t.log_ratio for t in both], sequential_test.alpha).ratio, low, high)
    return BenchmarkResult(
        verdict,
        sequential_test,
        found,
        both,
        elapsed,
        second.load_average,
        first.num_process_pairs + second.num_process_pairs,
    )


def _run_restarted_benchmark(
    start_programs: StartPrograms, sequential_test: SequentialTest, budget: float
) -> BenchmarkResult:
    """Run one benchmark over successive pairs of processes, whose blocks are pooled."""
    elapsed, blocks = 0.0, tuple[TimedBlock, ...]()
    for num_process_pairs in count(1):
        with start_programs() as programs:
            found = run_paired_benchmark(
                programs, sequential_test, time_budget=min(RESTART_SECONDS, budget - elapsed), earlier_blocks=blocks
            )
        elapsed, blocks = elapsed + found.elapsed_seconds, found.blocks
        if found.verdict is not RegressionVerdict.INCONCLUSIVE or elapsed >= budget:
            return replace(found, elapsed_seconds=elapsed, num_process_pairs=num_process_pairs)
    raise AssertionError("count does not end")


def _format_percent(ratio: float) -> str:
    return f"{100 * (ratio - 1):.1f}"

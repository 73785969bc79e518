"""Comparison of this checkout with a git revision, the baseline.

`springbench regress --baseline REVISION` runs it, in one run on one machine. Both must give the same answer before
anything is timed. Deterministic counts (iterations, entries, bytes) are compared exactly. Then two processes are
benchmarked by interleaved blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from math import ceil
from pathlib import Path
from random import sample
from time import monotonic
from typing import Any

from springbench.harness.errors import InputError
from springbench.harness.experiments.regression.abba_benchmark import (
    MIN_CALL_SECONDS,
    BenchmarkResult,
    ProgramPair,
    run_confirmed_benchmark,
)
from springbench.harness.experiments.regression.confidence_sequence import DEFAULT_ALPHA, SequentialTest
from springbench.harness.experiments.regression.program_pair import AnswersDiffer, require_agreement
from springbench.harness.experiments.regression.revision_process import (
    GitRevision,
    PreparedWork,
    RevisionProcess,
    WorkSkipped,
    describe_changes,
    start_workers,
)
from springbench.harness.results.regression_verdict import RegressionVerdict

DEFAULT_MAX_RATIO = 1.03
"""Default of the ratio of times from which a program counts as slower."""

FIRST_PASS_SHARE = 1 / 6
"""Fraction of the time budget in the first pass of several tests, in which equal code is usually decided."""


@dataclass(frozen=True, slots=True)
class WorkRequest:
    """Work that both revisions prepare.

    Attributes:
        title: description in messages.
        command: name of a request of `revision_worker.py`.
        arguments: arguments of the request.
        config: file of the run, in each revision's version; None for a gate of the checkout.
    """

    title: str
    command: str
    arguments: dict[str, Any]
    config: Path | None = None


@dataclass(frozen=True, slots=True)
class ComparisonOptions:
    """Options of a comparison.

    Attributes:
        budget: time limit of a test [s].
        max_ratio: ratio of times from which the checkout counts as slower.
        alpha: error probability of all tests of a command together.
        clock: cpu or wall; None selects it by the work.
    """

    budget: float
    max_ratio: float = DEFAULT_MAX_RATIO
    alpha: float = DEFAULT_ALPHA
    clock: str | None = None


def build_config_requests(revisions: Sequence[GitRevision], config: Path, options: dict[str, Any]) -> list[WorkRequest]:
    """Build a request for each run of a scene or sweep.

    Both revisions must list the same runs.

    Args:
        revisions: the two revisions.
        config: file of the scene or sweep.
        options: options of the runs.

    Raises:
        InputError: if a revision fails, or if the lists differ.
    """
    config = config.resolve()
    with start_workers(*revisions) as alive:
        listed = [
            worker.send_request("list_runs", config=str(worker.revision.resolve_file(config)), run_options=options)[
                "runs"
            ]
            for worker in alive
        ]
    if listed[0] != listed[1]:
        raise InputError(
            f"{config}: {revisions[0].name} and {revisions[1].name} read different runs from it: "
            f"{_find_first_difference(listed)}"
        )
    return [
        WorkRequest(title, "prepare_run", {"run_options": options, "index": i}, config)
        for i, title in enumerate(listed[0])
    ]


def build_gate_requests(revisions: Sequence[GitRevision], name: str) -> list[WorkRequest]:
    """Build a request for each gate of the checkout whose name contains `name`.

    Args:
        revisions: the two revisions.
        name: part of the names.

    Raises:
        InputError: if no gate matches, or if one revision lacks it.
    """
    with start_workers(*revisions) as alive:
        listed = [worker.send_request("list_gates")["gates"] for worker in alive]
    found = [[gate for gate in gates if name in gate] for gates in listed]
    if not any(found):
        raise InputError(f"-k {name}: no such gate; expected a part of {', '.join(listed[0])}")
    for one, other, side in ((*found, revisions[1]), (*found[::-1], revisions[0])):
        if missing := sorted(set(one) - set(other)):
            raise InputError(f"-k {name}: {side.name} has no gate {', '.join(missing)}; select others")
    return [WorkRequest(gate, "prepare_gate", {"name": gate}) for gate in found[0]]


def compare_revisions(
    revisions: tuple[GitRevision, GitRevision],
    requests: Sequence[WorkRequest],
    options: ComparisonOptions,
    print_message: Callable[[str], None],
) -> list[tuple[WorkRequest, BenchmarkResult]]:
    """Benchmark this checkout against the revision, and print each result at once.

    Several requests are compared in two passes: the first one decides the clear ones in a part of their time. The error
    probability is divided among all tests of both passes.

    Args:
        revisions: this checkout, then the revision.
        requests: work to compare.
        options: limits of the comparison.
        print_message: receives one line per result, and estimates of the remaining time.

    Returns:
        The requests in their order, with their results, without those that lack an input.

    Raises:
        InputError: if the work fails, if the answers differ, or if no work can be compared.
    """
    budgets = [options.budget] if len(requests) == 1 else [FIRST_PASS_SHARE * options.budget, options.budget]
    rule = SequentialTest(options.max_ratio, options.alpha / (len(requests) * len(budgets)))
    found: dict[int, BenchmarkResult] = {}
    print_once = cache(print_message)  # each start finds the same differences again
    todo = list(range(len(requests)))
    for budget in budgets:
        most = _format_minutes(len(todo) * budget)
        print_message(f"{len(todo)} comparisons, each for at most {budget:g} s: at most {most}, and their starts")
        began = monotonic()
        for done, index in enumerate(todo, start=1):
            request = requests[index]
            try:
                found[index] = result = run_confirmed_benchmark(
                    partial(start_revisions, revisions, request, options, print_once), rule, time_budget=budget
                )
            except WorkSkipped as reason:
                print_message(f"{request.title}: skipped: {reason}")
                continue
            is_final = budget == budgets[-1] or result.verdict is not RegressionVerdict.INCONCLUSIVE
            print_message(f"{request.title}: {result if is_final else 'undecided so far'}")
            if done < len(todo):
                left = _format_minutes((monotonic() - began) / done * (len(todo) - done))
                print_message(f"{done} of {len(todo)}, about {left} left in this pass")
        todo = [k for k in todo if k in found and found[k].verdict is RegressionVerdict.INCONCLUSIVE]
        if not todo:
            break
    if not found:
        raise InputError("no work can be compared: each of the comparisons lacks an input, as their lines say")
    return [(request, found[index]) for index, request in enumerate(requests) if index in found]


def _format_minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"


@contextmanager
def start_revisions(
    revisions: tuple[GitRevision, GitRevision],
    request: WorkRequest,
    options: ComparisonOptions,
    print_message: Callable[[str], None],
) -> Generator[ProgramPair]:
    """Start both revisions, warm them up, and check that their answers agree.

    Each runs in its own process.

    Args:
        revisions: this checkout, then the revision.
        request: work to prepare.
        options: limits of the comparison.
        print_message: receives differences of deterministic counts.

    Yields:
        The two programs.

    Raises:
        InputError: if the work fails, or if the answers differ.
    """
    with start_workers(*revisions) as alive:
        prepared = _prepare_work(alive, request, 1)
        clock = options.clock or prepared[0].clock
        once = min(worker.time_calls(1, clock) for worker in alive)
        if request.config and once < MIN_CALL_SECONDS:
            prepared = _prepare_work(alive, request, ceil(MIN_CALL_SECONDS / max(once, 1e-6)))
            once = min(worker.time_calls(1, clock) for worker in alive)
        try:
            require_agreement(prepared[0].answer, prepared[1].answer)
        except AnswersDiffer as error:
            raise InputError(f"{request.title}: {revisions[0].name} and {revisions[1].name}: {error}") from error
        counts = [work.stats | _count_instructions(worker) for work, worker in zip(prepared, alive, strict=True)]
        for change in describe_changes(*counts):
            print_message(f"{request.title}: {change}")
        calls = max(1, ceil(MIN_CALL_SECONDS / max(once, 1e-6)))
        a, b = (partial(worker.time_calls, calls, clock) for worker in alive)
        yield ProgramPair(a, b, partial(_rebuild_work, alive), calls)


def _prepare_work(processes: Sequence[RevisionProcess], request: WorkRequest, num_frames: int) -> list[PreparedWork]:
    """Prepare the request's work in both processes; for a run it has num_frames steps."""
    prepared: list[PreparedWork] = []
    for worker in processes:
        run_arguments: dict[str, Any] = {}
        if request.config:
            run_arguments = {
                "config": str(worker.revision.resolve_file(request.config)),
                "num_frames": num_frames,
                "injected_slowdown": worker.revision.injected_slowdown,
            }
        prepared.append(worker.prepare_work(request.command, **request.arguments, **run_arguments))
    return prepared


def _rebuild_work(processes: Sequence[RevisionProcess]) -> None:
    """Rebuild the work of both processes and run it once.

    The order is random because the last process to run has the warmest caches.
    """
    shuffled = sample(processes, len(processes))
    for worker in shuffled:
        worker.rebuild_work()
    for worker in shuffled:
        worker.time_calls(1, "cpu")


def _count_instructions(worker: RevisionProcess) -> dict[str, int]:
    counted = worker.count_instructions()
    return {} if counted is None else {"instructions": counted}


def _find_first_difference(run_titles: Sequence[Sequence[str]]) -> str:
    """Find the first run that only one of the revisions lists."""
    pairs = zip(*run_titles, strict=False)
    return next((f"{a} | {b}" for a, b in pairs if a != b), f"{len(run_titles[0])} and {len(run_titles[1])} of them")

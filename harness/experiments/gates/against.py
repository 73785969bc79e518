"""Comparison of this checkout with a git revision.

`springbench gate --against REVISION` runs it, in one run on one machine. Both must give the same answer before anything
is timed. Deterministic counts (iterations, entries, bytes) are compared exactly. Then two processes are benchmarked by
interleaved blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from math import ceil
from pathlib import Path
from random import sample
from typing import Any

from harness.base.errors import InputError
from harness.experiments.gates.abba import CALL, Racers, Result, confirmed
from harness.experiments.gates.agreement import difference
from harness.experiments.gates.pair import HeldWork, RevisionProcess, Side, changes, workers
from harness.experiments.gates.sequential import ALPHA, Rule, Verdict

LIMIT = 1.03
"""Default of the ratio of times from which a program counts as slower."""


@dataclass(frozen=True, slots=True)
class Request:
    """Work that both revisions prepare.

    title: description in messages.
    do: request of `revision_worker.py`, with its arguments.
    config: file of the run, in each revision's version; None for a performance test of the checkout.
    """

    title: str
    do: str
    arguments: dict[str, Any]
    config: Path | None = None


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a comparison.

    budget: seconds per test.
    limit: ratio of times from which the checkout counts as slower.
    alpha: error probability of all tests of a command together.
    clock: cpu or wall; None selects it by the work.
    """

    budget: float
    limit: float = LIMIT
    alpha: float = ALPHA
    clock: str | None = None


def requests_of_config(sides: Sequence[Side], config: Path, asked: dict[str, Any]) -> list[Request]:
    """Build a request for each run of a scene or sweep.

    Both revisions must list the same runs.

    Args:
        sides: the two revisions.
        config: file of the scene or sweep.
        asked: options of the runs.
    Raises:
        InputError: if a revision fails, or if the lists differ.
    """
    config = config.resolve()
    with workers(*sides) as alive:
        listed = [worker.ask("runs", config=str(worker.side.own(config)), asked=asked)["runs"] for worker in alive]
    if listed[0] != listed[1]:
        raise InputError(
            f"{config}: {sides[0].name} and {sides[1].name} read different runs out of it: {_first(listed)}"
        )
    return [Request(title, "run", {"asked": asked, "index": i}, config) for i, title in enumerate(listed[0])]


def requests_of_gates(sides: Sequence[Side], name: str) -> list[Request]:
    """Build a request for each performance test of the checkout whose name contains `name`.

    Args:
        sides: the two revisions.
        name: part of the names.
    Raises:
        InputError: if no test matches, or if one revision lacks it.
    """
    with workers(*sides) as alive:
        listed = [worker.ask("gates")["gates"] for worker in alive]
    found = [[gate for gate in gates if name in gate] for gates in listed]
    if not any(found):
        raise InputError(f"-k {name}: neither has such a gate; they have {', '.join(listed[0])}")
    for one, other, side in ((*found, sides[1]), (*found[::-1], sides[0])):
        if missing := sorted(set(one) - set(other)):
            raise InputError(f"-k {name}: {side.name} has no gate {', '.join(missing)}; name others")
    return [Request(gate, "gate", {"name": gate}) for gate in found[0]]


def run_gates(
    sides: tuple[Side, Side], requests: Sequence[Request], options: Options, say: Callable[[str], None]
) -> list[tuple[Request, Result]]:
    """Benchmark this checkout against the revision, and print each result at once.

    Args:
        sides: this checkout, then the revision.
        requests: work to compare.
        options: limits of the comparison.
        say: receives one line per result.
    Raises:
        InputError: if the work fails, or if the answers differ.
    """
    rule = Rule(options.limit, options.alpha / len(requests))
    found: list[tuple[Request, Result]] = []
    told = cache(say)  # what differs is found at each start, and told once
    for request in requests:
        result = confirmed(partial(started, sides, request, options, told), rule, budget=options.budget)
        say(f"{request.title}: {result}")
        found.append((request, result))
    return found


def exit_code(answers: Sequence[Verdict]) -> int:
    """Return 1 for any failure, else 3 for any inconclusive verdict, else 0."""
    return next((a.value for a in (Verdict.FAILS, Verdict.UNDECIDED) if a in answers), 0)


@contextmanager
def started(
    sides: tuple[Side, Side], request: Request, options: Options, say: Callable[[str], None]
) -> Generator[Racers]:
    """Start both revisions, warm them up, and check that their answers agree.

    Each runs in its own process.

    Args:
        sides: this checkout, then the revision.
        request: work to prepare.
        options: limits of the comparison.
        say: receives differences of deterministic counts.
    Yields: the two programs.
    Raises:
        InputError: if the work fails, or if the answers differ.
    """
    with workers(*sides) as alive:
        held = _held(alive, request, 1)
        clock = options.clock or held[0].clock
        once = min(worker.seconds(1, clock) for worker in alive)
        if request.config and once < CALL:
            held = _held(alive, request, ceil(CALL / max(once, 1e-6)))
            once = min(worker.seconds(1, clock) for worker in alive)
        if said := difference(held[0].answer, held[1].answer):
            named = f"{request.title}: {sides[0].name} and {sides[1].name}"
            raise InputError(f"{named} answer differently: {said}; nothing was timed")
        facts = [one.facts | _instructions(worker) for one, worker in zip(held, alive, strict=True)]
        for change in changes(*facts):
            say(f"{request.title}: {change}")
        calls = max(1, ceil(CALL / max(once, 1e-6)))
        a, b = (partial(worker.seconds, calls, clock) for worker in alive)
        yield Racers(a, b, partial(_renew, alive))


def _held(alive: Sequence[RevisionProcess], request: Request, frames: int) -> list[HeldWork]:
    """Prepare the request's work in both processes; for a run it has frames steps."""
    held: list[HeldWork] = []
    for worker in alive:
        more: dict[str, Any] = {}
        if request.config:
            more = {"config": str(worker.side.own(request.config)), "frames": frames, "extra": worker.side.extra}
        held.append(worker.hold(request.do, **request.arguments, **more))
    return held


def _renew(alive: Sequence[RevisionProcess]) -> None:
    """Rebuild the work of both processes and run it once.

    The order is random because the last process to run has the warmest caches.
    """
    chance = sample(alive, len(alive))
    for worker in chance:
        worker.renew()
    for worker in chance:
        worker.seconds(1, "cpu")


def _instructions(worker: RevisionProcess) -> dict[str, int]:
    counted = worker.instructions()
    return {} if counted is None else {"instructions": counted}


def _first(listed: Sequence[Sequence[str]]) -> str:
    """Find the first run that only one of the revisions lists."""
    pairs = zip(*listed, strict=False)
    return next((f"{a} | {b}" for a, b in pairs if a != b), f"{len(listed[0])} and {len(listed[1])} of them")

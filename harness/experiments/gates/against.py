"""`springbench gate --against REVISION`: is this checkout slower than a revision, in one run on one machine?

Correctness first: both must give the same answer, or nothing is timed. What they count, iterations and entries and
bytes, is compared exactly. Then two processes take turns.
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
"""The ratio of times from which on something counts as slower."""


@dataclass(frozen=True, slots=True)
class Request:
    """What both revisions are asked to hold: `do` and its arguments for `worker.py`; title: in messages; config: the
    file of the run, each revision's own, None for a gate of the tree's."""

    title: str
    do: str
    arguments: dict[str, Any]
    config: Path | None = None


@dataclass(frozen=True, slots=True)
class Options:
    """budget: seconds a gate; limit: ratio of times; alpha: error of all gates of a command together;
    clock: cpu or wall, None for what suits the work."""

    budget: float
    limit: float = LIMIT
    alpha: float = ALPHA
    clock: str | None = None


def requests_of_config(sides: Sequence[Side], config: Path, asked: dict[str, Any]) -> list[Request]:
    """A request for each run of a scene or sweep, which both revisions must read alike. Raises InputError."""
    config = config.resolve()
    with workers(*sides) as alive:
        listed = [worker.ask("runs", config=str(worker.side.own(config)), asked=asked)["runs"] for worker in alive]
    if listed[0] != listed[1]:
        raise InputError(
            f"{config}: {sides[0].name} and {sides[1].name} read different runs out of it: {_first(listed)}"
        )
    return [Request(title, "run", {"asked": asked, "index": i}, config) for i, title in enumerate(listed[0])]


def requests_of_gates(sides: Sequence[Side], name: str) -> list[Request]:
    """A request for each of the checkout's own gates whose name holds `name`. Raises InputError."""
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
    """Race this checkout, the first side, against the revision; each result is told as it comes. Raises InputError."""
    rule = Rule(options.limit, options.alpha / len(requests))
    found: list[tuple[Request, Result]] = []
    told = cache(say)  # what differs is found at each start, and told once
    for request in requests:
        result = confirmed(partial(started, sides, request, options, told), rule, budget=options.budget)
        say(f"{request.title}: {result}")
        found.append((request, result))
    return found


def exit_code(answers: Sequence[Verdict]) -> int:
    """1 where one fails, else 3 where one is undecided, else 0."""
    return next((a.value for a in (Verdict.FAILS, Verdict.UNDECIDED) if a in answers), 0)


@contextmanager
def started(
    sides: tuple[Side, Side], request: Request, options: Options, say: Callable[[str], None]
) -> Generator[Racers]:
    """Both revisions in processes of their own, warm, with the same answer."""
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
    """The request's work in both, of so many steps where it is a run's."""
    held: list[HeldWork] = []
    for worker in alive:
        more: dict[str, Any] = {}
        if request.config:
            more = {"config": str(worker.side.own(request.config)), "frames": frames, "extra": worker.side.extra}
        held.append(worker.hold(request.do, **request.arguments, **more))
    return held


def _renew(alive: Sequence[RevisionProcess]) -> None:
    """Both make their work anew and do it once, in an order that a coin decides: the last to work is the warmest."""
    chance = sample(alive, len(alive))
    for worker in chance:
        worker.renew()
    for worker in chance:
        worker.seconds(1, "cpu")


def _instructions(worker: RevisionProcess) -> dict[str, int]:
    counted = worker.instructions()
    return {} if counted is None else {"instructions": counted}


def _first(listed: Sequence[Sequence[str]]) -> str:
    """The first run that one has and the other has not."""
    pairs = zip(*listed, strict=False)
    return next((f"{a} | {b}" for a, b in pairs if a != b), f"{len(listed[0])} and {len(listed[1])} of them")

"""How far a sweep is: bars with the time left on a terminal, plain lines elsewhere.

Nothing here runs beside the measurements: bars are redrawn between steps, while the clock stands still.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import median
from time import monotonic
from typing import NamedTuple, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from harness.base.asides import begun, ended, is_step

_REDRAW = 0.2
"""Seconds between two redraws."""

_SILENT = 10.0
"""Seconds after which a line is printed, though nothing has ended."""

_KNOWN = 0.2
"""The share of runs or of their work from which on the time left is stated; half where no run of a kind has ended."""

_OWN_PACE = 0.05
"""The share of a run from which on its own pace tells when it ends."""


class Effort(NamedTuple):
    """What a run takes, before it is known in seconds.

    kind: runs of one kind, such as those by one solver, take time in proportion to their amount, in any measure.
    """

    kind: str = ""
    amount: float = 1.0


ANY_EFFORT = Effort()
"""Of runs of which nothing is known."""


class Remarks:
    """Says how far something is that is no run, as often as lines come while no run ends."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._said = say, monotonic()

    def __call__(self, words: str) -> None:
        """How far it is, in words."""
        if monotonic() - self._said > _SILENT:
            self._say(words)
            self._said = monotonic()


class Run(Protocol):
    """Is told what happens in a run."""

    def tick(self, phase: str) -> None:
        """A step of a phase is done, or what `harness.base.asides` says."""
        ...

    def finished(self, outcome: str) -> None:
        """The run has ended, with an outcome in words."""
        ...


class Display(Protocol):
    """Is told what happens in a sweep."""

    def begin(self, efforts: Sequence[Effort], at_once: int = 1) -> None:
        """The sweep begins: these runs are to be done, so many of them at once."""
        ...

    def run(self, title: str, ticks: int, effort: Effort) -> Run:
        """A run begins: it will take so many ticks."""
        ...

    def elsewhere(self, title: str, effort: Effort, outcome: str) -> None:
        """A run that is none of this command's any more, and why in words."""
        ...

    def end(self) -> None:
        """The sweep has ended, or was stopped."""
        ...


def display(console: Console) -> Display:
    """Bars on a terminal, lines elsewhere."""
    return Bars(console) if console.is_terminal else Lines(console)


class Pace:
    """How long the runs take that have not ended, by those that have.

    seconds = a + b amount,   a = least seconds of a run,   b = (seconds - a) / amount of the kind's latest run,

    where a is what comes with any run. A kind of which no run has ended has the median b of the others. Compiling and
    waiting are left out of the seconds. Where several runs go on at once, the sum is divided by how many did so far.
    """

    def __init__(self, efforts: Sequence[Effort] = (), at_once: int = 1) -> None:
        self._left: dict[str, list[float]] = {}
        for effort in efforts:
            self._left.setdefault(effort.kind, []).append(effort.amount)
        self._runs, self.amount, self._at_once = len(efforts), sum(effort.amount for effort in efforts), at_once
        self._ended = 0
        self.done = 0.0
        self._began, self._seconds, self._least = monotonic(), 0.0, math.inf
        self._latest: dict[str, tuple[float, float]] = {}

    def leave_out(self, effort: Effort) -> None:
        """Leave out a run that is done elsewhere."""
        self._left[effort.kind].remove(effort.amount)
        self._runs, self.amount = self._runs - 1, self.amount - effort.amount

    def add_ended(self, effort: Effort, seconds: float) -> None:
        """Take note of a run that has ended, and of the seconds that it took itself."""
        if effort.amount in self._left.get(effort.kind, ()):
            self._left[effort.kind].remove(effort.amount)
        self._ended, self.done = self._ended + 1, self.done + effort.amount
        self._seconds, self._least = self._seconds + seconds, min(self._least, seconds)
        self._latest[effort.kind] = effort.amount, seconds

    def left(self, going: Sequence[_Running] = ()) -> float | None:
        """Estimate the seconds until all runs have ended.

        Args:
            going: runs that have begun; from a twentieth of its steps on, a run's own pace counts.

        Returns: None while too few runs have ended for an estimate.
        """
        known = max(self._ended / max(1, self._runs), self.done / (self.amount or 1.0))
        kinds = {kind for kind, amounts in self._left.items() if amounts}
        if not self._latest or known < (_KNOWN if kinds <= set(self._latest) else 0.5):
            return None
        rates = {kind: (seconds - self._least) / (amount or 1.0) for kind, (amount, seconds) in self._latest.items()}
        usual = median(rates.values())

        def estimate(effort: Effort) -> float:
            return self._least + effort.amount * rates.get(effort.kind, usual)

        seconds = sum(estimate(Effort(kind, amount)) for kind, amounts in self._left.items() for amount in amounts)
        for run in going:
            whole = estimate(run.effort)
            left = run.seconds * (1.0 - run.done) / run.done if run.done > _OWN_PACE else whole * (1.0 - run.done)
            seconds += left - whole
        at_once = min(self._at_once, max(1.0, self._seconds / max(1e-9, monotonic() - self._began)))
        return max(0.0, seconds) / at_once


@dataclass
class _Running:
    """A run that goes on. changed: called after whatever happens to it."""

    title: str
    ticks: int
    effort: Effort
    pace: Pace
    changed: Callable[[_Running], None]
    ended: Callable[[_Running, str], None]
    phase: str = "prepare"
    steps: int = 0
    began: float = field(default_factory=lambda: monotonic())
    aside: str = ""
    _since: float = 0.0
    _beside: float = 0.0

    @property
    def done(self) -> float:
        """The share of its steps that is done."""
        return min(1.0, self.steps / max(1, self.ticks))

    @property
    def seconds(self) -> float:
        """Seconds since it began, without those that it compiled or waited."""
        aside = monotonic() - self._since if self.aside else 0.0
        return monotonic() - self.began - self._beside - aside

    @property
    def doing(self) -> str:
        """In words."""
        return self.aside or self.phase

    def tick(self, phase: str) -> None:
        """See Run."""
        if is_step(phase):
            self.phase, self.steps = phase, self.steps + 1
        elif what := begun(phase):
            self.aside, self._since = what, monotonic()
        elif ended(phase):
            self.aside, self._beside = "", self._beside + monotonic() - self._since
        self.changed(self)

    def finished(self, outcome: str) -> None:
        """See Run."""
        self.pace.add_ended(self.effort, self.seconds)
        self.ended(self, outcome)


def left_in_words(seconds: float | None) -> str:
    """Empty where it is not known."""
    if seconds is None:
        return ""
    return f"about {seconds:.0f} s left" if seconds < 600 else f"about {seconds / 60:.0f} min left"


def _at_hand(going: Sequence[_Running]) -> str:
    """The first of the runs that go on and do not wait, and how many there are beside it: one short line."""
    run = min(going, key=lambda one: bool(one.aside))
    others = f"; {len(going) - 1} more at hand" if len(going) > 1 else ""
    return f"{run.title}: {run.doing}, {100 * run.done:.0f} %{others}"


class Bars:
    """A bar for the sweep and one for each run that goes on."""

    def __init__(self, console: Console) -> None:
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[phase]}"),
            console=console,
            auto_refresh=False,
        )
        self._drawn, self._pace, self._tasks = 0.0, Pace(), dict[int, TaskID]()
        self._going: list[_Running] = []
        self._sweep = self._bars.add_task("", phase="")

    def begin(self, efforts: Sequence[Effort], at_once: int = 1) -> None:
        """See Display."""
        self._pace = Pace(efforts, at_once)
        self._bars.start()
        self._bars.update(self._sweep, description="sweep", total=self._pace.amount, phase=f"{len(efforts)} runs")

    def run(self, title: str, ticks: int, effort: Effort) -> Run:
        """See Display."""
        running = _Running(title, ticks, effort, self._pace, self._changed, self._ended)
        self._tasks[id(running)] = self._bars.add_task(title, total=ticks, phase="prepare")
        self._going.append(running)
        self._bars.refresh()
        return running

    def _changed(self, run: _Running) -> None:
        if monotonic() - self._drawn > _REDRAW:
            for running in self._going:
                self._bars.update(self._tasks[id(running)], completed=running.steps, phase=running.doing)
            self._show()

    def _show(self) -> None:
        completed = self._pace.done + sum(run.effort.amount * run.done for run in self._going)
        self._bars.update(self._sweep, completed=completed, phase=left_in_words(self._pace.left(self._going)))
        self._bars.refresh()
        self._drawn = monotonic()

    def _ended(self, run: _Running, outcome: str) -> None:
        self._going.remove(run)
        self._bars.remove_task(self._tasks.pop(id(run)))
        self._bars.console.print(f"{run.title}: {outcome}", highlight=False)
        self._show()

    def elsewhere(self, title: str, effort: Effort, outcome: str) -> None:
        """See Display."""
        self._pace.leave_out(effort)
        self._bars.update(self._sweep, total=self._pace.amount)
        self._bars.console.print(f"{title}: {outcome}", highlight=False)
        self._show()

    def end(self) -> None:
        """See Display."""
        self._bars.stop()


class Lines:
    """A line for each run that has ended, with the time left for the sweep, and one of those that go on where there is
    no other for a while."""

    def __init__(self, console: Console) -> None:
        self._console, self._pace, self._printed = console, Pace(), monotonic()
        self._going: list[_Running] = []
        self._runs = self._number = 0

    def begin(self, efforts: Sequence[Effort], at_once: int = 1) -> None:
        """See Display."""
        self._runs, self._number, self._pace, self._printed = len(efforts), 0, Pace(efforts, at_once), monotonic()

    def run(self, title: str, ticks: int, effort: Effort) -> Run:
        """See Display."""
        running = _Running(title, ticks, effort, self._pace, self._changed, self._ended)
        self._going.append(running)
        return running

    def _changed(self, run: _Running) -> None:
        if monotonic() - self._printed > _SILENT:
            self._print(_at_hand(self._going))

    def _ended(self, run: _Running, outcome: str) -> None:
        self._going.remove(run)
        self._number += 1
        self._print(f"{run.title}: {outcome}")

    def elsewhere(self, title: str, effort: Effort, outcome: str) -> None:
        """See Display."""
        self._pace.leave_out(effort)
        self._number += 1
        self._print(f"{title}: {outcome}")

    def _print(self, told: str) -> None:
        left = left_in_words(self._pace.left(self._going))
        rest = f"; {left}" if left and self._number < self._runs else ""
        line = f"[{self._number}/{self._runs}] {told}{rest}"
        self._console.print(line, highlight=False, soft_wrap=True, markup=False)
        self._printed = monotonic()

    def end(self) -> None:
        """See Display."""

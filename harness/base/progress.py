"""Progress of a sweep: bars with the remaining time on a terminal, plain lines elsewhere.

Nothing here runs concurrently with measurements: bars are redrawn between steps, while the clock is stopped.
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
"""Seconds without output after which a line is printed, even if no run has ended."""

_KNOWN = 0.2
"""Fraction of the runs, or of their cost, from which the remaining time is estimated. It is one half while some kind of
run has no finished run.
"""

_OWN_PACE = 0.05
"""Fraction of a run from which its own pace determines its estimate."""


class Effort(NamedTuple):
    """Relative cost of a run, before its seconds are known.

    kind: runs of one kind, such as those of one solver, take time in proportion to their amount.
    amount: cost in any unit.
    """

    kind: str = ""
    amount: float = 1.0


ANY_EFFORT = Effort()
"""Cost of runs without further information."""


class Remarks:
    """Prints progress messages of work that is not a run, at most one per _SILENT."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._said = say, monotonic()

    def __call__(self, words: str) -> None:
        """Print the message if the last one is old enough."""
        if monotonic() - self._said > _SILENT:
            self._say(words)
            self._said = monotonic()


class Run(Protocol):
    """Receiver of the events of one run."""

    def tick(self, phase: str) -> None:
        """Report a finished step by the name of its phase, or an event of `harness.base.asides`."""
        ...

    def finished(self, outcome: str) -> None:
        """Report the end of the run, with a description of its outcome."""
        ...


class Display(Protocol):
    """Receiver of the events of a sweep."""

    def begin(self, efforts: Sequence[Effort], at_once: int = 1) -> None:
        """Start the sweep.

        Args:
            efforts: costs of the pending runs.
            at_once: number of runs that are executed concurrently.
        """
        ...

    def run(self, title: str, ticks: int, effort: Effort) -> Run:
        """Start a run.

        Args:
            title: description of the run.
            ticks: expected number of steps.
            effort: relative cost.
        Returns: receiver of the run's events.
        """
        ...

    def elsewhere(self, title: str, effort: Effort, outcome: str) -> None:
        """Report a run that another command has taken over, and the reason as its outcome."""
        ...

    def end(self) -> None:
        """End the sweep, or its interruption."""
        ...


def display(console: Console) -> Display:
    """Create bars for a terminal, or lines for any other output."""
    return Bars(console) if console.is_terminal else Lines(console)


class Pace:
    """Estimate of the remaining time from the runs that have ended.

        seconds = a + b amount,   a = least seconds of a run,   b = (seconds - a) / amount of the kind's latest run,

    where a is the overhead of any run. A kind without a finished run has the median b of the others. Compilation and
    waiting are excluded from the seconds. For concurrent runs the sum is divided by the concurrency observed so far.
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
        """Remove a run that another command has taken over."""
        self._left[effort.kind].remove(effort.amount)
        self._runs, self.amount = self._runs - 1, self.amount - effort.amount

    def add_ended(self, effort: Effort, seconds: float) -> None:
        """Record a finished run, with the seconds that it took itself."""
        if effort.amount in self._left.get(effort.kind, ()):
            self._left[effort.kind].remove(effort.amount)
        self._ended, self.done = self._ended + 1, self.done + effort.amount
        self._seconds, self._least = self._seconds + seconds, min(self._least, seconds)
        self._latest[effort.kind] = effort.amount, seconds

    def left(self, going: Sequence[_Running] = ()) -> float | None:
        """Estimate the seconds until all runs have ended.

        Args:
            going: started runs; from a twentieth of its steps on, a run's own pace is used.
        Returns: seconds, or None while too few runs have ended for an estimate.
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
    """State of a started run.

    changed: called after each event.
    ended: called with the outcome.
    """

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
        """Fraction of the steps that are finished."""
        return min(1.0, self.steps / max(1, self.ticks))

    @property
    def seconds(self) -> float:
        """Seconds since the start, without compilation and waiting."""
        aside = monotonic() - self._since if self.aside else 0.0
        return monotonic() - self.began - self._beside - aside

    @property
    def doing(self) -> str:
        """Current activity, else current phase."""
        return self.aside or self.phase

    def tick(self, phase: str) -> None:
        """Record an event and report the change."""
        if is_step(phase):
            self.phase, self.steps = phase, self.steps + 1
        elif what := begun(phase):
            self.aside, self._since = what, monotonic()
        elif ended(phase):
            self.aside, self._beside = "", self._beside + monotonic() - self._since
        self.changed(self)

    def finished(self, outcome: str) -> None:
        """Record the end and report the outcome."""
        self.pace.add_ended(self.effort, self.seconds)
        self.ended(self, outcome)


def left_in_words(seconds: float | None) -> str:
    """Format the remaining time; empty if it is unknown."""
    if seconds is None:
        return ""
    return f"about {seconds:.0f} s left" if seconds < 600 else f"about {seconds / 60:.0f} min left"


def _at_hand(going: Sequence[_Running]) -> str:
    """Describe the first active run and the number of others in one line.

    A run that does not wait is preferred.
    """
    run = min(going, key=lambda one: bool(one.aside))
    others = f"; {len(going) - 1} more at hand" if len(going) > 1 else ""
    return f"{run.title}: {run.doing}, {100 * run.done:.0f} %{others}"


class Bars:
    """One progress bar for the sweep and one for each started run."""

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
        """Start the bars."""
        self._pace = Pace(efforts, at_once)
        self._bars.start()
        self._bars.update(self._sweep, description="sweep", total=self._pace.amount, phase=f"{len(efforts)} runs")

    def run(self, title: str, ticks: int, effort: Effort) -> Run:
        """Add a bar for a run."""
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
        """Report a run that another command has taken over."""
        self._pace.leave_out(effort)
        self._bars.update(self._sweep, total=self._pace.amount)
        self._bars.console.print(f"{title}: {outcome}", highlight=False)
        self._show()

    def end(self) -> None:
        """Stop the bars."""
        self._bars.stop()


class Lines:
    """One line for each finished run, with the remaining time.

    After a period without output a status line is printed.
    """

    def __init__(self, console: Console) -> None:
        self._console, self._pace, self._printed = console, Pace(), monotonic()
        self._going: list[_Running] = []
        self._runs = self._number = 0

    def begin(self, efforts: Sequence[Effort], at_once: int = 1) -> None:
        """Start counting the runs."""
        self._runs, self._number, self._pace, self._printed = len(efforts), 0, Pace(efforts, at_once), monotonic()

    def run(self, title: str, ticks: int, effort: Effort) -> Run:
        """Add a run."""
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
        """Print a line for a run that another command has taken over."""
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
        """End the output; lines need no cleanup."""

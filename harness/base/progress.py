"""How far a sweep is: bars with the time left on a terminal, plain lines elsewhere.

Nothing here runs beside the measurements: bars are redrawn between steps, while the clock stands still.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import monotonic
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from harness.base.asides import begun, ended, is_step

_REDRAW = 0.2
"""Seconds between two redraws."""

_SILENT = 10.0
"""Seconds after which a line is printed, though nothing has ended."""

_KNOWN = 0.2
"""The share of the work from which on the time left is told: it is then four times what is known, at most."""


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
    """Is told what happens in a sweep. `work` is any measure of effort, the same for all runs of a sweep."""

    def begin(self, runs: int, work: float, at_once: int = 1) -> None:
        """The sweep begins: so many runs are to be done, so many at once, with so much work in all."""
        ...

    def run(self, title: str, ticks: int, work: float) -> Run:
        """A run begins: it will take so many ticks."""
        ...

    def elsewhere(self, title: str, work: float, outcome: str) -> None:
        """A run that is none of this command's any more, and why in words."""
        ...

    def end(self) -> None:
        """The sweep has ended, or was stopped."""
        ...


def display(console: Console) -> Display:
    """Bars on a terminal, lines elsewhere."""
    return Bars(console) if console.is_terminal else Lines(console)


@dataclass
class Pace:
    """How long work takes, by the runs that have ended.

    seconds = b work,   b = sum of seconds x work / sum of work^2,

    so that the larger runs count, of whose time less goes into what comes with any run. Compiling and waiting are no
    work: their seconds are left out. Runs that go on at once are as many as their seconds are more than those by the
    wall.
    """

    work: float
    at_once: int = 1
    done: float = 0.0
    _began: float = field(default_factory=lambda: monotonic())
    _seconds: float = 0.0
    _products: float = 0.0
    _squares: float = 0.0

    def ended(self, work: float, seconds: float) -> None:
        """A run has ended, after so many seconds of its own."""
        self.done += work
        self._seconds += seconds
        self._products += seconds * work
        self._squares += work**2

    def left(self, going: float = 0.0) -> float | None:
        """Seconds until all is done; None while that is not known. going: work that is done of runs that go on."""
        if not self._squares or self.done < _KNOWN * self.work:
            return None
        at_once = min(self.at_once, max(1.0, self._seconds / max(1e-9, monotonic() - self._began)))
        return max(0.0, self.work - self.done - going) * self._products / self._squares / at_once


@dataclass
class _Running:
    """A run that goes on. changed: called after whatever happens to it."""

    title: str
    ticks: int
    work: float
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
        self.pace.ended(self.work, monotonic() - self.began - self._beside)
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
        self._drawn, self._pace, self._tasks = 0.0, Pace(0.0), dict[int, TaskID]()
        self._going: list[_Running] = []
        self._sweep = self._bars.add_task("", phase="")

    def begin(self, runs: int, work: float, at_once: int = 1) -> None:
        """See Display."""
        self._pace = Pace(work, at_once)
        self._bars.start()
        self._bars.update(self._sweep, description="sweep", total=work, phase=f"{runs} runs")

    def run(self, title: str, ticks: int, work: float) -> Run:
        """See Display."""
        running = _Running(title, ticks, work, self._pace, self._changed, self._ended)
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
        going = sum(run.done * run.work for run in self._going)
        told = left_in_words(self._pace.left(going))
        self._bars.update(self._sweep, completed=self._pace.done + going, phase=told)
        self._bars.refresh()
        self._drawn = monotonic()

    def _ended(self, run: _Running, outcome: str) -> None:
        self._going.remove(run)
        self._bars.remove_task(self._tasks.pop(id(run)))
        self._bars.console.print(f"{run.title}: {outcome}", highlight=False)
        self._show()

    def elsewhere(self, title: str, work: float, outcome: str) -> None:
        """See Display."""
        self._pace.work -= work
        self._bars.update(self._sweep, total=self._pace.work)
        self._bars.console.print(f"{title}: {outcome}", highlight=False)
        self._show()

    def end(self) -> None:
        """See Display."""
        self._bars.stop()


class Lines:
    """A line for each run that has ended, with the time left for the sweep, and one of those that go on where there is
    no other for a while."""

    def __init__(self, console: Console) -> None:
        self._console, self._pace, self._printed = console, Pace(0.0), monotonic()
        self._going: list[_Running] = []
        self._runs = self._number = 0

    def begin(self, runs: int, work: float, at_once: int = 1) -> None:
        """See Display."""
        self._runs, self._number, self._pace, self._printed = runs, 0, Pace(work, at_once), monotonic()

    def run(self, title: str, ticks: int, work: float) -> Run:
        """See Display."""
        running = _Running(title, ticks, work, self._pace, self._changed, self._ended)
        self._going.append(running)
        return running

    def _changed(self, run: _Running) -> None:
        if monotonic() - self._printed > _SILENT:
            self._print(_at_hand(self._going))

    def _ended(self, run: _Running, outcome: str) -> None:
        self._going.remove(run)
        self._number += 1
        self._print(f"{run.title}: {outcome}")

    def elsewhere(self, title: str, work: float, outcome: str) -> None:
        """See Display."""
        self._pace.work -= work
        self._number += 1
        self._print(f"{title}: {outcome}")

    def _print(self, told: str) -> None:
        left = left_in_words(self._pace.left(sum(run.done * run.work for run in self._going)))
        rest = f"; {left}" if left and self._number < self._runs else ""
        line = f"[{self._number}/{self._runs}] {told}{rest}"
        self._console.print(line, highlight=False, soft_wrap=True, markup=False)
        self._printed = monotonic()

    def end(self) -> None:
        """See Display."""

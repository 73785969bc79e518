"""How far a sweep is: two bars with the time left on a terminal, plain lines elsewhere.

Nothing here runs beside the measurements: bars are redrawn between steps, while the clock stands still.
"""

from __future__ import annotations

from time import monotonic
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

_REDRAW = 0.2  # seconds between two redraws


class Display(Protocol):
    """Is told what happens in a sweep. `work` is any measure of effort, the same for all runs of a sweep."""

    def begin(self, runs: int, work: float) -> None:
        """The sweep begins: so many runs are to be done, with so much work in all."""
        ...

    def run(self, title: str, ticks: int, work: float) -> None:
        """A run begins: it will take so many ticks."""
        ...

    def tick(self, phase: str) -> None:
        """A step of a phase is done."""
        ...

    def finished(self, outcome: str) -> None:
        """The run has ended, with an outcome in words."""
        ...

    def end(self) -> None:
        """The sweep has ended, or was stopped."""
        ...


def display(console: Console) -> Display:
    """Bars on a terminal, lines elsewhere."""
    return Bars(console) if console.is_terminal else Lines(console)


class Bars:
    """A bar for the sweep and one for the current run."""

    def __init__(self, console: Console) -> None:
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.fields[phase]}"),
            console=console,
            auto_refresh=False,
        )
        self._share, self._drawn, self._title = 0.0, 0.0, ""
        self._run = self._sweep = self._bars.add_task("", phase="")

    def begin(self, runs: int, work: float) -> None:
        self._bars.start()
        self._bars.update(self._sweep, description="sweep", total=work, phase=f"{runs} runs")
        self._run = self._bars.add_task("", phase="")

    def run(self, title: str, ticks: int, work: float) -> None:
        self._share, self._title = work / ticks, title
        self._bars.reset(self._run, total=ticks, description=title, phase="prepare")
        self._bars.refresh()

    def tick(self, phase: str) -> None:
        self._bars.update(self._run, advance=1, phase=phase)
        self._bars.update(self._sweep, advance=self._share)
        if monotonic() - self._drawn > _REDRAW:
            self._bars.refresh()
            self._drawn = monotonic()

    def finished(self, outcome: str) -> None:
        self._bars.console.print(f"{self._title}: {outcome}", highlight=False)

    def end(self) -> None:
        self._bars.stop()


class Lines:
    """One line for each run that has ended, with the time left for the sweep."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def begin(self, runs: int, work: float) -> None:
        self._runs, self._work, self._began = runs, work, monotonic()
        self._number, self._done = 0, 0.0

    def run(self, title: str, ticks: int, work: float) -> None:
        self._number += 1
        self._title, self._current = title, work

    def tick(self, phase: str) -> None:
        pass

    def finished(self, outcome: str) -> None:
        self._done += self._current
        elapsed = monotonic() - self._began
        left = elapsed * (self._work - self._done) / self._done
        rest = f"; about {left:.0f} s left" if self._number < self._runs else ""
        line = f"[{self._number}/{self._runs}] {self._title}: {outcome}{rest}"
        self._console.print(line, highlight=False, soft_wrap=True)

    def end(self) -> None:
        pass

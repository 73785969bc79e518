"""Progress of a sweep: bars on a terminal and in a notebook, plain lines elsewhere.

Nothing here runs concurrently with measurements: bars are redrawn between steps, while the clock is stopped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from time import monotonic
from typing import Any, NamedTuple, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from springbench.harness.execution.progress_events import is_step_event, parse_activity_end, parse_activity_start

_REDRAW_SECONDS = 0.2
"""Seconds between two redraws."""

_MAX_SILENT_SECONDS = 10.0
"""Seconds without output after which a line is printed, even if no run has ended."""

_MIN_KNOWN_SHARE = 0.2
"""Fraction of the runs, or of their cost, from which the remaining time is estimated.

It is one half while some kind of run has no finished run.
"""

_MIN_PACE_SHARE = 0.05
"""Fraction of a run from which its own pace determines its estimate."""


class RunCost(NamedTuple):
    """Relative cost of a run, before its seconds are known.

    Attributes:
        kind: runs of one kind, such as those of one solver, take time in proportion to their amount.
        amount: cost in any unit.
    """

    kind: str = ""
    amount: float = 1.0


UNIT_COST = RunCost()
"""Cost of runs without further information."""


class ThrottledMessages:
    """Prints progress messages of work that is not a run, at most one per _MAX_SILENT_SECONDS.

    A terminal can show all of them in one place (`springbench.harness.console.show_activity`).
    """

    def __init__(
        self, print_message: Callable[[str], None], show_activity: Callable[[str], None] = lambda words: None
    ) -> None:
        self._print_message, self._show_activity, self._last_print_time = print_message, show_activity, monotonic()

    def __call__(self, words: str) -> None:
        """Show the message, and print it if the last one is old enough."""
        self._show_activity(words)
        if monotonic() - self._last_print_time > _MAX_SILENT_SECONDS:
            self._print_message(words)
            self._last_print_time = monotonic()


class RunProgress(Protocol):
    """Receiver of the events of one run."""

    def report_tick(self, phase: str) -> None:
        """Report a finished step by the name of its phase, or another event.

        The other events are those of `springbench.harness.execution.progress_events`.
        """
        ...

    def finish_run(self, outcome: str) -> None:
        """Report the end of the run, with a description of its outcome."""
        ...


class ProgressDisplay(Protocol):
    """Receiver of the events of a sweep."""

    def start_sweep(self, costs: Sequence[RunCost], num_concurrent: int = 1) -> None:
        """Start the sweep.

        Args:
            costs: costs of the pending runs.
            num_concurrent: number of runs that are executed concurrently.
        """
        ...

    def start_run(self, title: str, ticks: int, cost: RunCost) -> RunProgress:
        """Start a run.

        Args:
            title: description of the run.
            ticks: expected number of steps.
            cost: relative cost.

        Returns:
            Receiver of the run's events.
        """
        ...

    def skip_run(self, title: str, cost: RunCost, outcome: str) -> None:
        """Report a run that another command has taken over.

        Args:
            title: description of the run.
            cost: relative cost, as in the call of `start_sweep`.
            outcome: why the run is not executed here.
        """
        ...

    def finish_sweep(self) -> None:
        """End the sweep, or its interruption."""
        ...


def create_display(console: Console) -> ProgressDisplay:
    """Create bars for a terminal or a notebook, or lines for any other output."""
    return ProgressBars(console) if console.is_terminal or console.is_jupyter else ProgressLines(console)


class RemainingTime:
    """Estimate of the remaining time from the runs that have ended.

        seconds = a + b amount,   a = least seconds of a run,   b = sum(seconds - a) / sum(amount) of finished runs,

    where a is the overhead of any run. The finished runs are those of the same kind and amount; without any, of the
    same kind, whose largest ones weigh most; else all. Compilation and waiting are excluded from the seconds. For
    concurrent runs the sum is divided by the concurrency observed so far.
    """

    def __init__(self, efforts: Sequence[RunCost] = (), at_once: int = 1) -> None:
        self._left: dict[str, list[float]] = {}
        for effort in efforts:
            self._left.setdefault(effort.kind, []).append(effort.amount)
        self._runs, self.total_amount, self._at_once = len(efforts), sum(effort.amount for effort in efforts), at_once
        self._ended = 0
        self.finished_amount = 0.0
        self._began, self._seconds, self._least = monotonic(), 0.0, math.inf
        self._finished: dict[str, list[tuple[float, float]]] = {}

    def remove_run(self, cost: RunCost) -> None:
        """Remove a run that another command has taken over."""
        self._left[cost.kind].remove(cost.amount)
        self._runs, self.total_amount = self._runs - 1, self.total_amount - cost.amount

    def record_run(self, cost: RunCost, seconds: float) -> None:
        """Record a finished run.

        Args:
            cost: relative cost of the run.
            seconds: time of the run itself [s], without compilation and waiting.
        """
        if cost.amount in self._left.get(cost.kind, ()):
            self._left[cost.kind].remove(cost.amount)
        self._ended, self.finished_amount = self._ended + 1, self.finished_amount + cost.amount
        self._seconds, self._least = self._seconds + seconds, min(self._least, seconds)
        self._finished.setdefault(cost.kind, []).append((cost.amount, seconds))

    def estimate_seconds(self, running: Sequence[_RunState] = ()) -> float | None:
        """Estimate the seconds until all runs have ended.

        Args:
            running: started runs; from a twentieth of its steps on, a run's own pace is used.

        Returns:
            Seconds, or None while too few runs have ended for an estimate.
        """
        known = max(self._ended / max(1, self._runs), self.finished_amount / (self.total_amount or 1.0))
        kinds = {kind for kind, amounts in self._left.items() if amounts}
        if not self._finished or known < (_MIN_KNOWN_SHARE if kinds <= set(self._finished) else 0.5):
            return None
        everything = [run for runs in self._finished.values() for run in runs]

        @cache
        def estimate(effort: RunCost) -> float:
            runs = self._finished.get(effort.kind, everything)
            same = [run for run in runs if run[0] == effort.amount]
            return self._least + effort.amount * self._compute_rate(same or runs)

        seconds = sum(estimate(RunCost(kind, amount)) for kind, amounts in self._left.items() for amount in amounts)
        for run in running:
            whole = estimate(run.cost)
            left = (
                run.elapsed_seconds * (1.0 - run.fraction_done) / run.fraction_done
                if run.fraction_done > _MIN_PACE_SHARE
                else whole * (1.0 - run.fraction_done)
            )
            seconds += left - whole
        at_once = min(self._at_once, max(1.0, self._seconds / max(1e-9, monotonic() - self._began)))
        return max(0.0, seconds) / at_once

    def _compute_rate(self, runs: Sequence[tuple[float, float]]) -> float:
        """Compute the seconds of an amount of 1, from the amounts and seconds of runs."""
        return sum(seconds - self._least for _, seconds in runs) / (sum(amount for amount, _ in runs) or 1.0)


@dataclass
class _RunState:
    """State of a started run.

    on_change: called after each event.
    on_end: called with the outcome.
    """

    title: str
    ticks: int
    cost: RunCost
    pace: RemainingTime
    on_change: Callable[[_RunState], None]
    on_end: Callable[[_RunState, str], None]
    phase: str = "prepare"
    steps: int = 0
    started_at: float = field(default_factory=lambda: monotonic())
    activity: str = ""
    _activity_start: float = 0.0
    _excluded_seconds: float = 0.0

    @property
    def fraction_done(self) -> float:
        """Fraction of the steps that are finished."""
        return min(1.0, self.steps / max(1, self.ticks))

    @property
    def elapsed_seconds(self) -> float:
        """Seconds since the start, without compilation and waiting."""
        aside = monotonic() - self._activity_start if self.activity else 0.0
        return monotonic() - self.started_at - self._excluded_seconds - aside

    @property
    def status_text(self) -> str:
        """Current activity, else current phase."""
        return self.activity or self.phase

    def report_tick(self, phase: str) -> None:
        """Record an event and report the change."""
        if is_step_event(phase):
            self.phase, self.steps = phase, self.steps + 1
        elif what := parse_activity_start(phase):
            self.activity, self._activity_start = what, monotonic()
        elif parse_activity_end(phase):
            self.activity, self._excluded_seconds = "", self._excluded_seconds + monotonic() - self._activity_start
        self.on_change(self)

    def finish_run(self, outcome: str) -> None:
        """Record the end and report the outcome."""
        self.pace.record_run(self.cost, self.elapsed_seconds)
        self.on_end(self, outcome)


def format_remaining(seconds: float | None) -> str:
    """Format the remaining time; empty if it is unknown."""
    if seconds is None:
        return ""
    return f"about {seconds:.0f} s left" if seconds < 600 else f"about {seconds / 60:.0f} min left"


def append_remaining(line: str, seconds: float | None) -> str:
    """Append the remaining time to a line of progress, if it is known.

    Args:
        line: Text without the remaining time.
        seconds: Estimated remaining time in seconds, or None if it is unknown.

    Returns:
        The line, followed by the remaining time if there is one.
    """
    return "; ".join(filter(None, (line, format_remaining(seconds))))


def _format_running(going: Sequence[_RunState]) -> str:
    """Describe the first active run and the number of others in one line.

    A run that does not wait is preferred.
    """
    run = min(going, key=lambda one: bool(one.activity))
    others = f"; {len(going) - 1} more in progress" if len(going) > 1 else ""
    return f"{run.title}: {run.status_text}, {100 * run.fraction_done:.0f} %{others}"


class _NotebookProgress(Progress):
    """Bars that a notebook redraws in place by updating an output, without widgets."""

    _drawn: Any = None

    def start(self) -> None:
        """Display the bars."""
        from IPython.display import display  # pyright: ignore[reportUnknownVariableType]

        self._drawn = display(self, display_id=True)

    def refresh(self) -> None:
        """Redraw the bars."""
        if self._drawn is not None:
            self._drawn.update(self)

    def stop(self) -> None:
        """Redraw the bars for the last time."""
        self.refresh()


class ProgressBars:
    """One progress bar for the sweep and one for each started run."""

    def __init__(self, console: Console) -> None:
        self._bars = (_NotebookProgress if console.is_jupyter else Progress)(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[phase]}"),
            console=console,
            auto_refresh=False,
        )
        self._drawn, self._pace, self._tasks = 0.0, RemainingTime(), dict[int, TaskID]()
        self._going: list[_RunState] = []
        self._sweep = self._bars.add_task("", phase="")

    def start_sweep(self, costs: Sequence[RunCost], num_concurrent: int = 1) -> None:
        """Start the bars.

        Args:
            costs: costs of the pending runs, whose sum is the length of the sweep's bar.
            num_concurrent: number of runs that are executed concurrently.
        """
        self._pace = RemainingTime(costs, num_concurrent)
        self._bars.start()
        self._bars.update(self._sweep, description="sweep", total=self._pace.total_amount, phase=f"{len(costs)} runs")

    def start_run(self, title: str, ticks: int, cost: RunCost) -> RunProgress:
        """Add a bar for a run.

        Args:
            title: description of the run.
            ticks: expected number of steps, the length of the bar.
            cost: relative cost.

        Returns:
            Receiver of the run's events.
        """
        running = _RunState(title, ticks, cost, self._pace, self._on_change, self._on_end)
        self._tasks[id(running)] = self._bars.add_task(title, total=ticks, phase="prepare")
        self._going.append(running)
        self._bars.refresh()
        return running

    def _on_change(self, run: _RunState) -> None:
        if monotonic() - self._drawn > _REDRAW_SECONDS:
            for running in self._going:
                self._bars.update(self._tasks[id(running)], completed=running.steps, phase=running.status_text)
            self._update_total()

    def _update_total(self) -> None:
        completed = self._pace.finished_amount + sum(run.cost.amount * run.fraction_done for run in self._going)
        self._bars.update(
            self._sweep, completed=completed, phase=format_remaining(self._pace.estimate_seconds(self._going))
        )
        self._bars.refresh()
        self._drawn = monotonic()

    def _on_end(self, run: _RunState, outcome: str) -> None:
        self._going.remove(run)
        self._bars.remove_task(self._tasks.pop(id(run)))
        self._bars.console.print(f"{run.title}: {outcome}", highlight=False)
        self._update_total()

    def skip_run(self, title: str, cost: RunCost, outcome: str) -> None:
        """Print a run that another command executes, and shorten the bar of the sweep.

        Args:
            title: description of the run.
            cost: relative cost, as in the call of `start_sweep`.
            outcome: why the run is not executed here.
        """
        self._pace.remove_run(cost)
        self._bars.update(self._sweep, total=self._pace.total_amount)
        self._bars.console.print(f"{title}: {outcome}", highlight=False)
        self._update_total()

    def finish_sweep(self) -> None:
        """Stop the bars."""
        self._bars.update(self._sweep, phase="")
        self._bars.stop()


class ProgressLines:
    """A line at the start, and one for each finished run with the remaining time.

    After a period without output a status line is printed.
    """

    def __init__(self, console: Console) -> None:
        self._console, self._pace, self._printed = console, RemainingTime(), monotonic()
        self._going: list[_RunState] = []
        self._runs = self._number = 0

    def start_sweep(self, costs: Sequence[RunCost], num_concurrent: int = 1) -> None:
        """Start counting the runs.

        Args:
            costs: costs of the pending runs.
            num_concurrent: number of runs that are executed concurrently.
        """
        self._runs, self._number, self._pace, self._printed = (
            len(costs),
            0,
            RemainingTime(costs, num_concurrent),
            monotonic(),
        )
        if costs:
            self._print_line("starting")

    def start_run(self, title: str, ticks: int, cost: RunCost) -> RunProgress:
        """Add a run.

        Args:
            title: description of the run.
            ticks: expected number of steps.
            cost: relative cost.

        Returns:
            Receiver of the run's events.
        """
        running = _RunState(title, ticks, cost, self._pace, self._on_change, self._on_end)
        self._going.append(running)
        return running

    def _on_change(self, run: _RunState) -> None:
        if monotonic() - self._printed > _MAX_SILENT_SECONDS:
            self._print_line(_format_running(self._going))

    def _on_end(self, run: _RunState, outcome: str) -> None:
        self._going.remove(run)
        self._number += 1
        self._print_line(f"{run.title}: {outcome}")

    def skip_run(self, title: str, cost: RunCost, outcome: str) -> None:
        """Print a line for a run that another command has taken over.

        Args:
            title: description of the run.
            cost: relative cost, as in the call of `start_sweep`.
            outcome: why the run is not executed here.
        """
        self._pace.remove_run(cost)
        self._number += 1
        self._print_line(f"{title}: {outcome}")

    def _print_line(self, message: str) -> None:
        left = self._pace.estimate_seconds(self._going) if self._number < self._runs else None
        line = append_remaining(f"[{self._number}/{self._runs}] {message}", left)
        self._console.print(line, highlight=False, soft_wrap=True, markup=False)
        self._printed = monotonic()

    def finish_sweep(self) -> None:
        """End the output; lines need no cleanup."""

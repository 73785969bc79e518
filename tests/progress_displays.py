"""A display that records an experiment's progress, for tests."""

from __future__ import annotations

from collections.abc import Sequence

from springbench.harness.execution.progress_display import RunCost


class SilentDisplay:
    """A display that shows nothing, and is stopped after some units, those that find steps apart."""

    def __init__(self, stop_after: int = 10**9) -> None:
        self.finished_units, self._stop_after, self._counts = 0, stop_after, True
        self.titles: list[str] = []

    def start_sweep(self, costs: Sequence[RunCost], num_concurrent: int = 1) -> None: ...

    def start_run(self, title: str, ticks: int, cost: RunCost) -> SilentDisplay:
        self.titles.append(title)
        self._counts = not title.endswith("step snapshots")
        return self

    def report_tick(self, phase: str) -> None: ...

    def finish_run(self, outcome: str) -> None:
        self.finished_units += self._counts
        if self.finished_units == self._stop_after:
            raise KeyboardInterrupt

    def skip_run(self, title: str, cost: RunCost, outcome: str) -> None:
        self.titles.append(f"{title} {outcome}")

    def finish_sweep(self) -> None: ...

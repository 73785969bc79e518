"""What is told of an experiment's progress, for tests."""

from __future__ import annotations

from collections.abc import Sequence

from harness.base.progress import Effort


class Quiet:
    """A display that shows nothing, and is stopped after some units, those that find steps apart."""

    def __init__(self, stop_after: int = 10**9) -> None:
        self.finished_units, self._stop_after, self._counts = 0, stop_after, True
        self.titles: list[str] = []

    def begin(self, efforts: Sequence[Effort], at_once: int = 1) -> None: ...

    def run(self, title: str, ticks: int, effort: Effort) -> Quiet:
        self.titles.append(title)
        self._counts = not title.endswith("steps to freeze")
        return self

    def tick(self, phase: str) -> None: ...

    def finished(self, outcome: str) -> None:
        self.finished_units += self._counts
        if self.finished_units == self._stop_after:
            raise KeyboardInterrupt

    def elsewhere(self, title: str, effort: Effort, outcome: str) -> None:
        self.titles.append(f"{title} {outcome}")

    def end(self) -> None: ...

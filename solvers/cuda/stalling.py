"""Solves on a device that wait for numbers in each iteration, and may stall: nothing descends any more."""

from __future__ import annotations

from abc import abstractmethod

from solvers.cuda.resident import MinimisingIterating
from solvers.cuda.run import EVERY
from solvers.cuda.steps import Uploaded
from solvers.kernels.loop import EACH, ITERATIONS, LAST, STALLED, Limits, verdict


class StallingIterating(MinimisingIterating):
    """moves: iterations of this solve; stalled: whether the last one moved nothing."""

    def __init__(self, uploaded: Uploaded) -> None:
        super().__init__(uploaded)
        self.stalled, self.moves = False, 0

    @abstractmethod
    def one(self) -> bool:
        """An iteration; False where nothing descends."""

    def sweep(self, count: int) -> None:
        """See DeviceIterating; each iteration waits for the numbers of its trial."""
        for _ in range(count):
            if self.stalled or not self.one():
                self.stalled = True
                return
            self.moves += 1

    def advance(self) -> bool:
        """See Iterating."""
        self.launch(1)
        return not self.stalled

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating; a residual after each EVERY iterations where it may end them."""
        first, found, ended = self.moves, float("nan"), ITERATIONS
        while self.moves - first < limits.iterations and ended == ITERATIONS:
            left = limits.iterations - (self.moves - first)
            self.launch(min(EVERY - self.moves % EVERY, left) if limits.wanted == EACH else left)
            if limits.wanted == EACH:
                found = self.residual()
                ended = verdict(found, limits)
            if ended == ITERATIONS and self.stalled:
                ended = STALLED
        if limits.wanted == LAST or (limits.wanted == EACH and self.moves == first):
            found = self.residual()
        return self.moves - first, found, ended

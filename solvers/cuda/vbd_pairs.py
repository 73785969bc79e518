"""Vertex block descent with contact by pairs on a device: the iterates of `solvers.contact.pairs_vbd`.

Candidates, energies, gradients, models, sweeps and the largest safe step are computed there; the host reads sums, and
decides by them as it does of the processor's. Positions are float64, displacements within a sweep in the method's type.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from solvers.core.descent import HALVINGS
from solvers.core.objective import NEAR, ROUND_OFF
from solvers.cuda import device, objective_kernels, pair_kernels, pairs
from solvers.cuda import vbd_pair_kernels as kernels
from solvers.cuda.pairs import At
from solvers.cuda.pncg import dotted
from solvers.cuda.stalling import StallingIterating
from solvers.cuda.steps import Step
from solvers.cuda.vbd_pair_kernels import Model
from solvers.kernels.half_spaces import HalfSpaces
from solvers.kernels.line_search import DECREASE, falls, flattens


class Guarded(StallingIterating):
    """Rows (N, 3) [m]: p, where it is; older, the iterate before; q, where a way leads; trial; start, of the step;
    pressed: where friction's normal forces are taken; way: from p. at: what pairs do at p, and at a trial."""

    def __init__(self, made: Any, sweeps: Any) -> None:
        super().__init__(made.uploaded)
        self._made, self._sweeps = made, sweeps
        stream, system, free = self.stream, made.system, made.made.free
        n, rows = system.vertices, system.vertices + pairs.obstacles(system)
        self._push = kernels.kernels(made.real).push
        self._p, self._q, self._older, self._trial, self._start, self._pressed, self._way = (
            stream.zeros((rows, 3), np.float64) for _ in range(7)
        )
        known = sum(hasattr(energy, "largest_step") for energy in system.energies)
        self._sums = pairs.Sums(stream, 1 + 3 * known, 4 * max(rows, len(made.uploaded.network.ends)))
        self._pairs = pairs.touching(stream, self._sums, system, made.uploaded.network.order, rows)
        self._gradients = [[stream.zeros((n, 3), np.float64) for _ in self._pairs] for _ in range(2)]
        self._at: list[At] = []
        self._g, self._there = (stream.zeros((max(1, free), 3), np.float64)[:free] for _ in range(2))
        majorant, near = stream.upload(made.made.majorant[:n]), stream.zeros(n, np.bool_)
        self._model = Model(near, stream.zeros((n, 3), np.float64), stream.zeros((n, 6), np.float64), majorant)
        nothing, one = stream.zeros((1, 3), np.float64), stream.zeros(1, np.float64)
        first = stream.zeros(n + 1, np.int64)
        self._none = HalfSpaces(first, near, nothing, nothing, one, one, one, one, both=False)
        self._squared, self._factor, self._chained = made.radius**2, 0.0, False

    @property
    def at_rest(self) -> bool:
        """Whether no obstacle moves."""
        return all(pair.at_rest for pair in self._pairs)

    def take(self, step: Step) -> None:
        """See ResidentIterating. A first guess is taken where the straight way to it is free (`core.clearing`, which
        sees to it where obstacles move)."""
        self.stalled, self.moves, self._factor, self._chained = False, 0, 0.0, False
        begun, over = self._sweeps.loaded, self._sums.over
        begun.take(step, self._p)
        kernels.by_rows[over](self.of.places.vertex, step.positions, self._start)
        pressed = None if step.pressed is None else self._pressed
        if pressed is not None:
            kernels.by_rows[over](self.of.places.vertex, step.pressed, pressed)
        for pair in self._pairs:
            pair.begin(step, self._start, pressed, self._p, self._q, self._older, self._trial)
        if self.at_rest:
            kernels.between[over](self._start, self._p, self._way)
            if self._reach(self._start, self._p) < 1.0:
                begun.take(step._replace(guess=step.positions), self._p)
        self.stream.copy(self._p, self._older)
        self._at = self._look(self._p, 0)

    def settled(self) -> Any:
        """See ResidentIterating."""
        return self._p[: len(self.of.network.order)]

    def residual(self) -> float:
        """See Iterating; on the device, of its gradient."""
        with device.guarded():
            self._gradient(self._p, self._at, self._g)
            return self.of.residuals.of(self._g)

    def one(self) -> bool:
        """See `solvers.contact.pairs_vbd.Guarded.advance`."""
        if not any(at.near for at in self._at):
            self._sweeps.alone(self._p, self._q, fresh=not self._chained)
            self._chained = False
            self._toward()
            if self._reach(self._p, self._q) == 1.0:
                there = self._look(self._q, 1)
                if not any(at.near for at in there):
                    self._older, self._p, self._q = self._p, self._q, self._older
                    self._taken(there)
                    self._factor, self._chained = 0.0, True
                    return True
        self._gradient(self._p, self._at, self._g)
        self._make_model()
        self._sweeps.pushed(self._p, self._q, self._push, self._model, self._none)
        self._toward()
        if not self._search():
            over = self._sums.over
            kernels.each[over](self._model, self._g, self._way)
            kernels.go[over](self._p, 1.0, self._way, self._q)
            if not self._search():
                return False
        self._further()
        return True

    def _toward(self) -> None:
        kernels.between[self._sums.over](self._p, self._q, self._way)

    def _look(self, p: Any, slot: int) -> list[At]:
        """What pairs do at p."""
        return [pair.at(p, out) for pair, out in zip(self._pairs, self._gradients[slot], strict=True)]

    def _taken(self, there: list[At]) -> None:
        """What was looked at in slot 1 is what pairs do at p."""
        self._at = there
        self._gradients.reverse()

    def _reach(self, p: Any, q: Any) -> float:
        """The largest part up to 1 of the way from p to q that is free."""
        return min(pair.reach(p, q, self._way) for pair in self._pairs)

    def _gradient(self, p: Any, at: list[At], out: Any) -> None:
        begun, over = self._sweeps.loaded, self._sums.over
        objective_kernels.gradient[over](begun.edges, begun.given, p, out)
        for one in at:
            kernels.add[over](one.gradient, out)

    def _make_model(self) -> None:
        over, model = self._sums.over, self._model
        kernels.clear[over](model)
        for one, pair in zip(self._at, self._pairs, strict=True):
            kernels.add[over](one.gradient, model.gradient)
            pair.add_model(self._p, model.near, model.block)

    def _dot(self, g: Any) -> float:
        dotted[self._sums.over](self._way, g, 0, self._sums.partials)
        return float(self._sums.read(1)[0])

    def _rise(self, p: Any, q: Any, there: list[At]) -> tuple[float, float]:
        """See `solvers.core.objective.StepObjective.rise`; there: at q."""
        begun, over, partials = self._sweeps.loaded, self._sums.over, self._sums.partials
        objective_kernels.rise[over](begun.edges, begun.given, p, q, 0, partials)
        for k, (before, after) in enumerate(zip(self._at, there, strict=True)):
            pair_kernels.compare[over](before.gradient, after.gradient, p, q, 1 + 3 * k, partials)
        change, *told = self._sums.read(1 + 3 * len(there))
        noise = 0.0
        for k, (before, after) in enumerate(zip(self._at, there, strict=True)):
            size, rising, rose = told[3 * k : 3 * k + 3]
            scale = abs(before.value) + abs(after.value) + size
            if abs(after.value - before.value) <= NEAR * scale < np.inf:
                change += 0.5 * (rising + rose)
            else:
                change += after.value - before.value
                noise += ROUND_OFF * scale
        return float(change), float(noise)

    def _search(self) -> bool:
        """See `solvers.core.descent.search`; what it finds is the trial, and what pairs do there is `at`."""
        slope, over = self._dot(self._g), self._sums.over
        t = self._reach(self._p, self._q)
        for _ in range(HALVINGS if slope < 0.0 < t else 0):
            kernels.go[over](self._p, t, self._way, self._trial)
            there = self._look(self._trial, 1)
            rise, noise = self._rise(self._p, self._trial, there)
            enough = falls(rise, t, slope, 0.0)
            if not enough and rise <= noise and 0.0 < noise < np.inf:
                self._gradient(self._trial, there, self._there)
                enough = flattens(abs(self._dot(self._there)), slope, DECREASE)
            if enough:
                self._taken(there)
                return True
            t *= 0.5
        return False

    def _further(self) -> None:
        """Go to the trial, or to what is extrapolated from there, where that is free and no higher."""
        before, over = self._factor, self._sums.over
        w = 0.0
        if self._squared:
            w = 4.0 / (4.0 - self._squared * before) if before > 1.0 else 2.0 / (2.0 - self._squared) if before else 1.0
            self._factor = w
        further = False
        if w > 1.0:
            kernels.between[over](self._older, self._trial, self._way)
            kernels.go[over](self._older, w, self._way, self._q)
            kernels.between[over](self._trial, self._q, self._way)
            if self._reach(self._trial, self._q) == 1.0:
                there = self._look(self._q, 1)
                further = self._rise(self._trial, self._q, there)[0] <= 0.0
                if further:
                    self._taken(there)
            if not further:
                self._factor = 0.0
        if further:
            self._trial, self._q = self._q, self._trial
        self._older, self._p, self._trial = self._p, self._trial, self._older

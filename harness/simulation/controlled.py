"""Motion that keeps to an error: each step's own estimate of its error decides how long the next one is.

    ratio = error/tolerance,   error = rms over free coordinates of (dp, span dv),   a step is taken where ratio <= 1
    h' = 0.9 h min(ratio^(-1/k), h/h_before (ratio_before/ratio^2)^(1/k)),   k one more than the pair's lower order

by what this step says, and by what it says beside the one before (Gustafsson 1994; Hairer and Wanner, Solving Ordinary
Differential Equations II, section IV.8). An implicit step is a part 2^-level of the horizon, and begins at a multiple
of itself: so few factors are needed, those used last are kept (`FACTORS`), and the horizon is met exactly. It doubles
where h' is twice as long; a control by proportion and integral, as the explicit methods have it, would not get there.
What the solver of a step leaves undone is a part of the tolerance (`ALGEBRAIC`). Positions between steps are those of
Hermite's cubic. Solvers with steps of their own choose them within a frame.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite, log2
from time import perf_counter, thread_time
from typing import ClassVar, Protocol

import numpy as np

from harness.base.errors import RunFailed
from harness.scenes.bind import Scene
from harness.simulation.stages import Done, Stages
from harness.simulation.step import FIRST_GUESSES, prepare, start
from solvers.integrators import Motion, RungeKutta
from solvers.problem import Positions, Prepared, Solution, Solver, StopRule, Unsupported

SAFETY, DECREASE, LEAST = 0.9, 0.1, 1e-10
"""Of the step that the error allows; what a step shrinks by at once, at most; ratios below count as this."""
ALGEBRAIC = 0.1
"""Of the tolerance, what the unknowns' residuals may add to a step's estimate of its error."""
FACTORS = 2**28
"""Bytes of factors that are kept, beside the two used last."""
SHORTEST = 1e-9
"""Steps [s] are not shorter."""
TRIES = 200
"""Iterations of a solve; one that needs more is a step too long."""
_STALLED = 10.0
"""Times the residual asked, what one may have that nothing lowers any more."""
_FINEST = 60
"""Levels: times are whole numbers of 2^-60 of the horizon."""


class TooSlow(Exception):
    """The processor seconds that were allowed are over."""


class Stuck(RunFailed):
    """The error would need steps below the floor."""


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A motion that kept to an error. positions (k + 1, n, 3) [m] at the start and at the end of each of k frames;
    steps accepted and rejected, shortest and longest [s]; factorisations; iterations of the steps' solves; wall
    seconds, those of preparing the first steps apart; frames (k,): of them, in which each frame was reached, those of
    one step in equal parts; processor: seconds of this thread, preparing included."""

    positions: Positions
    accepted: int
    rejected: int
    factorisations: int
    iterations: int
    steps: tuple[float, float]
    seconds: float
    frames: tuple[float, ...]
    processor: float


class Follower(Protocol):
    """A way to follow the motion; order: by which its error falls with the step; even: whether its steps have one
    length. A setting is the error [m] that each step may have, or, of even steps, how many times as many as the longest
    there are."""

    even: ClassVar[bool] = False

    @property
    def order(self) -> int:
        """Of the error."""
        ...

    def first(self, tolerance: float) -> float:
        """The setting to begin with, where steps may err by a tolerance [m]."""
        return 1.0 if self.even else tolerance

    def changed(self, setting: float, ratio: float, order: float | None = None) -> float:
        """The setting at which the error of the end is about so many times as large: that of a step of h is of order
        h^(order + 1); order: as it was measured, its own if left out. There are no longer even steps than the
        longest."""
        order = order or self.order
        if self.even:
            return max(1.0, setting * ratio ** (-1.0 / order))
        return setting * ratio ** ((order + 1.0) / order)

    def follow(self, setting: float, *, limit: float = inf) -> Path:
        """The motion up to the horizon; limit: processor seconds.

        Raises TooSlow, Stuck."""
        ...


class _Ladder:
    """A scene and a prepared solver for each length of steps; factors beyond FACTORS bytes are forgotten."""

    def __init__(self, bound: Callable[[float], Scene], solver: Solver, horizon: float) -> None:
        self._bound, self._solver, self._horizon = bound, solver, horizon
        self._kept = OrderedDict[int, tuple[Scene, Prepared]]()
        self.made = 0

    def length(self, level: int) -> float:
        """Of steps [s]."""
        return self._horizon * 0.5**level

    def at(self, level: int) -> tuple[Scene, Prepared]:
        if level not in self._kept:
            scene = self._bound(self.length(level))
            self._kept[level] = scene, prepare(scene, self._solver)
            self.made += 1
        self._kept.move_to_end(level)
        while len(self._kept) > 2 and sum(_bytes(prepared) for _, prepared in self._kept.values()) > FACTORS:
            self._kept.popitem(last=False)
        return self._kept[level]


def _bytes(prepared: Prepared) -> float:
    """Of a solver's factors: an index and a number an entry."""
    return 12.0 * sum(count for name, count in prepared.facts.items() if name.startswith("nnz") and "factor" in name)


@dataclass(frozen=True, eq=False)
class Implicit(Follower):
    """By an integrator with an embedded error. bound: the scene at a length of steps [s]; frames: within the
    horizon [s]."""

    bound: Callable[[float], Scene]
    solver: Solver
    horizon: float
    frames: int

    @property
    def order(self) -> int:
        """See Follower."""
        return self.bound(self.horizon / self.frames).integrator.order

    def follow(self, setting: float, *, limit: float = inf) -> Path:
        """See Follower. Raises Unsupported for an integrator without an error, and for filters of the velocity."""
        return _Following(self, setting, limit).path()


class _Following:
    """One motion by steps of the ladder."""

    def __init__(self, asked: Implicit, tolerance: float, limit: float) -> None:
        self._asked, self._tolerance, self._limit, self._cpu = asked, tolerance, limit, thread_time()
        self._ladder = _Ladder(asked.bound, asked.solver, asked.horizon)
        self._span = asked.horizon / asked.frames
        self._level = ceil(log2(max(1.0, asked.horizon / self._span)))
        scene, _ = self._ladder.at(self._level)
        method = scene.integrator
        if not isinstance(method, RungeKutta) or not method.embedded:
            raise Unsupported("the integrator tells no error of its steps")
        if scene.filters:
            raise Unsupported("a filter of the velocity acts once a step, and no error tells of it")
        self._method, self._power = method, 1.0 + min(method.order, method.embedded)
        self._now, self._acceleration, self._ticks = start(scene).now, None, 0
        self._free, self._mass = scene.system.free, float(scene.system.mass[scene.system.free].mean())
        self._seen, self._before = [self._now.positions], (1.0, scene.system.time_step)
        self._accepted = self._rejected = self._iterations = 0
        self._lengths = inf, 0.0
        self._began, self._reached = perf_counter(), list[float]()

    def path(self) -> Path:
        """The motion."""
        while self._ticks < 1 << _FINEST:
            self._one()
            if thread_time() - self._cpu > self._limit:
                raise TooSlow
        counts = self._accepted, self._rejected, self._ladder.made, self._iterations
        shared, processor = shares(self._reached), thread_time() - self._cpu
        return Path(np.array(self._seen), *counts, self._lengths, self._reached[-1], shared, processor)

    def _one(self) -> None:
        """Try a step."""
        scene, prepared = self._ladder.at(self._level)
        h, time = scene.system.time_step, self._time(self._ticks)
        done = Stages(scene, self._now, self._acceleration, time).done(prepared, self._stop(h), FIRST_GUESSES["motion"])
        self._iterations += sum(done.counts)
        ratio = self._ratio(done)
        if not ratio <= 1.0:
            self._rejected += 1
            allowed = SAFETY * ratio ** (-1.0 / self._power) if isfinite(ratio) else 0.5
            self._level += ceil(log2(1.0 / min(0.5, max(DECREASE, allowed))))
            if self._ladder.length(self._level) < SHORTEST:
                raise self._stuck(ratio, time)
            return
        self._accepted += 1
        self._lengths = min(self._lengths[0], h), max(self._lengths[1], h)
        self._ticks += 1 << (_FINEST - self._level)
        self._show(done.end.motion, time, h)
        self._now, self._acceleration = done.end.motion, done.end.acceleration
        self._follow(max(ratio, LEAST), h)

    def _follow(self, ratio: float, h: float) -> None:
        """Choose the next step's level after a step of h [s]."""
        (before, other), power = self._before, self._power
        change = SAFETY * min(ratio ** (-1.0 / power), h / other * (before / ratio**2) ** (1.0 / power))
        self._before = ratio, h
        if change < 0.6:
            self._level += 1
        elif change >= 2.0 and self._level and self._ticks % (1 << (_FINEST - self._level + 1)) == 0:
            self._level -= 1

    def _time(self, ticks: int) -> float:
        return self._asked.horizon * (ticks / (1 << _FINEST))

    def _stop(self, h: float) -> StopRule:
        """What residuals, which are at least rate |dp|_M, may add to the estimate: rate h |dp|, and of velocities rate
        times as much, of positions."""
        speed = self._method.speed
        part = ALGEBRAIC * self._tolerance / (speed * (1.0 + speed * self._span / h))
        return StopRule(TRIES, within=part * speed / h * (3.0 * len(self._free) * self._mass) ** 0.5)

    def _ratio(self, done: Done) -> float:
        """The step's error over the tolerance; infinite where a solve did not end."""
        error, within = done.end.error, self._stop(self._ladder.length(self._level)).within
        if error is None or not all(_solved(solution, within) for _, solution in done.stages):
            return inf
        with np.errstate(over="ignore", invalid="ignore"):
            squares = sum(float((part[self._free] ** 2).sum()) for part in (error[0], self._span * error[1]))
        found = (squares / max(1, 3 * len(self._free))) ** 0.5 / self._tolerance
        return found if isfinite(found) else inf

    def _show(self, after: Motion, time: float, h: float) -> None:
        """The frames that end in a step."""
        until, reached = self._time(self._ticks), perf_counter() - self._began
        while len(self._seen) <= self._asked.frames and (len(self._seen) * self._span) <= until * (1.0 + 1e-12):
            part = min(1.0, (len(self._seen) * self._span - time) / h)
            self._seen.append(hermite(self._now, after, h, part))
            self._reached.append(reached)

    def _stuck(self, ratio: float, time: float) -> Stuck:
        cause = "is not solved" if ratio == inf else f"errs by {ratio:.2g} times what it may"
        return Stuck(
            f"frame {len(self._seen)}, after {time:.6g} s: even a step of {SHORTEST:g} s {cause}; up to there "
            f"{self._accepted} steps kept to {self._tolerance:.2g} m: forces are too sudden there, or round-off is "
            "larger; ask for a larger --error or a shorter --horizon"
        )


def _solved(solution: Solution, within: float) -> bool:
    """Whether a solve ended near enough: round-off may keep what nothing lowers any more from the very residual."""
    if solution.stopped == "stalled":
        return solution.residual <= _STALLED * within
    return solution.stopped != "iterations"


def shares(reached: Sequence[float]) -> tuple[float, ...]:
    """The wall seconds of each frame, by those at which it was reached: frames of one step share its own evenly."""
    gone = np.diff(np.array(reached), prepend=0.0)
    steps = np.cumsum(gone > 0.0)
    return tuple(float(gone[steps == step].mean()) for step in steps)


def hermite(before: Motion, after: Motion, h: float, part: float) -> Positions:
    """Positions (n, 3) [m] after a part of a step of h [s]: of order 3, by the motions at both ends."""
    (p, v), (q, w), s = before, after, part
    if s == 1.0:
        return q
    d = q - p
    return p + s * (h * v + s * (3.0 * d - h * (2.0 * v + w) + s * (h * (v + w) - 2.0 * d)))

"""Adaptive time stepping: the error estimate of each step determines the next step size.

    ratio = error/tolerance,   error = rms over free coordinates of (dp, span dv);   a step is accepted where ratio <= 1
    h' = 0.9 h min(ratio^(-1/k), h/h_before (ratio_before/ratio^2)^(1/k)),   k one more than the pair's lower order

The second argument of min is the predictive controller, which also uses the previous step (Gustafsson 1994; Hairer and
Wanner, Solving Ordinary Differential Equations II, section IV.8). The step size of an implicit step is 2^-level of the
end time, and the step starts at a multiple of its size. Few factors are therefore needed, the last ones used are cached
(`FACTORS`), and the end time is met exactly. The step size is doubled where h' is at least twice as large. The
proportional-integral controller of the explicit methods would not reach that threshold.

The algebraic error of a step's solve is limited to a share of the tolerance (`ALGEBRAIC`). Positions
between steps are interpolated by cubic Hermite polynomials. Substepping solvers choose their step sizes within a frame
themselves.
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
"""Safety factor on the step size; smallest factor by which one rejected step shrinks it; lower bound on error
ratios."""
ALGEBRAIC = 0.1
"""Share of the tolerance that the residuals of the stages may add to a step's error estimate."""
FACTORS = 2**28
"""Memory limit [bytes] of cached factors; the two used last are always cached."""
SHORTEST = 1e-9
"""Minimum step size [s]."""
TRIES = 200
"""Maximum number of iterations of a solve; a step that needs more is rejected."""
_STALLED = 10.0
"""Factor on the requested residual up to which a stalled solve is accepted."""
_FINEST = 60
"""Maximum level: times are multiples of 2^-60 of the end time."""


class TooSlow(Exception):
    """The limit on processor time is exceeded."""


class Stuck(RunFailed):
    """The error tolerance would need steps below the minimum step size."""


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A motion within an error tolerance.

    Attributes:
      positions: positions (k + 1, n, 3) [m] at the start and at the end of each of k frames.
      accepted: number of accepted steps.
      rejected: number of rejected steps.
      factorisations: number of factorisations.
      iterations: number of iterations of the steps' solves.
      steps: smallest and largest step size [s].
      seconds: wall time [s], without the preparation of the first steps.
      frames: wall time (k,) [s] in which each frame was computed; frames of one step share its time equally.
      processor: processor time [s] of this thread, including preparation.
    """

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
    """Integrator of a motion to an error tolerance, or with a fixed step size.

    `order` is the order of convergence of the error, `even` states whether the step size is fixed. A setting
    is the error tolerance [m] of each step or, with a fixed step size, the number of steps relative to that with the
    largest step size.
    """

    even: ClassVar[bool] = False

    @property
    def order(self) -> int:
        """The order of convergence of the error."""
        ...

    def first(self, tolerance: float) -> float:
        """Return the initial setting for an error tolerance [m] of the steps."""
        return 1.0 if self.even else tolerance

    def changed(self, setting: float, ratio: float, order: float | None = None) -> float:
        """Return the setting at which the final error is scaled by about a given ratio.

        The error of a step of size h is of order h^(order + 1). Fixed step sizes are not increased beyond the largest.

        Args:
          setting: present setting.
          ratio: new error over present error.
          order: measured order of convergence; the theoretical one if omitted.
        """
        order = order or self.order
        if self.even:
            return max(1.0, setting * ratio ** (-1.0 / order))
        return setting * ratio ** ((order + 1.0) / order)

    def follow(self, setting: float, *, limit: float = inf) -> Path:
        """Integrate the motion up to the end time.

        Args:
          setting: error tolerance [m] or number of steps relative to the smallest number.
          limit: limit on the processor time [s].

        Raises:
          TooSlow: the limit is exceeded.
          Stuck: the tolerance would need steps below the minimum step size.
        """
        ...


class _Ladder:
    """Scenes and prepared solvers by step size; the oldest beyond FACTORS are discarded."""

    def __init__(self, bound: Callable[[float], Scene], solver: Solver, horizon: float) -> None:
        self._bound, self._solver, self._horizon = bound, solver, horizon
        self._kept = OrderedDict[int, tuple[Scene, Prepared]]()
        self.made = 0

    def length(self, level: int) -> float:
        """Return the step size [s] of a level."""
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
    """Estimate the memory of a solver's factors: an index and a number for each entry."""
    return 12.0 * sum(count for name, count in prepared.facts.items() if name.startswith("nnz") and "factor" in name)


@dataclass(frozen=True, eq=False)
class Implicit(Follower):
    """Adaptive stepping by an integrator with an embedded error estimate.

    Attributes:
      bound: builds the scene with a given step size [s].
      solver: solver of the steps.
      horizon: end time [s].
      frames: number of frames up to the end time.
    """

    bound: Callable[[float], Scene]
    solver: Solver
    horizon: float
    frames: int

    @property
    def order(self) -> int:
        """The order of convergence of the integrator."""
        return self.bound(self.horizon / self.frames).integrator.order

    def follow(self, setting: float, *, limit: float = inf) -> Path:
        """Integrate the motion; raises Unsupported for an integrator without an error estimate and for velocity
        filters.
        """
        return _Following(self, setting, limit).path()


class _Following:
    """One motion with steps of the levels."""

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
        """Integrate to the end and return the motion."""
        while self._ticks < 1 << _FINEST:
            self._one()
            if thread_time() - self._cpu > self._limit:
                raise TooSlow
        counts = self._accepted, self._rejected, self._ladder.made, self._iterations
        shared, processor = shares(self._reached), thread_time() - self._cpu
        return Path(np.array(self._seen), *counts, self._lengths, self._reached[-1], shared, processor)

    def _one(self) -> None:
        """Try one step."""
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
        """Choose the next step's level after a step of size h [s]."""
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
        """Build the stop rule from the share of the error estimate that residuals may cause.

        A residual is at least rate |dp|_M. It adds rate h |dp| to the positions, and rate times as much to the
        velocities.
        """
        speed = self._method.speed
        part = ALGEBRAIC * self._tolerance / (speed * (1.0 + speed * self._span / h))
        return StopRule(TRIES, within=part * speed / h * (3.0 * len(self._free) * self._mass) ** 0.5)

    def _ratio(self, done: Done) -> float:
        """Return the step's error relative to the tolerance; infinite where a solve did not converge."""
        error, within = done.end.error, self._stop(self._ladder.length(self._level)).within
        if error is None or not all(_solved(solution, within) for _, solution in done.stages):
            return inf
        with np.errstate(over="ignore", invalid="ignore"):
            squares = sum(float((part[self._free] ** 2).sum()) for part in (error[0], self._span * error[1]))
        found = (squares / max(1, 3 * len(self._free))) ** 0.5 / self._tolerance
        return found if isfinite(found) else inf

    def _show(self, after: Motion, time: float, h: float) -> None:
        """Add the frames that end within a step."""
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
    """Return whether a solve ended with a small enough residual.

    A stalled solve is allowed a larger one, since round-off may prevent any further reduction.
    """
    if solution.stopped == "stalled":
        return solution.residual <= _STALLED * within
    return solution.stopped != "iterations"


def shares(reached: Sequence[float]) -> tuple[float, ...]:
    """Return the wall time [s] of each frame from the cumulative times.

    Frames of one step share its time equally.
    """
    gone = np.diff(np.array(reached), prepend=0.0)
    steps = np.cumsum(gone > 0.0)
    return tuple(float(gone[steps == step].mean()) for step in steps)


def hermite(before: Motion, after: Motion, h: float, part: float) -> Positions:
    """Interpolate positions within a step by cubic Hermite polynomials of the motions at both ends.

    Args:
      before: motion at the start.
      after: motion at the end.
      h: step size [s].
      part: fraction of the step.

    Returns: positions (n, 3) [m], accurate to order 3.
    """
    (p, v), (q, w), s = before, after, part
    if s == 1.0:
        return q
    d = q - p
    return p + s * (h * v + s * (3.0 * d - h * (2.0 * v + w) + s * (h * (v + w) - 2.0 * d)))

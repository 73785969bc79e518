"""Comparison of the two implementations of a scene's terms at one point.

Arrays may differ by the round-off of the sums they result from; energies and their derivatives as `complex_step`
states.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from harness.simulation.opinion.declared import Array
from harness.simulation.opinion.derivatives import EPS, ROUNDINGS, Told, tell, wide
from harness.simulation.opinion.motion import blur
from harness.simulation.opinion.outside import own_slope
from harness.simulation.opinion.sides import Side
from harness.simulation.opinion.steps import Stated
from solvers.problem import Energy, StepProblem

_SETTLED = 1e-3
"""Relative change of a slope allowed by friction's normal forces once the friction rounds have ended."""


class Finding(NamedTuple):
    """Name of a term that differs, and the difference relative to the reference value."""

    name: str
    by: float


@dataclass(frozen=True, eq=False)
class Place:
    """A point of comparison.

    Attributes:
      side: reference terms of the scene.
      stated: the step as the reference implementation builds it.
      problem: the step as the harness builds it.
      x: solution of the step (n, 3) [m].
      direction: direction of the derivatives (n, 3).
    """

    side: Side
    stated: Stated
    problem: StepProblem
    x: Array
    direction: Array

    @property
    def reach(self) -> float:
        """The largest coordinate [m] that the step depends on."""
        m = self.stated.moment
        parts = (self.x, m.p, m.origin, m.time_step * m.v, self.stated.target)
        return max(float(np.abs(part).max(initial=0.0)) for part in parts)

    @property
    def aim(self) -> float:
        """The size [m] whose product with eps is the round-off of the pins' targets."""
        size = self.reach + sum(opinion.reach for opinion in self.side.opinions)
        moves = [motion for effect in self.side.declared.effects if (motion := getattr(effect, "motion", None))]
        end = self.stated.moment.time + self.stated.moment.time_step
        held = float(np.abs(self.stated.held).max(initial=0.0))  # where the mesh is all in one point, they are not
        return max([size, held, *(blur(motion, size, end) / EPS for motion in moves)])


def pressed(stated: Stated, problem: StepProblem, x: Array) -> Stated:
    """Return the step with friction's normal forces at its solution x (n, 3) [m].

    It is unchanged unless the harness has a further friction round.
    """
    return stated if problem.start.pressed is None else replace(stated, moment=replace(stated.moment, pressed=wide(x)))


def differ(name: str, ours: Any, theirs: Any, size: float) -> Iterator[Finding]:
    """Compare arrays and yield a mismatch if they differ by more than round-off.

    Args:
      name: name of the term.
      ours: array of the harness.
      theirs: array of the reference implementation.
      size: magnitude [unit of the arrays] of the numbers that determine the round-off.
    """
    ours, theirs = wide(ours), wide(theirs)
    if ours.shape != theirs.shape:
        yield Finding(f"{name} (number)", 1.0)
        return
    away = float(np.where(ours == theirs, 0.0, np.abs(ours - theirs)).max(initial=0.0))
    if not away <= ROUNDINGS * EPS * size:
        yield Finding(name, _part(away, float(np.abs(theirs).max(initial=0.0))))


def _part(away: float, size: float) -> float:
    return away / max(size, np.finfo(float).tiny)


def steps(at: Place) -> Iterator[Finding]:
    """Compare masses, inertia, forces and pins."""
    system, problem, stated = at.problem.system, at.problem, at.stated
    m, start, mass, reach = stated.moment, at.problem.start, at.side.declared.mass, at.reach
    dt, most = m.time_step, float(np.abs(mass).max(initial=0.0))
    yield from differ("masses", system.mass, mass, most)
    yield from differ("inertia", system.inertia, stated.c * mass / dt**2, stated.c * most / dt**2)
    yield from differ("inertial target", problem.target, stated.target, reach)
    yield from differ("the step's start", start.positions, m.p, reach)
    yield from differ("filtered velocities", start.velocity, m.v, reach / dt)
    yield from differ("origin of velocities", start.origin, m.origin, reach)
    yield from differ("rate of velocities", [start.rate, system.rate], [m.rate, m.rate], m.rate)
    if start.pressed is not None:
        yield from differ("where friction is pressed", start.pressed, m.pressed, reach)
    yield from differ("times", [start.time, start.until], [m.time, m.until], max(m.until, dt))
    yield from differ("forces", problem.force, stated.force, stated.force_size * (1.0 + reach / at.side.shortest()))
    if system.pins.vertices.tolist() != stated.vertices:
        yield Finding("pinned vertices", 1.0)
        return
    soft = max((w for w in stated.weights if np.isfinite(w)), default=0.0)
    found = sorted(
        (*edge, low, high)
        for one in system.lengths
        for edge, low, high in zip(one.edges.tolist(), one.low.tolist(), one.high.tolist(), strict=True)
    )
    wanted = sorted((*edge, *kept) for one in at.side.opinions for edge, kept in one.exact.items())
    yield from differ("exact lengths", np.reshape(found, (-1, 4)), np.reshape(wanted, (-1, 4)), reach)
    yield from differ("weights of pins", system.pins.weight, stated.weights, soft)
    yield from differ("targets of pins", problem.pin_targets, stated.held, at.aim)


def energies(at: Place) -> Iterator[Finding]:
    """Compare the energies of each effect, and the objective, their sum."""
    side, stated, reach = at.side, at.stated, at.reach
    free = at.direction.copy()
    free[[i for i, w in zip(stated.vertices, stated.weights, strict=True) if np.isinf(w)]] = 0.0
    x, d = wide(at.x), wide(free)
    parts = [_others(at, x, d)]
    for k, begin in enumerate(side.begins):
        own = [at.problem.energies[i] for i in side.owned[k]]
        if begin is None:
            told, wrong = own_slope(own, at.x, free, reach, side.shortest())
            if wrong is not None:
                yield Finding(f"{side.name(k)} (gradient against its own value)", wrong)
        else:
            told = tell(begin(stated.moment), x, d, _reach_of(at, k), side.shortest(k))
            yield from _unsettled(at, k, told, x, d)
            if np.isfinite(told.value) or any(np.isfinite(energy.value(at.x)) for energy in own):
                yield from _against(side.name(k), told, own, at.x, free)
        parts.append(told)
    if not all(np.isfinite(part.value) for part in parts):
        return
    # Forces are computed in float64, with a separate sum for each vertex.
    pulled = ROUNDINGS * EPS * float(np.abs(d).sum()) * stated.force_size
    room = [sum(part.allowed[k] for part in parts) for k in range(2)]
    value, slope = at.problem.value(at.x), float((at.problem.gradient(at.x) * free).sum())
    yield from _told("objective (value)", value, sum(part.value for part in parts), room[0] + reach * pulled)
    yield from _told("objective (gradient)", slope, sum(part.slope for part in parts), room[1] + pulled)


def _unsettled(at: Place, k: int, told: Told, x: Any, d: Any) -> Iterator[Finding]:
    """Compare friction of effect k with normal forces at the step's start and at x."""
    effect, m, begin = at.side.declared.effects[k], at.stated.moment, at.side.begins[k]
    if m.pressed is not None or not getattr(effect, "friction", 0.0) or effect.friction_rounds == 1:
        return
    assert begin
    own = tell(begin(replace(m, pressed=x)), x, d, _reach_of(at, k), at.side.shortest(k))
    if not abs(own.slope - told.slope) <= _SETTLED * abs(own.slope) + own.allowed[1] + told.allowed[1]:
        yield Finding(f"{at.side.name(k)} (friction's pressure)", _part(abs(own.slope - told.slope), abs(own.slope)))


def _reach_of(at: Place, k: int) -> float:
    """Return the largest coordinate [m] that effect k depends on, including moving parts."""
    effect, reach = at.side.declared.effects[k], at.reach + at.side.opinions[k].reach
    moving = [effect, *getattr(effect, "obstacles", ())]
    late = at.stated.moment.time + at.stated.moment.time_step
    return max([reach, *(blur(getattr(one, "motion", None), reach, late) / EPS for one in moving)])


def _against(name: str, told: Told, own: Sequence[Energy], x: Array, d: Array) -> Iterator[Finding]:
    """Compare the energies of one effect with its reference derivatives."""
    gradient = np.zeros_like(x)
    for energy in own:
        energy.add_gradient(x, gradient)
    yield from _told(f"{name} (value)", sum(energy.value(x) for energy in own), told.value, told.allowed[0])
    yield from _told(f"{name} (gradient)", float((gradient * d).sum()), told.slope, told.allowed[1])
    bend = sum(_bend(energy, x, d) for energy in own)
    yield from _told(f"{name} (Hessian)", bend, told.bend, told.allowed[2])


def _bend(energy: Any, x: Array, d: Array) -> float:
    """Return the second derivative along d by an energy's Hessian.

    The Hessian may be split into a sparse part and columns.
    """
    flat = d.ravel()
    if not hasattr(energy, "columns"):
        return float(flat @ (energy.hessian(x) @ flat))
    dense = np.einsum("nik,ni->k", energy.columns(x), d)
    return float(flat @ (energy.sparse_hessian(x) @ flat) + dense @ dense)


def _told(name: str, ours: float, theirs: float, room: float) -> Iterator[Finding]:
    if not abs(ours - theirs) <= room:
        yield Finding(name, _part(abs(ours - theirs), abs(theirs)))


def _others(at: Place, x: Any, d: Any) -> Told:
    """Evaluate inertia, the pins' penalties and the forces."""
    stated = at.stated
    soft = [i for i, w in enumerate(stated.weights) if np.isfinite(w)]
    held, weight = [stated.vertices[i] for i in soft], wide([stated.weights[i] for i in soft])
    inertia = wide(stated.c * at.side.declared.mass / stated.moment.time_step**2)

    def values(y: Any) -> Any:
        away, sag = y - wide(stated.target), y[held] - stated.held[soft]
        squares = [inertia / 2 * (away**2).sum(axis=1), weight / 2 * (sag**2).sum(axis=1)]
        return np.concatenate([*squares, -(y * stated.force).sum(axis=1)])

    return tell(values, x, d, max(at.reach, at.aim), at.reach or 1.0)

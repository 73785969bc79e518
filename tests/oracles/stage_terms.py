# pyright: reportConstantRedefinition=false
# V and A are the symbols of the formulas.
"""Reference steps of integrators with several stages: Butcher tableaux and generalised alpha.

Runge-Kutta, a stage with the weights a_ij and the time c_i (Alexander 1977; Hairer and Wanner, table IV.6.5; Hosea and
Shampine 1996; Kennedy and Carpenter 2003):

    x = p + dt sum_j a_ij V_j,     V_i = v + dt sum_j a_ij A_j,     the last stage ends the step

Generalised alpha by Newmark's formulas (Chung and Hulbert 1993):

    x = (1 - af) d' + af d,   a' = (d' - d - dt v) / (beta dt^2) - (1/(2 beta) - 1) a,   v' = v + dt ((1 - g) a + g a')

The expected solution of a stage is extrapolated with the known acceleration nearest in time. From order 3 on, where
forces or dashpots depend on it, it is the solution itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.oracles.complex_step import ExtendedArray, to_extended
from tests.oracles.scene_declaration import Array, EffectTerms, SceneDeclaration, StepMoment
from tests.oracles.step_terms import MotionArrays, ReferenceStep, filter_motion, sum_forces

SolutionFunction = Callable[[float], Array]
"""Maps the time [s] of a stage to the solution (n, 3) [m] that the solver returns."""

_HALF = np.sqrt(to_extended(0.5))


def _build_alexander() -> list[Any]:
    g = to_extended(0.4358665215)
    for _ in range(5):  # Newton's method
        g -= (g**3 - 3 * g**2 + 1.5 * g - to_extended(1) / 6) / (3 * g**2 - 6 * g + 1.5)
    c = (1 + g) / 2
    two = (0.5 - g - g * (1 - g)) / (c - g)  # b_1 + b_2 = 1 - g and b_1 g + b_2 c = 1/2 - g
    return [[g], [c - g, g], [1 - g - two, two, g]]


def _build_tr_bdf2() -> list[Any]:
    d = 1 - _HALF
    return [[0], [d, d], [(1 - d) / 2, (1 - d) / 2, d]]


def _build_esdirk3() -> list[Any]:
    g = to_extended(1767732205903) / 4055673282236
    third = [to_extended(2746238789719) / 10658868560708, -to_extended(640167445237) / 6845629431997, g]
    last = [to_extended(1471266399579) / 7840856788654, -to_extended(4482444167858) / 7529755066697]
    return [[0], [g, g], third, [*last, to_extended(11266239266428) / 11593286722821, g]]


def _append_quarters(*rows: list[Any]) -> list[Any]:
    """Return the rows with a quarter appended to each."""
    return [[*row, to_extended(1) / 4] for row in rows]


_W = to_extended
_TABLEAUX: dict[str, list[Any]] = {
    "sdirk-2": [[1 - _HALF], [_HALF, 1 - _HALF]],
    "sdirk-3": _build_alexander(),
    "sdirk-4": _append_quarters(
        [],
        [_W(1) / 2],
        [_W(17) / 50, -_W(1) / 25],
        [_W(371) / 1360, -_W(137) / 2720, _W(15) / 544],
        [_W(25) / 24, -_W(49) / 48, _W(125) / 16, -_W(85) / 12],
    ),
    "tr-bdf2": _build_tr_bdf2(),
    "esdirk-3": _build_esdirk3(),
    "esdirk-4": [
        [0],
        *_append_quarters(
            [_W(1) / 4],
            [_W(8611) / 62500, -_W(1743) / 31250],
            [_W(5012029) / 34652500, -_W(654441) / 2922500, _W(174375) / 388108],
            [
                *(_W(15267082809) / 155376265600, -_W(71443401) / 120774400),
                *(_W(730878875) / 902184768, _W(2285395) / 8070912),
            ],
            [_W(82889) / 524892, 0, _W(15625) / 83664, _W(69875) / 102672, -_W(2260) / 8211],
        ),
    ],
}
_ALPHA_PARAMETERS = {
    "generalised-alpha": (to_extended(0), to_extended(1) / 3),
    "hht": (to_extended(0), to_extended(0.1)),
    "newmark": (to_extended(0), to_extended(0)),
}
"""am and af; for a spectral radius of 1/2 they are (2/2 - 1)/(3/2) and (1/2)/(3/2)."""
_ORDERS = {"sdirk-3": 3, "esdirk-3": 3, "sdirk-4": 4, "esdirk-4": 4}
STAGED_INTEGRATORS = (*_TABLEAUX, *_ALPHA_PARAMETERS)


@dataclass(frozen=True, eq=False)
class StageSolutions:
    """Reference stages of a step, their solutions (n, 3) [m], and its end."""

    reference_steps: list[ReferenceStep]
    answers: list[Array]
    end: MotionArrays
    acceleration: ExtendedArray


class _StageRecorder:
    """One step from a motion and its acceleration (n, 3) [m/s^2] at a time [s]."""

    def __init__(
        self,
        name: str,
        declared: SceneDeclaration,
        effect_terms: Sequence[EffectTerms],
        now: MotionArrays,
        time: float,
        answer: SolutionFunction,
    ) -> None:
        self.declared, self.effect_terms, self.answer, self.time = declared, effect_terms, answer, time
        self.dt = to_extended(declared.time_step)
        pinned = {i: pin for terms in effect_terms for i, pin in terms.pinned_vertices.items()}
        self.pins = sorted(pinned.items())
        self.exact = [(i, pin) for i, pin in self.pins if np.isinf(pin.weight)]
        self.now = self.apply_exact_pins(filter_motion(now, effect_terms), time)
        self.lags = _ORDERS.get(name, 2) > 2
        self.reference_steps: list[ReferenceStep] = []
        self.answers: list[Array] = []

    def apply_exact_pins(self, motion: MotionArrays, time: float) -> list[ExtendedArray]:
        """Return the motion with positions and velocities of exact pins at a time [s]."""
        p, v = (to_extended(part).copy() for part in motion)
        for i, pin in self.exact:
            p[i], v[i] = pin.position(time), pin.velocity(time)
        return [p, v]

    def add_stage(
        self, c: Any, rate: Any, when: Any, target: ExtendedArray, origin: ExtendedArray, expected: ExtendedArray
    ) -> tuple[ExtendedArray, ExtendedArray]:
        """Record a stage; return its solution and velocity.

        Args:
          c: inertia factor.
          rate: factor [1/s] in the velocity, rate (x - origin).
          when: fraction of the step.
          target: inertial target (n, 3) [m].
          origin: origin (n, 3) [m] in the velocity.
          expected: expected acceleration (n, 3) [m/s^2].
        """
        until = self.time + float(when) * self.declared.time_step
        origin, led = origin.copy(), target + self.dt**2 / c * expected
        pin_targets = to_extended([pin.position(until) for _, pin in self.pins]).reshape(-1, 3)
        for k, (i, pin) in enumerate(self.pins):
            led[i] = pin_targets[k]
            if np.isinf(pin.weight):
                origin[i] = pin_targets[k] - to_extended(pin.velocity(until)) / rate
        x = self.answer(until)
        there = to_extended(x) if self.lags else led
        p, v = (np.asarray(part, float) for part in (there, rate * (there - origin)))
        force, size = sum_forces(self.effect_terms, p, v, until)
        q, u = self.now
        moment = StepMoment(self.declared.time_step, float(rate), float(when), self.time, until, q, u, there, origin)
        weights = [pin.weight for _, pin in self.pins]
        vertices = [i for i, _ in self.pins]
        now = [np.asarray(part, float) for part in self.now]
        self.reference_steps.append(
            ReferenceStep(float(c), target, force, size, vertices, weights, pin_targets, moment, now)
        )
        self.answers.append(x)
        return to_extended(x), rate * (to_extended(x) - origin)

    def zero_exact_pins(self, a: ExtendedArray) -> ExtendedArray:
        """Set an acceleration to zero at exact pins."""
        a[[i for i, _ in self.exact]] = 0
        return a

    def finish_step(self, end: MotionArrays, a: ExtendedArray) -> StageSolutions:
        """Return the completed step."""
        return StageSolutions(
            self.reference_steps, self.answers, self.apply_exact_pins(end, self.time + self.declared.time_step), a
        )


def solve_stages(
    name: str,
    declared: SceneDeclaration,
    effect_terms: Sequence[EffectTerms],
    now: MotionArrays,
    acceleration: Array,
    time: float,
    answer: SolutionFunction,
) -> StageSolutions:
    """Take the step of an integrator from a motion and its acceleration.

    Args:
      name: name of the integrator.
      declared: declaration of the scene.
      effect_terms: reference terms of the effects.
      now: motion at the start.
      acceleration: acceleration (n, 3) [m/s^2] at the start.
      time: time [s] of the start.
      answer: solution of a stage as a function of time.
    """
    step = _StageRecorder(name, declared, effect_terms, now, time, answer)
    run = _generalised_alpha if name in _ALPHA_PARAMETERS else _runge_kutta
    return run(name, step, to_extended(acceleration))


def _runge_kutta(name: str, step: _StageRecorder, a0: ExtendedArray) -> StageSolutions:
    rows, dt, (p, v) = _TABLEAUX[name], step.dt, step.now
    known, V, A = [(to_extended(0), a0)], list[ExtendedArray](), list[ExtendedArray]()
    if rows[0] == [0]:
        V, A, rows = [v], [a0], rows[1:]
    x = p
    for *row, g in rows:
        origin, base = (
            y + dt * sum((w * k for w, k in zip(row, ks, strict=True)), 0 * y) for y, ks in ((p, V), (v, A))
        )
        when = sum(row) + g
        distance = [abs(when - t) for t, _ in known]
        expected = known[distance.index(min(distance))][1]
        target = origin + g * dt * base
        x, u = step.add_stage(1 / g**2, 1 / (g * dt), when, target, origin, expected)
        V.append(u)
        A.append(step.zero_exact_pins((x - target) / (g * dt) ** 2))
        known.append((when, A[-1]))
    return step.finish_step([x, V[-1]], A[-1])


def _generalised_alpha(name: str, step: _StageRecorder, a: ExtendedArray) -> StageSolutions:
    (am, af), dt, (d, v) = _ALPHA_PARAMETERS[name], step.dt, step.now
    gamma, beta = to_extended(0.5) - am + af, (1 - am + af) ** 2 / 4

    def after(x: ExtendedArray) -> list[ExtendedArray]:
        """Return d', v' and a' of a solution."""
        end = (x - af * d) / (1 - af)
        b = (end - d - dt * v) / (beta * dt**2) - (1 / (2 * beta) - 1) * a
        return [end, v + dt * ((1 - gamma) * a + gamma * b), b]

    c, rate = (1 - am) / ((1 - af) * beta), gamma / (beta * dt)
    _, u, b = after(d)  # the formulas are linear in x, and so may be read off anywhere
    target = d - dt**2 / c * ((1 - am) * b + am * a)
    origin = d - ((1 - af) * u + af * v) / rate
    x, _ = step.add_stage(c, rate, 1 - af, target, origin, a)
    mean = step.zero_exact_pins(c / dt**2 * (x - target))
    b = (mean - am * a) / (1 - am)
    end = d + dt * v + dt**2 * ((to_extended(0.5) - beta) * a + beta * b)
    return step.finish_step([end, v + dt * ((1 - gamma) * a + gamma * b)], b)

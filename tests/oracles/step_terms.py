"""Reference steps of integrators with one stage (Liu et al. 2013, eq. 6; Hairer and Wanner).

                     c     x             target                            velocity at x             after the step
    implicit Euler   1     p(t + dt)     p + dt v                          (x - p)/dt                x
    BDF2             9/4   p(t + dt)     (4 p - p')/3 + 2 dt/9 (4 v - v')  (3 x - 4 p + p')/(2 dt)   x
    midpoint         4     p(t + dt/2)   p + dt/2 v                        2 (x - p)/dt              2 x - p

A step of BDF2 without a previous motion is one of implicit Euler. Forces and lagged quantities are evaluated at the
start of the step for implicit Euler, and otherwise extrapolated to the time of x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.oracles.complex_step import to_extended
from tests.oracles.scene_declaration import Array, EffectTerms, SceneDeclaration, StepMoment

MotionArrays = Sequence[Array]
"""Positions (n, 3) [m] and velocities (n, 3) [m/s]."""


@dataclass(frozen=True, eq=False)
class ReferenceStep:
    """One reference step.

    Attributes:
      c: inertia factor.
      inertial_target: target (n, 3) [m].
      external_force: force (n, 3) [N].
      force_size: size [N] of its round-off, divided by eps.
      vertices: pinned vertices.
      weights: their weights [N/m].
      pin_targets: their targets (q, 3) [m].
      step_moment: data of the step.
      start_motion: motion at the start, filtered.
    """

    c: float
    inertial_target: Any
    external_force: Array
    force_size: float
    vertices: list[int]
    weights: list[float]
    pin_targets: Any
    step_moment: StepMoment
    start_motion: MotionArrays

    def end_motion(self, x: Array) -> tuple[Any, Any]:
        """Return positions and velocities at the step's end from its solution x (n, 3) [m]."""
        m = self.step_moment
        v = m.velocity_rate * (to_extended(x) - m.velocity_origin)
        return (to_extended(x), v) if m.stage_fraction == 1.0 else (2 * to_extended(x) - m.p, 2 * v - m.v)


def build_reference_step(
    integrator: str,
    declared: SceneDeclaration,
    effect_terms: Sequence[EffectTerms],
    now: MotionArrays,
    before: MotionArrays | None,
    time: float,
) -> ReferenceStep:
    """Build the reference step.

    Args:
      integrator: name of the integrator.
      declared: declaration of the scene.
      effect_terms: reference terms of the effects.
      now: motion at the start.
      before: motion one step earlier, None where there is none.
      time: time [s] of the start.
    """
    dt = declared.time_step
    now, earlier = filter_motion(now, effect_terms), filter_motion(before or now, effect_terms)
    (p, v), (p0, v0) = ((to_extended(a), to_extended(b)) for a, b in (now, earlier))
    begins_with_euler = integrator == "substepping" or (integrator == "bdf2" and before is None)
    method = "implicit-euler" if begins_with_euler else integrator
    if method == "implicit-euler":
        c, target, origin, when, ahead = 1.0, p + dt * v, p, 1.0, 0.0
    elif method == "bdf2":
        origin = (4 * p - p0) / 3
        c, target, when, ahead = 9 / 4, origin + 2 * dt * (4 * v - v0) / 9, 1.0, 1.0
    else:
        c, target, origin, when, ahead = 4.0, p + dt * v / 2, p, 0.5, 0.5
    far = ahead if before else 0.0
    at = [np.asarray(x + far * (x - y), float) for x, y in zip(now, earlier, strict=True)]
    force, size = sum_forces(effect_terms, at[0], at[1], time + ahead * dt)
    pinned = {i: pin for terms in effect_terms for i, pin in terms.pinned_vertices.items()}
    vertices = sorted(pinned)
    pin_targets = to_extended([pinned[i].position(time + dt) for i in vertices]).reshape(-1, 3)
    pin_targets = p[vertices] + when * (pin_targets - p[vertices]) if when < 1.0 else pin_targets
    moment = StepMoment(dt, c**0.5 / dt, when, time, time + when * dt, p, v, p + ahead * dt * v, origin)
    return ReferenceStep(
        c, target, force, size, vertices, [pinned[i].weight for i in vertices], pin_targets, moment, now
    )


def sum_forces(effect_terms: Sequence[EffectTerms], p: Array, v: Array, time: float) -> tuple[Array, float]:
    """Sum all forces (n, 3) [N], and the sizes [N] of their round-off.

    Args:
      effect_terms: reference terms of the effects.
      p: positions (n, 3) [m].
      v: velocities (n, 3) [m/s].
      time: time [s].
    """
    force, size = np.zeros_like(p), 0.0
    for terms in effect_terms:
        if terms.evaluate_force:
            more, its = terms.evaluate_force(p, v, time)
            force, size = force + more, size + its
    return force, size


def filter_motion(motion: MotionArrays, effect_terms: Sequence[EffectTerms]) -> MotionArrays:
    """Return the motion at a step's start with filtered velocity."""
    p, v = motion
    for terms in effect_terms:
        v = terms.filter_velocity(v) if terms.filter_velocity else v
    return [p, v]

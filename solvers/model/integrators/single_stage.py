"""Time integrators with one stage per step.

The step problems of all of them have the same form: minimise over the stage x

    energies(x) + c/(2 dt^2) |x - target|_M^2 - tr(x' f),       Q = A'KA + c M/dt^2

                     c     x             target                                    velocity of x
    implicit Euler   1     p^(t+dt)      p + dt v                                  (x - p)/dt
    BDF2             9/4   p^(t+dt)      (4 p - p')/3 + 2 dt/9 (4 v - v')          3/(2 dt) (x - (4 p - p')/3)
    midpoint         4     p^(t+dt/2)    p + dt/2 v                                2/dt (x - p)

with p, v at the start of the step and p', v' one step earlier. The velocity is sqrt(c)/dt (x - velocity_origin) for all
three. Implicit Euler has order 1 and numerical damping, the others have order 2; midpoint conserves quadratic energies
(Hairer and Wanner, Solving Ordinary Differential Equations II, sections IV.12 and V.1; Hairer, Lubich and Wanner,
Geometric Numerical Integration, section IV.2). Implicit Euler evaluates external forces at the start of the step, as
Liu et al. 2013 do; the others evaluate them at the motion extrapolated to the time of x. Velocity filters act before a
step, for midpoint half a step early: its positions then have order 2 from a start at rest, and order 1 from a moving
one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from springbench.solvers.model.integrators.integrator_stages import Motion
from springbench.solvers.model.step_problem import Positions, Solution, StepStart, Unsupported


@dataclass(frozen=True, slots=True)
class SingleStageIntegrator:
    """An integrator with one stage per step.

    Attributes:
        inertia_factor: c.
        stage_fraction: time of the stage as a fraction of the step, 1 at its end.
        extrapolation_fraction: time of the external forces, as such a fraction.
        needs_history: whether the motion of the previous step is needed; implicit Euler then takes the first step.
        predict_target: function of the motions now and one step earlier, and of dt [s], that returns target and
            velocity_origin, each (n, 3) [m].
        order: order of the error.

    Example:
        >>> def predict(now, previous, dt):  # implicit Euler
        ...     return now.positions + dt * now.velocity, now.positions
        >>> springbench.SingleStageIntegrator(1.0, 1.0, 0.0, needs_history=False, predict_target=predict).order
        1
    """

    velocity_factor: ClassVar[None] = None
    """None: the velocity of the stage follows from c."""
    num_stages: ClassVar[int] = 1
    has_split_filters: ClassVar[bool] = True
    """Whether velocity filters act before a step."""

    inertia_factor: float
    stage_fraction: float
    extrapolation_fraction: float
    needs_history: bool
    predict_target: Callable[[Motion, Motion, float], tuple[Positions, Positions]]
    order: int = 1

    def complete_step(self, step_start: StepStart, solution: Solution) -> Motion:
        """Return the motion at the end of the step.

        Args:
            step_start: motion at the start of the step, and the velocity as a function of the stage.
            solution: the solution of the stage; its velocity, if the solver computes one, is that of the result.
        """
        x = solution.positions
        if solution.velocity is not None:
            return Motion(x, solution.velocity)
        v = step_start.velocity_at(x)
        if self.stage_fraction == 1.0:
            return Motion(x, v)
        return Motion(2.0 * x - step_start.positions, 2.0 * v - step_start.velocity)  # x and v are means over the step


def _predict_euler(motion: Motion, previous_motion: Motion, dt: float) -> tuple[Positions, Positions]:
    return motion.positions + dt * motion.velocity, motion.positions


def _predict_bdf2(motion: Motion, previous_motion: Motion, dt: float) -> tuple[Positions, Positions]:
    origin = (4.0 * motion.positions - previous_motion.positions) / 3.0
    return origin + 2.0 * dt / 9.0 * (4.0 * motion.velocity - previous_motion.velocity), origin


def _predict_midpoint(motion: Motion, previous_motion: Motion, dt: float) -> tuple[Positions, Positions]:
    return motion.positions + 0.5 * dt * motion.velocity, motion.positions


@dataclass(frozen=True, slots=True)
class SubsteppingIntegrator(SingleStageIntegrator):
    """The integrator for solvers that integrate a step themselves and return the velocity.

    No velocity filters act: drag is a force.
    """

    has_split_filters: ClassVar[bool] = False

    def complete_step(self, step_start: StepStart, solution: Solution) -> Motion:
        """Return the solver's motion at the end of the step.

        Args:
            step_start: motion at the start of the step, not used.
            solution: positions and velocity at the end of the step.

        Raises:
            Unsupported: the solver computes no velocity.
        """
        if solution.velocity is None:
            raise Unsupported(
                "the integrator `substepping` requires a solver that integrates a step itself, such as "
                "dormand-prince-8; this one minimises an objective: use an integrator such as implicit-euler"
            )
        return Motion(solution.positions, solution.velocity)


IMPLICIT_EULER = SingleStageIntegrator(1.0, 1.0, 0.0, False, _predict_euler)
BDF2 = SingleStageIntegrator(2.25, 1.0, 1.0, True, _predict_bdf2, order=2)
MIDPOINT = SingleStageIntegrator(4.0, 0.5, 0.5, False, _predict_midpoint, order=2)
SUBSTEPPING = SubsteppingIntegrator(1.0, 1.0, 0.0, False, _predict_euler)

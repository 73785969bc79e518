"""The generalised-alpha method (Chung and Hulbert 1993), with the forces evaluated at the stage.

    d' = d + dt v + dt^2 ((1/2 - beta) a + beta a'),    v' = v + dt ((1 - gamma) a + gamma a')
    M ((1 - am) a' + am a) = f(x, (1 - af) v' + af v, t + (1 - af) dt),     x = (1 - af) d' + af d

for the motion d, v, a at the start of the step and d', v', a' at its end. The mean acceleration is
c/dt^2 (x - target) with

    c = (1 - am) / ((1 - af) beta),     target = d + (1 - af) (dt v + (1/2 - beta/(1 - am)) dt^2 a)

The order is 2 if gamma = 1/2 - am + af. A spectral radius r in the limit of high frequencies gives am =
(2 r - 1)/(r + 1) and af = r/(r + 1). Hilber, Hughes and Taylor (1977) have am = 0; Newmark's average acceleration
method (1959) has am = af = 0. All are unconditionally stable for linear problems; beta = (1 - am + af)^2/4 maximises
the damping of high frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from springbench.solvers.model.integrators.integrator_stages import Motion, Stage, StageGenerator, StepEnd
from springbench.solvers.model.step_problem import Positions


@dataclass(frozen=True)
class GeneralisedAlpha:
    """The method with parameters am, of the masses, and af, of the forces.

    Example:
        >>> method = springbench.GeneralisedAlpha.from_spectral_radius(1.0)
        >>> method.gamma, method.beta
        (0.5, 0.25)
    """

    alpha_m: float
    alpha_f: float

    order: ClassVar[int] = 2
    num_stages: ClassVar[int] = 1
    needs_start_acceleration: ClassVar[bool] = True
    embedded_order: ClassVar[int] = 0

    @classmethod
    def from_spectral_radius(cls, spectral_radius: float) -> GeneralisedAlpha:
        """Return the method that multiplies the highest frequencies by `spectral_radius`, in [0, 1], per step."""
        return cls((2.0 * spectral_radius - 1.0) / (spectral_radius + 1.0), spectral_radius / (spectral_radius + 1.0))

    @property
    def gamma(self) -> float:
        """The gamma of order 2."""
        return 0.5 - self.alpha_m + self.alpha_f

    @property
    def beta(self) -> float:
        """The beta of maximum damping."""
        return 0.25 * (1.0 - self.alpha_m + self.alpha_f) ** 2

    @property
    def inertia_factor(self) -> float:
        """The factor c."""
        return (1.0 - self.alpha_m) / ((1.0 - self.alpha_f) * self.beta)

    @property
    def velocity_factor(self) -> float:
        """Ratio gamma/beta of the changes of the stage's velocity and positions, in units of 1/dt."""
        return self.gamma / self.beta

    def iterate_stages(self, motion: Motion, acceleration: Positions | None, dt: float) -> StageGenerator:
        """Yield the only stage of a step, and return the end of the step.

        Args:
            motion: motion at the start of the step.
            acceleration: acceleration (n, 3) [m/s^2] at the start of the step.
            dt: length of the step [s].

        Raises:
            ValueError: the acceleration is None.
        """
        if acceleration is None:
            raise ValueError("the method needs the acceleration at the step's start")
        (p, v), a = motion, acceleration
        when, less = 1.0 - self.alpha_f, 1.0 - self.alpha_m
        target = p + when * (dt * v + dt**2 * (0.5 - self.beta / less) * a)
        slow = v + when * dt * (1.0 - self.gamma / less) * a  # the velocity at the target
        found = yield Stage(when, target, target - dt / self.velocity_factor * slow, a)
        b = (found.acceleration - self.alpha_m * a) / less
        end = p + dt * v + dt**2 * ((0.5 - self.beta) * a + self.beta * b)
        return StepEnd(Motion(end, v + dt * ((1.0 - self.gamma) * a + self.gamma * b)), b)


GENERALISED_ALPHA = GeneralisedAlpha.from_spectral_radius(0.5)
HHT = GeneralisedAlpha(0.0, 0.1)
NEWMARK = GeneralisedAlpha(0.0, 0.0)

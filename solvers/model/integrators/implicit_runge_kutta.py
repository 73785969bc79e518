"""Diagonally implicit Runge-Kutta methods with one diagonal element gamma.

The last stage is the end of the step:

    P_i = x^ + gamma dt V_i,    x^ = p + dt sum_(j<i) a_ij V_j
    V_i = v^ + gamma dt A_i,    v^ = v + dt sum_(j<i) a_ij A_j,     M A_i = f(P_i, V_i, t + c_i dt)

So P_i minimises energies + 1/(2 gamma^2 dt^2) |x - target|_M^2 with target = x^ + gamma dt v^. It moves with the
velocity (x - x^)/(gamma dt), and the acceleration is (x - target)/(gamma dt)^2. This is a step problem with
c = 1/gamma^2 and velocity_origin = x^. All of them are L-stable and stiffly accurate. Those with an explicit first
stage (a_11 = 0) have stage order 2, and their first acceleration is the last one of the previous step.

    SDIRK 2 and 3      Alexander 1977, "Diagonally implicit Runge-Kutta methods for stiff O.D.E.'s"
    SDIRK 4            Hairer and Wanner, Solving Ordinary Differential Equations II, table IV.6.5
    TR-BDF2            Bank et al. 1985; as a Runge-Kutta method with its error, Hosea and Shampine 1996
    ESDIRK 3 and 4     Kennedy and Carpenter 2003, "Additive Runge-Kutta schemes for convection-diffusion-reaction
                       equations": ARK3(2)4L[2]SA and ARK4(3)6L[2]SA
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import count

import numpy as np
from springbench.solvers.model.integrators.integrator_stages import (
    Motion,
    Stage,
    StageGenerator,
    StageSolution,
    StepEnd,
)
from springbench.solvers.model.step_problem import Positions

TableauRow = tuple[float, ...]


@dataclass(frozen=True)
class RungeKutta:
    """A diagonally implicit Runge-Kutta method.

    Attributes:
        order: order of the method.
        a: rows of the tableau, of lengths 1 to s.
        embedded_weights: weights (s,) of the embedded method, if any.
        embedded_order: order of the embedded method.

    Example:
        >>> method = springbench.RungeKutta(order=1, a=((1.0,),))  # implicit Euler
        >>> method.num_stages, method.stage_times, method.inertia_factor
        (1, (1.0,), 1.0)
    """

    order: int
    a: tuple[TableauRow, ...]
    embedded_weights: TableauRow = ()
    embedded_order: int = 0

    def __post_init__(self) -> None:
        """Raise ValueError if the stages do not share one system matrix."""
        diagonal = {row[-1] for row in self.a[self.needs_start_acceleration :]}
        if len(diagonal) != 1 or [len(row) for row in self.a] != list(range(1, len(self.a) + 1)):
            raise ValueError(
                "expected a lower triangular tableau with one diagonal element, explicit first stages apart"
            )

    @cached_property
    def needs_start_acceleration(self) -> bool:
        """Whether the first stage is explicit, so that the start acceleration is needed."""
        return self.a[0] == (0.0,)

    @property
    def num_stages(self) -> int:
        """Number of implicit stages."""
        return len(self.a) - self.needs_start_acceleration

    @cached_property
    def stage_times(self) -> TableauRow:
        """Times c_i of the stages."""
        return tuple(float(sum(row)) for row in self.a)

    @property
    def stage_order(self) -> int:
        """Stage order: the largest q with A c^(k-1) = c^k / k for all k <= q."""
        A, c = np.zeros((len(self.a), len(self.a))), np.array(self.stage_times)
        for i, row in enumerate(self.a):
            A[i, : i + 1] = row
        return next(q for q in count(1) if not np.allclose(A @ c**q, c ** (q + 1) / (q + 1)))

    @property
    def velocity_factor(self) -> float:
        """Ratio 1/gamma of the velocity to the displacement of a stage, in units of 1/dt."""
        return 1.0 / self.a[-1][-1]

    @property
    def inertia_factor(self) -> float:
        """The factor c = 1/gamma^2."""
        return self.velocity_factor**2

    def iterate_stages(self, motion: Motion, acceleration: Positions | None, dt: float) -> StageGenerator:
        """Yield the stages of a step.

        The predicted acceleration of a stage is the known one that is nearest in time.

        Args:
            motion: motion at the start of the step.
            acceleration: acceleration (n, 3) [m/s^2] at the start of the step, or None.
            dt: step size [s].
        """
        v: list[Positions] = [motion.velocity] if self.needs_start_acceleration else []
        a: list[Positions] = [acceleration] if self.needs_start_acceleration and acceleration is not None else []
        h = dt * self.a[-1][-1]
        found = StageSolution(motion.positions, motion.velocity, motion.velocity)
        for row, time in zip(
            self.a[self.needs_start_acceleration :], self.stage_times[self.needs_start_acceleration :], strict=True
        ):
            origin = _weighted_sum(motion.positions, dt, row, v)
            target = origin + h * _weighted_sum(motion.velocity, dt, row, a)
            known = [(0.0, acceleration), *zip(self.stage_times, a, strict=False)]
            expected = min(known, key=lambda one: abs(time - one[0]))[1]
            found = yield Stage(time, target, origin, expected)
            v.append(found.velocity)
            a.append(found.acceleration)
        return StepEnd(Motion(found.positions, found.velocity), found.acceleration, self._embedded_error(dt, v, a))

    def _embedded_error(self, dt: float, v: Sequence[Positions], a: Sequence[Positions]) -> Motion | None:
        if not self.embedded_weights:
            return None
        weights = [b - lower for b, lower in zip(self.a[-1], self.embedded_weights, strict=True)]
        return Motion(*(_weighted_sum(np.zeros_like(v[0]), dt, weights, part) for part in (v, a)))


def _weighted_sum(x: Positions, dt: float, weights: Sequence[float], parts: Sequence[Positions]) -> Positions:
    """Return x + dt sum_j weights_j parts_j as a new array."""
    out = x.copy()
    for weight, part in zip(weights, parts, strict=False):
        if weight:
            out += dt * weight * part
    return out


def _parse_rows(*rows: str) -> tuple[TableauRow, ...]:
    """Parse tableau rows of fractions."""
    return tuple(tuple(float(Fraction(number)) for number in row.split()) for row in rows)


_SDIRK2_GAMMA = 1.0 - 0.5**0.5
_SDIRK3_GAMMA = 0.43586652150845899942
"""Root of x^3 - 3 x^2 + 3/2 x - 1/6 in (1/6, 1/2)."""

_SDIRK3_TABLEAU = (
    (_SDIRK3_GAMMA,),
    (0.5 * (1.0 - _SDIRK3_GAMMA), _SDIRK3_GAMMA),
    (
        -1.5 * _SDIRK3_GAMMA**2 + 4.0 * _SDIRK3_GAMMA - 0.25,
        1.5 * _SDIRK3_GAMMA**2 - 5.0 * _SDIRK3_GAMMA + 1.25,
        _SDIRK3_GAMMA,
    ),
)
_TR_BDF2_WEIGHT = 0.5**0.5 / 2.0

_ESDIRK3_GAMMA = "1767732205903/4055673282236"

SDIRK2 = RungeKutta(2, ((_SDIRK2_GAMMA,), (1.0 - _SDIRK2_GAMMA, _SDIRK2_GAMMA)))
SDIRK3 = RungeKutta(3, _SDIRK3_TABLEAU)
SDIRK4 = RungeKutta(
    4,
    _parse_rows(
        "1/4",
        "1/2 1/4",
        "17/50 -1/25 1/4",
        "371/1360 -137/2720 15/544 1/4",
        "25/24 -49/48 125/16 -85/12 1/4",
    ),
    *_parse_rows("59/48 -17/96 225/32 -85/12 0"),
    embedded_order=3,
)
TR_BDF2 = RungeKutta(
    2,
    ((0.0,), (_SDIRK2_GAMMA, _SDIRK2_GAMMA), (_TR_BDF2_WEIGHT, _TR_BDF2_WEIGHT, _SDIRK2_GAMMA)),
    ((1.0 - _TR_BDF2_WEIGHT) / 3.0, (3.0 * _TR_BDF2_WEIGHT + 1.0) / 3.0, _SDIRK2_GAMMA / 3.0),
    embedded_order=3,
)
ESDIRK3 = RungeKutta(
    3,
    _parse_rows(
        "0",
        f"{_ESDIRK3_GAMMA} {_ESDIRK3_GAMMA}",
        f"2746238789719/10658868560708 -640167445237/6845629431997 {_ESDIRK3_GAMMA}",
        f"1471266399579/7840856788654 -4482444167858/7529755066697 11266239266428/11593286722821 {_ESDIRK3_GAMMA}",
    ),
    *_parse_rows(
        "2756255671327/12835298489170 -10771552573575/22201958757719 9247589265047/10645013368117 "
        "2193209047091/5459859503100"
    ),
    embedded_order=2,
)
ESDIRK4 = RungeKutta(
    4,
    _parse_rows(
        "0",
        "1/4 1/4",
        "8611/62500 -1743/31250 1/4",
        "5012029/34652500 -654441/2922500 174375/388108 1/4",
        "15267082809/155376265600 -71443401/120774400 730878875/902184768 2285395/8070912 1/4",
        "82889/524892 0 15625/83664 69875/102672 -2260/8211 1/4",
    ),
    *_parse_rows("4586570599/29645900160 0 178811875/945068544 814220225/1159782912 -3700637/11593932 61727/225920"),
    embedded_order=3,
)

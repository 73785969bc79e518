"""Diagonally implicit Runge-Kutta methods with one diagonal element gamma, whose last stage is the end of the step.

    P_i = x^ + gamma dt V_i,    x^ = p + dt sum_(j<i) a_ij V_j
    V_i = v^ + gamma dt A_i,    v^ = v + dt sum_(j<i) a_ij A_j,     M A_i = f(P_i, V_i, t + c_i dt)

So P_i minimises energies + 1/(2 gamma^2 dt^2) |x - target|_M^2 with target = x^ + gamma dt v^. It moves with the
velocity (x - x^)/(gamma dt), and the acceleration is (x - target)/(gamma dt)^2. This is a step problem with
c = 1/gamma^2 and origin = x^. All of them are L-stable and stiffly accurate. Those with an explicit first
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

import numpy as np

from solvers.integrators.base import End, Motion, Solved, Unknown, Unknowns
from solvers.problem import Positions

Row = tuple[float, ...]


@dataclass(frozen=True)
class RungeKutta:
    """A diagonally implicit Runge-Kutta method.

    Attributes:
        order: order of the method.
        a: rows of the tableau, of lengths 1 to s.
        lower: weights (s,) of the embedded method, if any.
        embedded: order of the embedded method.
    """

    order: int
    a: tuple[Row, ...]
    lower: Row = ()
    embedded: int = 0

    def __post_init__(self) -> None:
        """Raise ValueError if the stages do not share one system matrix."""
        diagonal = {row[-1] for row in self.a[self.starts :]}
        if len(diagonal) != 1 or [len(row) for row in self.a] != list(range(1, len(self.a) + 1)):
            raise ValueError("wanted a lower triangular tableau with one diagonal element, explicit first stages apart")

    @cached_property
    def starts(self) -> bool:
        """Whether the first stage is explicit, so that the start acceleration is needed."""
        return self.a[0] == (0.0,)

    @property
    def unknowns(self) -> int:
        """Number of implicit stages."""
        return len(self.a) - self.starts

    @cached_property
    def times(self) -> Row:
        """Times c_i of the stages."""
        return tuple(float(sum(row)) for row in self.a)

    @property
    def speed(self) -> float:
        """Ratio 1/gamma of the velocity to the displacement of a stage, in units of 1/dt."""
        return 1.0 / self.a[-1][-1]

    @property
    def factor(self) -> float:
        """The factor c = 1/gamma^2."""
        return self.speed**2

    def step(self, now: Motion, acceleration: Positions | None, dt: float) -> Unknowns:
        """Yield the stages of a step.

        The predicted acceleration of a stage is the known one that is nearest in time.

        Args:
            now: motion at the start of the step.
            acceleration: acceleration (n, 3) [m/s^2] at the start of the step, or None.
            dt: step size [s].
        """
        v: list[Positions] = [now.velocity] if self.starts else []
        a: list[Positions] = [acceleration] if self.starts and acceleration is not None else []
        h = dt * self.a[-1][-1]
        found = Solved(now.positions, now.velocity, now.velocity)
        for row, time in zip(self.a[self.starts :], self.times[self.starts :], strict=True):
            origin = _combined(now.positions, dt, row, v)
            target = origin + h * _combined(now.velocity, dt, row, a)
            known = [(0.0, acceleration), *zip(self.times, a, strict=False)]
            expected = min(known, key=lambda one: abs(time - one[0]))[1]
            found = yield Unknown(time, target, origin, expected)
            v.append(found.velocity)
            a.append(found.acceleration)
        return End(Motion(found.positions, found.velocity), found.acceleration, self._error(dt, v, a))

    def _error(self, dt: float, v: Sequence[Positions], a: Sequence[Positions]) -> Motion | None:
        if not self.lower:
            return None
        weights = [b - lower for b, lower in zip(self.a[-1], self.lower, strict=True)]
        return Motion(*(_combined(np.zeros_like(v[0]), dt, weights, part) for part in (v, a)))


def _combined(x: Positions, dt: float, weights: Sequence[float], parts: Sequence[Positions]) -> Positions:
    """Return x + dt sum_j weights_j parts_j as a new array."""
    out = x.copy()
    for weight, part in zip(weights, parts, strict=False):
        if weight:
            out += dt * weight * part
    return out


def _rows(*rows: str) -> tuple[Row, ...]:
    """Parse tableau rows of fractions."""
    return tuple(tuple(float(Fraction(number)) for number in row.split()) for row in rows)


_TWO = 1.0 - 0.5**0.5
_THREE = 0.43586652150845899942
"""Root of x^3 - 3 x^2 + 3/2 x - 1/6 in (1/6, 1/2)."""

_ALEXANDER = (
    (_THREE,),
    (0.5 * (1.0 - _THREE), _THREE),
    (-1.5 * _THREE**2 + 4.0 * _THREE - 0.25, 1.5 * _THREE**2 - 5.0 * _THREE + 1.25, _THREE),
)
_W = 0.5**0.5 / 2.0

_KC3 = "1767732205903/4055673282236"

SDIRK2 = RungeKutta(2, ((_TWO,), (1.0 - _TWO, _TWO)))
SDIRK3 = RungeKutta(3, _ALEXANDER)
SDIRK4 = RungeKutta(
    4,
    _rows(
        "1/4",
        "1/2 1/4",
        "17/50 -1/25 1/4",
        "371/1360 -137/2720 15/544 1/4",
        "25/24 -49/48 125/16 -85/12 1/4",
    ),
    *_rows("59/48 -17/96 225/32 -85/12 0"),
    embedded=3,
)
TR_BDF2 = RungeKutta(
    2,
    ((0.0,), (_TWO, _TWO), (_W, _W, _TWO)),
    ((1.0 - _W) / 3.0, (3.0 * _W + 1.0) / 3.0, _TWO / 3.0),
    embedded=3,
)
ESDIRK3 = RungeKutta(
    3,
    _rows(
        "0",
        f"{_KC3} {_KC3}",
        f"2746238789719/10658868560708 -640167445237/6845629431997 {_KC3}",
        f"1471266399579/7840856788654 -4482444167858/7529755066697 11266239266428/11593286722821 {_KC3}",
    ),
    *_rows(
        "2756255671327/12835298489170 -10771552573575/22201958757719 9247589265047/10645013368117 "
        "2193209047091/5459859503100"
    ),
    embedded=2,
)
ESDIRK4 = RungeKutta(
    4,
    _rows(
        "0",
        "1/4 1/4",
        "8611/62500 -1743/31250 1/4",
        "5012029/34652500 -654441/2922500 174375/388108 1/4",
        "15267082809/155376265600 -71443401/120774400 730878875/902184768 2285395/8070912 1/4",
        "82889/524892 0 15625/83664 69875/102672 -2260/8211 1/4",
    ),
    *_rows("4586570599/29645900160 0 178811875/945068544 814220225/1159782912 -3700637/11593932 61727/225920"),
    embedded=3,
)

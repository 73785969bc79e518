"""Regularised Hessians, which have a Cholesky factor even if the exact Hessian is indefinite.

graded: the exact Hessian, or else the first positive definite one in a schedule of increasingly convex ones. With
active collisions the schedule is finer, and each iterate starts one level below that of the previous iterate. The
other strategies project the eigenvalues of elements (`solvers.core.eigenvalues`), whether the Hessian is
indefinite or not:

    clamp          all, lambda -> max(lambda, 0)                                     Teran et al. 2005
    absolute       all, lambda -> |lambda|                                           Chen, Liu, Levin et al. 2024
    trust-region   clamp if |rho - 1| < 0.01, else absolute, which is used first     Chen, Liu, Jacobson et al. 2024
                   rho = (g(p) - g(p + s))/-(s grad g + s H s/2) of the previous step s, H exact
    progressive    clamp, only elements at vertices with |grad g| >= tau             Fernandez-Fernandez et al. 2025

The threshold tau of `progressive` starts at infinity. It is halved if there is no factor, the first time from the
largest |grad g|, and doubled after each step. If there is still no factor (a vertex without a constraint or a spring),
multiples of a diagonal are added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from solvers.core.descent import Point, dot
from solvers.core.eigenvalues import Filtering
from solvers.core.objective import Hessian, StepObjective

SHIFTS = tuple(10.0**k for k in range(-4, 9, 2))
LEVELS = ((1.0, 0.0), (0.9, 0.0), (0.5, 0.0), (0.0, 0.0), *((0.0, by) for by in SHIFTS))
"""Pairs of the negative fraction (of the springs' transverse part) and the multiple of a diagonal; the first that has a
factor is used."""

_CLOSE = (*((keep, 0.0) for keep in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.25)), *LEVELS[3:])
"""The schedule with active collisions."""

Indefinite = Literal["graded", "clamp", "absolute", "trust-region", "progressive"]

_TRUSTED = 0.01
"""Largest deviation from 1 of the ratio of actual to predicted decrease for which eigenvalues are clamped, as in the
paper."""

_HALVINGS = 60
"""Maximum number of halvings of the threshold; then all elements are projected."""


def factorised(
    hessian: Hessian,
    diagonal: NDArray[np.float64],
    shift: NDArray[np.float64] | float = 0.0,
    levels: Sequence[tuple[float, float]] = LEVELS,
    first: int = 0,
) -> int | None:
    """Factorise the first positive definite Hessian of a schedule and return its level, or None.

    Args:
        hessian: the Hessian at a point.
        diagonal: diagonal whose multiples are added (3 f,) [N/m].
        shift: added to the diagonal at all levels [N/m].
        levels: pairs of the negative fraction and the multiple of `diagonal`.
        first: first level to try.

    Returns:
        The level; 0 is the exact Hessian; None if no level has a factor.
    """
    tried = enumerate(levels[first:], first)
    return next((k for k, (keep, by) in tried if hessian.factorise(keep, shift + by * diagonal)), None)


class Rule(Protocol):
    """The regularisation in one solve."""

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise a Hessian and return its level: 0 for the exact one, more for others, None for no factor.

        The diagonal is that of `factorised`.
        """
        ...

    def took(self, step: StepObjective, hessian: Hessian, at: Point, to: Point) -> None:
        """Record a step from a point with the given Hessian to another point."""
        ...


class Graded:
    """The smallest change of a schedule.

    It is the only rule that supports energies without an element-wise form.
    """

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise at the first level of the schedule that has a factor."""
        return factorised(hessian, diagonal)

    def took(self, step: StepObjective, hessian: Hessian, at: Point, to: Point) -> None:
        """Record nothing."""


class Close(Graded):
    """A finer schedule for active collisions, with a warm start from the level of the previous iterate.

    A compressed stack is indefinite for many iterations and becomes convex gradually; each of them would otherwise
    factorise the exact Hessian without success.
    """

    def __init__(self) -> None:
        self._level = 0

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise, starting one level below the previous one."""
        level = factorised(hessian, diagonal, levels=_CLOSE, first=max(0, self._level - 1))
        self._level = self._level if level is None else level
        return level


class Clamped(Graded):
    """Eigenvalues of all elements clamped, or replaced by their absolute values.

    Attributes:
        absolute: whether absolute values are used.
        looked, changed: numbers of elements examined and of elements projected in the solve so far.
    """

    def __init__(self, *, absolute: bool = False) -> None:
        self.absolute = absolute
        self.looked = self.changed = 0

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise the projected Hessian, with a shift if necessary."""
        return self._filtered(hessian, None, (0.0, *SHIFTS), diagonal)

    def _filtered(
        self,
        hessian: Hessian,
        among: NDArray[np.bool_] | None,
        shifts: tuple[float, ...],
        diagonal: NDArray[np.float64],
    ) -> int | None:
        """Return the level; it is 0 if no element changed and nothing was added."""
        found = hessian.filtered(Filtering(absolute=self.absolute, among=among))
        self.looked, self.changed = self.looked + found.looked, self.changed + found.changed
        first = int(found.changed > 0)
        added = (k for k, by in enumerate(shifts) if hessian.factorise_filtered(found, by * diagonal))
        return next((first + k for k in added), None)


class Trusted(Clamped):
    """Absolute eigenvalues if the quadratic model of the previous step was inaccurate, else clamped ones."""

    def __init__(self) -> None:
        super().__init__(absolute=True)

    def took(self, step: StepObjective, hessian: Hessian, at: Point, to: Point) -> None:
        """Compare the decrease in the step with the quadratic model."""
        s = to.positions - at.positions
        model = dot(at.gradient, s) + 0.5 * dot(s, hessian.multiply(s))
        rise, _ = step.rise(at.positions, to.positions)
        self.absolute = not abs(rise - model) < _TRUSTED * abs(model)


class Progressive(Clamped):
    """Eigenvalues clamped for as few elements as a factor needs, those with the largest gradient."""

    def __init__(self) -> None:
        super().__init__()
        self._threshold = np.inf

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise with the current threshold, halving it until there is a factor."""
        force = np.abs(at.gradient).max(axis=1, initial=0.0)
        for _ in range(_HALVINGS):
            level = self._filtered(hessian, force >= self._threshold, (0.0,), diagonal)
            if level is not None:
                return level
            self._threshold = 0.5 * min(self._threshold, float(force.max(initial=0.0)))
        return self._filtered(hessian, None, SHIFTS, diagonal)

    def took(self, step: StepObjective, hessian: Hessian, at: Point, to: Point) -> None:
        """Double the threshold."""
        self._threshold *= 2.0


RULES: dict[Indefinite, Callable[[], Rule]] = {
    "graded": Graded,
    "clamp": Clamped,
    "absolute": lambda: Clamped(absolute=True),
    "trust-region": Trusted,
    "progressive": Progressive,
}
"""A factory of the rule for a solve, by the name of the strategy."""

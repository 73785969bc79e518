"""A Hessian that has a Cholesky factor, where the exact one may have none.

graded: the exact Hessian, else the nearest of a few that are more and more convex; where pairs touch, of more that
differ less, and one less convex than that of the point before is tried first. The others change elements by their
eigenvalues (`solvers.core.eigenvalues`), whether the whole is indefinite or not:

    clamp          all, lambda -> max(lambda, 0)                                     Teran et al. 2005
    absolute       all, lambda -> |lambda|                                           Chen, Liu, Levin et al. 2024
    trust-region   clamp where |rho - 1| < 0.01, else absolute, which comes first    Chen, Liu, Jacobson et al. 2024
                   rho = (g(p) - g(p + s))/-(s grad g + s H s/2) of the step s before, H exact
    progressive    clamp, of elements at vertices with |grad g| >= tau alone         Fernandez-Fernandez et al. 2025

The threshold tau of `progressive` is infinite at first. Where there is no factor it is halved, at first from the
largest |grad g|, and after each step doubled. What still has no factor (a vertex that nothing holds) gets multiples of
a diagonal.
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
"""What is kept of negative lateral parts, and what multiple of a diagonal is added: the first that factorises."""

_CLOSE = (*((keep, 0.0) for keep in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.25)), *LEVELS[3:])
"""The same where pairs touch."""

Indefinite = Literal["graded", "clamp", "absolute", "trust-region", "progressive"]

_TRUSTED = 0.01
"""How near to 1 the ratio of the descent to that of the quadratic model is where eigenvalues are clamped, as in the
paper."""

_HALVINGS = 60
"""Of the threshold; then all elements are filtered."""


def factorised(
    hessian: Hessian,
    diagonal: NDArray[np.float64],
    shift: NDArray[np.float64] | float = 0.0,
    levels: Sequence[tuple[float, float]] = LEVELS,
    first: int = 0,
) -> int | None:
    """The level at which a Hessian with `shift` on its diagonal [N/m] was factorised, from the first one that is tried
    on, 0 for the exact one; None for none. diagonal: what is added multiples of, (3 f,) [N/m]."""
    tried = enumerate(levels[first:], first)
    return next((k for k, (keep, by) in tried if hessian.factorise(keep, shift + by * diagonal)), None)


class Rule(Protocol):
    """What is done in one solve."""

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """0 where the exact Hessian was factorised, more where another one was, None where none was. See `factorised`
        for diagonal."""
        ...

    def took(self, step: StepObjective, hessian: Hessian, at: Point, to: Point) -> None:
        """A step was taken from a point, whose Hessian is given, to another."""
        ...


class Graded:
    """The least change of a few. The only one that takes energies which state no elements."""

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """See Rule."""
        return factorised(hessian, diagonal)

    def took(self, step: StepObjective, hessian: Hessian, at: Point, to: Point) -> None:
        """See Rule."""


class Close(Graded):
    """Smaller changes in one solve, where pairs touch: a compressed stack is indefinite for many iterations, and gets
    convex by and by; all of them would factorise the exact Hessian in vain."""

    def __init__(self) -> None:
        self._level = 0

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """See Rule."""
        level = factorised(hessian, diagonal, levels=_CLOSE, first=max(0, self._level - 1))
        self._level = self._level if level is None else level
        return level


class Clamped(Graded):
    """Eigenvalues of all elements clamped; absolute: or turned round.

    looked, changed: how many elements were looked at in the solve so far, and how many changed.
    """

    def __init__(self, *, absolute: bool = False) -> None:
        self.absolute = absolute
        self.looked = self.changed = 0

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """See Rule."""
        return self._filtered(hessian, None, (0.0, *SHIFTS), diagonal)

    def _filtered(
        self,
        hessian: Hessian,
        among: NDArray[np.bool_] | None,
        shifts: tuple[float, ...],
        diagonal: NDArray[np.float64],
    ) -> int | None:
        """The level, 0 where no element changed and nothing was added."""
        found = hessian.filtered(Filtering(absolute=self.absolute, among=among))
        self.looked, self.changed = self.looked + found.looked, self.changed + found.changed
        first = int(found.changed > 0)
        added = (k for k, by in enumerate(shifts) if hessian.factorise_filtered(found, by * diagonal))
        return next((first + k for k in added), None)


class Trusted(Clamped):
    """Absolute eigenvalues where the quadratic model of the step before was wrong, else clamped ones."""

    def __init__(self) -> None:
        super().__init__(absolute=True)

    def took(self, step: StepObjective, hessian: Hessian, at: Point, to: Point) -> None:
        """See Rule."""
        s = to.positions - at.positions
        model = dot(at.gradient, s) + 0.5 * dot(s, hessian.multiply(s))
        rise, _ = step.rise(at.positions, to.positions)
        self.absolute = not abs(rise - model) < _TRUSTED * abs(model)


class Progressive(Clamped):
    """Eigenvalues of as few elements clamped as a factor needs, those where the gradient is largest."""

    def __init__(self) -> None:
        super().__init__()
        self._threshold = np.inf

    def factorised(self, hessian: Hessian, at: Point, diagonal: NDArray[np.float64]) -> int | None:
        """See Rule."""
        force = np.abs(at.gradient).max(axis=1, initial=0.0)
        for _ in range(_HALVINGS):
            level = self._filtered(hessian, force >= self._threshold, (0.0,), diagonal)
            if level is not None:
                return level
            self._threshold = 0.5 * min(self._threshold, float(force.max(initial=0.0)))
        return self._filtered(hessian, None, SHIFTS, diagonal)

    def took(self, step: StepObjective, hessian: Hessian, at: Point, to: Point) -> None:
        """See Rule."""
        self._threshold *= 2.0


RULES: dict[Indefinite, Callable[[], Rule]] = {
    "graded": Graded,
    "clamp": Clamped,
    "absolute": lambda: Clamped(absolute=True),
    "trust-region": Trusted,
    "progressive": Progressive,
}
"""A rule for a solve, by name."""

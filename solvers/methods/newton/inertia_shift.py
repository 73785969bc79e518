"""The multiple s of the inertia that makes a Hessian positive definite.

    H + s M/dt^2

A step along unstable modes is longer, the closer s is to the smallest value that has a factor (More and Sorensen 1983).
So a smaller s is tried after each step whose decrease agrees with the quadratic model. The ratio of the reduction is
squared if there was a factor; otherwise its square root is taken. So s approaches the smallest value in a few steps,
and then tracks it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

MODEL_DECREASE_FRACTION = 0.25
"""The quadratic model counts as accurate if a full step decreases the objective by this fraction of the linear
prediction; for a quadratic function the fraction is one half."""

_MIN_SHIFT, _SHIFT_RATIO = 0.1, 4.0
"""Smallest multiple of the inertia that is added, if any, and the initial ratio of its reduction."""

_Found = TypeVar("_Found")


class InertiaShift:
    """The shift in one solve.

    Attributes:
        value: the multiple s; infinite for a Hessian that is made positive definite by another method.
        can_reduce: whether the quadratic model was accurate in the last step, so that a smaller value is tried.
    """

    def __init__(self, value: float, max_value: float) -> None:
        """Create the state of a solve.

        Args:
            value: first multiple of the inertia; infinite to start with another modification of the Hessian.
            max_value: largest finite multiple; beyond it the value is infinite.
        """
        self.value, self.can_reduce, self._max_value, self._ratio = value, False, max_value, _SHIFT_RATIO

    def find_smallest(self, attempt: Callable[[float], _Found | None]) -> _Found | None:
        """Return the result of the first shift that has a factor, and store that shift.

        Args:
            attempt: function of a shift that returns None if there is no factor.
        """
        if self.can_reduce and self.value > 0.0:
            less = min(self.value / self._ratio, self._max_value)
            less = less if less >= _MIN_SHIFT else 0.0
            found = attempt(less)
            if found is not None:
                self.value, self._ratio = less, min(_SHIFT_RATIO, self._ratio**2)
                return found
            self._ratio = self._ratio**0.5 if self.value < np.inf else _SHIFT_RATIO
        while (found := attempt(self.value)) is None and self.value < np.inf:
            self.value, self._ratio = max(_MIN_SHIFT, _SHIFT_RATIO * self.value), _SHIFT_RATIO
            self.value = self.value if self.value <= self._max_value else np.inf
        return found

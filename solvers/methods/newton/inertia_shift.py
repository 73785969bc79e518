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
from numba.extending import register_jitable
from springbench.solvers.jit.kernel_compilation import jit_inner_options

MODEL_DECREASE_FRACTION = 0.25
"""The quadratic model counts as accurate if a full step decreases the objective by this fraction of the linear
prediction; for a quadratic function the fraction is one half."""

_MIN_SHIFT = 0.1
"""Smallest multiple of the inertia that is added, if any."""

FIRST_SHIFT_RATIO = 4.0
"""Initial ratio of a reduction of the shift, and ratio of its increases."""

_Found = TypeVar("_Found")


@register_jitable(**jit_inner_options)
def reduce_shift(value: float, ratio: float, max_value: float) -> float:
    """Return the smaller shift that is tried next.

    Args:
        value: current shift, positive.
        ratio: ratio of its reduction.
        max_value: largest finite shift.
    """
    less = min(value / ratio, max_value)
    return less if less >= _MIN_SHIFT else 0.0


@register_jitable(**jit_inner_options)
def increase_shift(value: float, max_value: float) -> float:
    """Return the larger shift after one that has no factor.

    It is infinite beyond the largest finite one.

    Args:
        value: current shift.
        max_value: largest finite shift.
    """
    more = max(_MIN_SHIFT, FIRST_SHIFT_RATIO * value)
    return more if more <= max_value else np.inf


@register_jitable(**jit_inner_options)
def adapt_shift_ratio(value: float, ratio: float, has_factor: bool) -> float:
    """Return the ratio of the next reduction.

    Args:
        value: shift before a reduction.
        ratio: ratio of that reduction.
        has_factor: whether the smaller shift had a factor.
    """
    if has_factor:
        return min(FIRST_SHIFT_RATIO, ratio**2)
    return ratio**0.5 if value < np.inf else FIRST_SHIFT_RATIO


class InertiaShift:
    """The shift in one solve.

    Attributes:
        value: the multiple s; infinite for a Hessian that is made positive definite by another method.
        max_value: largest finite multiple.
        ratio: ratio of the next reduction.
        can_reduce: whether the quadratic model was accurate in the last step, so that a smaller value is tried.
    """

    def __init__(self, value: float, max_value: float) -> None:
        """Create the state of a solve.

        Args:
            value: first multiple of the inertia; infinite to start with another modification of the Hessian.
            max_value: largest finite multiple; beyond it the value is infinite.
        """
        self.value, self.can_reduce, self.max_value, self.ratio = value, False, max_value, FIRST_SHIFT_RATIO

    def find_smallest(self, attempt: Callable[[float], _Found | None]) -> _Found | None:
        """Return the result of the first shift that has a factor, and store that shift.

        Args:
            attempt: function of a shift that returns None if there is no factor.
        """
        if self.can_reduce and self.value > 0.0:
            less = reduce_shift(self.value, self.ratio, self.max_value)
            found = attempt(less)
            self.ratio = adapt_shift_ratio(self.value, self.ratio, found is not None)
            if found is not None:
                self.value = less
                return found
        while (found := attempt(self.value)) is None and self.value < np.inf:
            self.value, self.ratio = increase_shift(self.value, self.max_value), FIRST_SHIFT_RATIO
        return found

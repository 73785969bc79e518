"""Derivatives along a direction d from values alone, with bounds on the round-off.

    f'(x).d  = Im f(x + i h d) / h                               complex step (Squire and Trapp 1998): no cancellation
    d'f''(x) d = (f'(x + s d).d - f'(x - s d).d) / (2 s)         in extended precision, where the machine has it

The bounds apply to both implementations. Values are those of elements, f = sum_e f_e, so that sums of absolute values
measure the magnitude of what was summed. A coordinate of magnitude X has the error eps X. Let l be the smallest length
that the terms depend on. An error of eps X changes a term by the fraction eps X / l, and by eps X times its next
derivative:

    |error of f|   <= C eps ((1 + X/l) sum |f_e|   + X sum |f_e'|)
    |error of f'|  <= C eps ((1 + X/l) sum |f_e'|  + X sum |f_e''|)
    |error of f''| <= C eps ((1 + X/l) sum |f_e''| + X sum |f_e'''|) + |difference of the one-sided differences|
                      + |error of f'| e/(eps s), e the eps of extended precision

The difference of the one-sided differences is s f'''. It is large where the energy has a kink (a limit, a contact)
within s; there f'' is meaningless.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

ExtendedArray = NDArray[Any]
"""Extended precision (`numpy.longdouble`), real or complex; shapes are stated where it is used."""
ValueFunction = Callable[[ExtendedArray], ExtendedArray]
"""Maps positions (n, 3) [m], real or complex, to the energies (e,) [J] of elements."""

EPS = float(np.finfo(float).eps)
ROUNDOFF_MULTIPLE = 200.0
"""C: number of roundings in an element's energy, with a margin for sums of thousands of elements."""
_COMPLEX_STEP = np.longdouble(1e-100)
_DIFFERENCE_STEP = 1e-6
"""s, relative to the smallest length."""


def to_extended(x: Any) -> ExtendedArray:
    """Convert to an array in extended precision."""
    return np.asarray(x, np.longdouble)


def row_norms(v: ExtendedArray) -> ExtendedArray:
    """Return the norms (m,) of rows (m, 3), analytic for complex rows."""
    return np.sqrt((v * v).sum(axis=1))


class DirectionalDerivatives(NamedTuple):
    """Value [J] and derivatives [N] and [N/m] along a direction, and the tolerance of each."""

    value: float
    slope: float
    curvature: float
    tolerances: tuple[float, float, float]


def differentiate_along(
    values: ValueFunction, x: ExtendedArray, d: ExtendedArray, coordinate_scale: float, min_length: float
) -> DirectionalDerivatives:
    """Differentiate an energy at x along d.

    Args:
      values: energies of the elements.
      x: positions (n, 3) [m].
      d: direction (n, 3).
      coordinate_scale: X [m].
      min_length: l [m].
    """

    def slopes(at: ExtendedArray) -> ExtendedArray:
        return np.imag(values(at + 1j * _COMPLEX_STEP * d)) / _COMPLEX_STEP

    s = np.longdouble(_DIFFERENCE_STEP * min_length)
    here, first, ahead, behind = values(x), slopes(x), slopes(x + s * d), slopes(x - s * d)
    second = (ahead - behind) / (2 * s)
    corner = float(np.abs(ahead - 2 * first + behind).sum() / s)
    sums = [float(np.abs(part).sum()) for part in (here, first, second)]
    sums.append(corner / float(s))
    tolerances = [
        ROUNDOFF_MULTIPLE * EPS * ((1.0 + coordinate_scale / min_length) * sums[k] + coordinate_scale * sums[k + 1])
        for k in range(3)
    ]
    tolerances[2] += corner + tolerances[1] / EPS * float(np.finfo(np.longdouble).eps / s)
    return DirectionalDerivatives(
        float(here.sum()), float(first.sum()), float(second.sum()), (tolerances[0], tolerances[1], tolerances[2])
    )

"""Derivatives along a direction d from values alone, and what round-off makes of both opinions.

    f'(x).d  = Im f(x + i h d) / h                               complex step (Squire and Trapp 1998): no cancellation
    d'f''(x) d = (f'(x + s d).d - f'(x - s d).d) / (2 s)         in extended precision, where the machine has it

Values are those of elements, f = sum_e f_e, so that the sums of absolute values tell what was added up. A coordinate of
the size X is known to eps X; with l the shortest length that the terms go by, an error of eps X is worth the fraction
eps X / l of any term, and one derivative more of each:

    |error of f|   <= C eps ((1 + X/l) sum |f_e|   + X sum |f_e'|)
    |error of f'|  <= C eps ((1 + X/l) sum |f_e'|  + X sum |f_e''|)
    |error of f''| <= C eps ((1 + X/l) sum |f_e''| + X sum |f_e'''|) + |what both sides' differences differ by|
                      + |error of f'| e/(eps s), e the eps of extended precision

The last difference is s f''', and large where a corner of the energy (a limit, a contact) lies within s: there f''
means nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Wide = NDArray[Any]
"""Extended precision (`numpy.longdouble`), real or complex; shapes as stated where it is used."""
Values = Callable[[Wide], Wide]
"""Positions (n, 3) [m], real or complex, to the energies (e,) [J] of elements."""

EPS = float(np.finfo(float).eps)
ROUNDINGS = 200.0
"""C: how many roundings an element's energy passes, with room for sums of thousands of them."""
_TINY = np.longdouble(1e-100)
_STEP = 1e-6
"""s, of the shortest length."""


def wide(x: Any) -> Wide:
    """An array in extended precision."""
    return np.asarray(x, np.longdouble)


def length(v: Wide) -> Wide:
    """|v| of each row (m, 3), (m,), as an analytic function of complex rows."""
    return np.sqrt((v * v).sum(axis=1))


class Told(NamedTuple):
    """The value [J], the derivatives [N] and [N/m] along a direction, and how far off each may be."""

    value: float
    slope: float
    bend: float
    allowed: tuple[float, float, float]


def tell(values: Values, x: Wide, d: Wide, reach: float, shortest: float) -> Told:
    """What an energy is at x along d, both (n, 3); reach: X [m]; shortest: l [m]."""

    def slopes(at: Wide) -> Wide:
        return np.imag(values(at + 1j * _TINY * d)) / _TINY

    s = np.longdouble(_STEP * shortest)
    here, first, ahead, behind = values(x), slopes(x), slopes(x + s * d), slopes(x - s * d)
    second = (ahead - behind) / (2 * s)
    corner = float(np.abs(ahead - 2 * first + behind).sum() / s)
    sums = [float(np.abs(part).sum()) for part in (here, first, second)]
    sums.append(corner / float(s))
    room = [ROUNDINGS * EPS * ((1.0 + reach / shortest) * sums[k] + reach * sums[k + 1]) for k in range(3)]
    room[2] += corner + room[1] / EPS * float(np.finfo(np.longdouble).eps / s)
    return Told(float(here.sum()), float(first.sum()), float(second.sum()), (room[0], room[1], room[2]))

"""Bytes that kernels on a device must move: of each launch each array that it reads or writes, once.

By n rows, f of them free, m edges, E entries of them, and s bytes of a number of the kernels' type. What is small, read
by few rows or counted per warp is left out, and so is what a cache does not hold: it is what must move, no more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from solvers.core.explicit_tables import Composition, Tableau


class Sizes(NamedTuple):
    """n, f, E, m and s."""

    rows: int
    free: int
    entries: int
    edges: int
    size: int


def kicks(of: Sizes, method: Composition, count: int, *, drags: bool) -> float:
    """A frame of `count` steps of a composition.

    A kick: 20 E for entries (other, stiffness, rest), 24 n for p and 24 n for q, and of a free row v read and written,
    its force, what holds it and 1/m, 88 f, with drag what is kept and gained as well, 16 f; the last of a step and the
    first of the next one are one launch where no drift is between them. A drift before the first: 72 f.
    """
    n, f, entries, *_ = of
    joined = method.drifts[0] == method.drifts[-1] == 0.0
    launches = count * len(method.kicks) - (count - 1) * joined
    kick = 20.0 * entries + 48.0 * n + 88.0 * f + 16.0 * f * drags
    return launches * kick + (0.0 if method.drifts[0] == 0.0 else 72.0 * f * count)


def stages(of: Sizes, method: Tableau, *, chosen: bool) -> float:
    """A Runge-Kutta step of s stages after the first; chosen: whether by its error.

    A stage: p read and q written, 48 n, v read and its own written, 48 f, and velocities and accelerations of each that
    it is made of, 48 f; its forces: 20 E, 24 n for q, and hold, force, 1/m, drag, velocity and acceleration, 96 f. An
    error: all velocities and accelerations, 48 f each. Its end: q read and p written, 48 n, and of v, of the last stage
    and of the next one's first, 120 f.
    """
    n, f, entries, *_ = of
    made_of = np.count_nonzero(method.a[1:])
    later = len(method.a) - 1
    one = later * (20.0 * entries + 72.0 * n + 144.0 * f) + 48.0 * f * made_of
    estimates = len(method.errors) if chosen else 0
    return one + 48.0 * f * len(method.a) * estimates + 48.0 * n + 120.0 * f

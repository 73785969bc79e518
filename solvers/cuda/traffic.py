"""Bytes that kernels on a device must move: of each launch each array that it reads or writes, once.

By n rows, f of them free, m edges, E entries of them, and s bytes of a number of the kernels' type. What is small, read
by few rows or counted per warp is left out, and so is what a cache does not hold: it is what must move, no more. Of an
iteration whose work depends on the point it is the least: one trial, one turn of conjugate gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from solvers.core.explicit_tables import Composition, Tableau
from solvers.cuda.schwarz_kernels import packed
from solvers.linear import schwarz


class Sizes(NamedTuple):
    """n, f, E, m and s."""

    rows: int
    free: int
    entries: int
    edges: int
    size: int


class Preconditioned(NamedTuple):
    """Of a preconditioner: where the Hessian is linearised, and where it is applied."""

    linearised: float
    applied: float


def jacobi(of: Sizes) -> Preconditioned:
    """Blocks are written where the Hessian is; to apply them: they, r and z, 12 s f."""
    return Preconditioned(0.0, 12.0 * of.size * of.free)


def patches(of: Sizes, levels: Sequence[tuple[int, int, int]]) -> Preconditioned:
    """Of additive Schwarz, of whose levels each has N nodes, m_l edges and P patches, h numbers in half of one.

    Linearised: edges and p read, 24 m + 24 n, and of each level b written and read, 96 m_l, and s h P written.
    Applied: those, r and z, s (h P + 6 N), r gathered for the next level, 3 s N, and r'z, 6 s f.
    """
    half, size = packed(schwarz.PATCH) * of.size, of.size
    linearised = 24.0 * (of.edges + of.rows) + sum(96.0 * edges + half * there for _, edges, there in levels)
    gathered = sum(3.0 * size * nodes for nodes, _, _ in levels[1:])
    applied = sum(half * there + 6.0 * size * nodes for nodes, _, there in levels) + gathered
    return Preconditioned(linearised, applied + 6.0 * size * of.free)


def _trial(of: Sizes) -> float:
    """p, d and g read and q written, (72 + 3 s) f; the rise: p and q, 48 n, what holds rows, 56 f, and edges, 24 m."""
    return (72.0 + 3 * of.size) * of.free + 48.0 * of.rows + 56.0 * of.free + 24.0 * of.edges


def gradient(of: Sizes) -> float:
    """Entries (other, stiffness, rest), 20 E, p, 24 n, and hold, centre and force read and g written, 80 f."""
    return 20.0 * of.entries + 24.0 * of.rows + 80.0 * of.free


def _multiply(of: Sizes) -> float:
    """H x: entries, (4 + 4 s) E, hold, x and H x, (8 + 6 s) f."""
    return (4.0 + 4 * of.size) * of.entries + (8.0 + 6 * of.size) * of.free


def _dotted(of: Sizes) -> float:
    """g'd: (24 + 3 s) f."""
    return (24.0 + 3 * of.size) * of.free


def _arrived(of: Sizes, by: Preconditioned) -> float:
    """To a trial, its gradient, and the Hessian there: entries and p, 20 E + 24 n, hold and its least, 16 f, what
    multiplies written, 4 s E, and blocks, 6 s f; then -g rounded, (24 + 3 s) f, and preconditioned."""
    linearised = (20.0 + 4 * of.size) * of.entries + 24.0 * of.rows + (16.0 + 6 * of.size) * of.free
    return _trial(of) + gradient(of) + linearised + sum(by) + (24.0 + 3 * of.size) * of.free


def newton(of: Sizes, by: Preconditioned) -> float:
    """An iteration of Newton's method with one turn of conjugate gradients, of which each further one takes as much: a
    direction, 9 s f, its product, d and r, 18 s f, and the preconditioner."""
    return _arrived(of, by) + 27.0 * of.size * of.free + _multiply(of) + by.applied


def nonlinear(of: Sizes, by: Preconditioned) -> float:
    """An iteration of nonlinear conjugate gradients: two directions, 6 s f and 9 s f, each with its slope and its
    product, and the scalar products of the next one, (48 + 9 s) f."""
    directions = 15.0 * of.size * of.free + 2.0 * (_dotted(of) + _multiply(of))
    return _arrived(of, by) + directions + (48.0 + 9 * of.size) * of.free


def limited(of: Sizes, product: float, pairs: int) -> float:
    """An iteration of L-BFGS with so many pairs: Q^-1, or what is in its place, times the new gradient, `product` and
    (24 + 3 s) f; a direction, (6 + 6 pairs) s f; a trial with its gradient and slope; the new pair, (96 + 12 s) f, and
    products with all of them, (24 + 6 pairs s) f."""
    f, size = of.free, of.size
    pair = (96.0 + 12 * size) * f + (24.0 + 6 * pairs * size) * f
    inverse = product + (24.0 + 3 * size) * f
    return inverse + (6.0 + 6 * pairs) * size * f + _trial(of) + gradient(of) + _dotted(of) + pair


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

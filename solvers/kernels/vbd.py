"""Vertex block descent, compiled: one vertex after another goes to a lower energy, all others at rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.energies.springs import TINY, Springs
from solvers.kernels.compiling import inner, kernel

_TINY_SQUARED = TINY * TINY
_ROUND_OFF = 1e-14
"""Pivots up to this share of the diagonal's sum are round-off, of some ten springs."""


class Blocks(NamedTuple):
    """The vertices that move, in the order in which they do, and the springs at each.

    vertex (f,); start (f + 1,): the first entry of each; of each entry the other end (neighbour), k [N/m], r [m] and
    the spring, ~spring at its second end; held (f,) [N/m]: by inertia and pins; majorant (f,) [N/m]: that and all k;
    direction (m, 3): taken at zero length.
    """

    vertex: NDArray[np.int64]
    start: NDArray[np.int64]
    neighbour: NDArray[np.int32]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    spring: NDArray[np.int32]
    held: NDArray[np.float64]
    majorant: NDArray[np.float64]
    direction: NDArray[np.float64]

    @classmethod
    def of(cls, springs: Springs, order: NDArray[np.int64], held: NDArray[np.float64]) -> Blocks:
        """The blocks of the vertices `order` (f,); held: of all vertices. Self-loops stretch nothing: left out."""
        place = np.full(len(held), len(order))
        place[order] = np.arange(len(order))
        keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])
        ends = springs.edges[keep]
        here, there, spring = ends.T.ravel(), ends[:, ::-1].T.ravel(), np.concatenate([keep, ~keep])
        at = np.argsort(place[here], kind="stable")
        at = at[: np.searchsorted(place[here[at]], len(order))]
        here, there, spring = place[here[at]], there[at], spring[at]
        k, r = (values[np.maximum(spring, ~spring)] for values in (springs.stiffness, springs.rest_length))
        return cls(
            order,
            np.searchsorted(here, np.arange(len(order) + 1)),
            there.astype(np.int32),
            k,
            r,
            spring.astype(np.int32),
            held[order],
            held[order] + np.bincount(here, k, len(order)),
            np.array(springs.rest_direction, order="C"),
        )


@inner
def _newton(a, b, c, d, e, f, g0, g1, g2):
    """-B^-1 g for B = [[a, b, c], [b, d, e], [c, e, f]] by its factors L D L', and whether B is positive definite."""
    least = _ROUND_OFF * (a + d + f)
    if not a > least:
        return 0.0, 0.0, 0.0, False
    l1, l2 = b / a, c / a
    second = d - l1 * b
    if not second > least:
        return 0.0, 0.0, 0.0, False
    l3 = (e - l2 * b) / second
    third = f - l2 * c - l3 * l3 * second
    if not third > least:
        return 0.0, 0.0, 0.0, False
    y1 = g1 - l1 * g0
    x2 = -(g2 - l2 * g0 - l3 * y1) / third
    x1 = -y1 / second - l3 * x2
    return -g0 / a - l1 * x1 - l2 * x2, x1, x2, True


@inner
def _change(blocks, block, near, d0, d1, d2, linear):
    """By how much the energy changes [J] if the vertex moves by d, from differences of lengths, which do not cancel.

    linear: d times the gradient of what holds the vertex; near: v, its length and r of each spring.
    """
    squared = d0 * d0 + d1 * d1 + d2 * d2
    total = linear + 0.5 * blocks.held[block] * squared
    begin = blocks.start[block]
    for k in range(blocks.start[block + 1] - begin):
        w0, w1, w2, before = near[4 * k] + d0, near[4 * k + 1] + d1, near[4 * k + 2] + d2, near[4 * k + 3]
        after = np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
        along = (near[4 * k] + w0) * d0 + (near[4 * k + 1] + w1) * d1 + (near[4 * k + 2] + w2) * d2
        both = before + after
        if both > 0.0:
            total += blocks.stiffness[begin + k] * along * (0.5 - blocks.rest_length[begin + k] / both)
    return total


@inner
def _descend(blocks, block, y, p, near):
    """Move a vertex to a lower energy."""
    i, held = blocks.vertex[block], blocks.held[block]
    x0, x1, x2 = p[i, 0], p[i, 1], p[i, 2]
    h0, h1, h2 = held * x0 - y[i, 0], held * x1 - y[i, 1], held * x2 - y[i, 2]
    g0, g1, g2 = h0, h1, h2
    a, b, c, d, e, f = held, 0.0, 0.0, held, 0.0, held
    begin, end = blocks.start[block], blocks.start[block + 1]
    for entry in range(begin, end):
        j, k, r = blocks.neighbour[entry], blocks.stiffness[entry], blocks.rest_length[entry]
        v0, v1, v2 = x0 - p[j, 0], x1 - p[j, 1], x2 - p[j, 2]
        squared = v0 * v0 + v1 * v1 + v2 * v2
        length = np.sqrt(squared)
        at = 4 * (entry - begin)
        near[at], near[at + 1], near[at + 2], near[at + 3] = v0, v1, v2, length
        if squared <= _TINY_SQUARED:
            name = blocks.spring[entry]
            sign = 1.0 if name >= 0 else -1.0
            n0, n1, n2 = blocks.direction[max(name, ~name)]
            n0, n1, n2, stretch, ratio = sign * n0, sign * n1, sign * n2, -r, 1.0 if r > 0.0 else 0.0
        else:
            scale = 1.0 / length
            n0, n1, n2, stretch, ratio = scale * v0, scale * v1, scale * v2, length - r, r * scale
        tension = k * stretch
        g0, g1, g2 = g0 + tension * n0, g1 + tension * n1, g2 + tension * n2
        lateral = k * max(0.0, 1.0 - ratio)
        axial = k - lateral
        a, d, f = a + lateral + axial * n0 * n0, d + lateral + axial * n1 * n1, f + lateral + axial * n2 * n2
        b, c, e = b + axial * n0 * n1, c + axial * n0 * n2, e + axial * n1 * n2
    d0, d1, d2, definite = _newton(a, b, c, d, e, f, g0, g1, g2)
    if not definite or not _change(blocks, block, near, d0, d1, d2, d0 * h0 + d1 * h1 + d2 * h2) <= 0.0:
        scale = -1.0 / blocks.majorant[block]
        d0, d1, d2 = scale * g0, scale * g1, scale * g2
    p[i, 0], p[i, 1], p[i, 2] = x0 + d0, x1 + d1, x2 + d2


@inner
def _rise(springs, held, y, p, q):
    """By how much the energy rises [J] from p to q, from differences, which do not cancel."""
    total = 0.0
    for i in range(len(held)):
        for c in range(3):
            d = q[i, c] - p[i, c]
            total += d * (held[i] * (p[i, c] + 0.5 * d) - y[i, c])
    for e in range(len(springs.stiffness)):
        i, j = springs.ends[e]
        v0, v1, v2 = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        w0, w1, w2 = q[i, 0] - q[j, 0], q[i, 1] - q[j, 1], q[i, 2] - q[j, 2]
        both = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2) + np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
        if both > 0.0:
            along = (v0 + w0) * (w0 - v0) + (v1 + w1) * (w1 - v1) + (v2 + w2) * (w2 - v2)
            total += springs.stiffness[e] * along * (0.5 - springs.rest_length[e] / both)
    return total


@inner
def _copy(p, out):
    for i in range(len(p)):
        for c in range(3):
            out[i, c] = p[i, c]


@kernel
def iterate(blocks, springs, held, y, near, radius, omega, before, older, p, iterations):
    """That many sweeps over all vertices from p (n, 3) [m], which takes the result.

    springs: the same as in `blocks`; held (n,) [N/m], 0 at exact pins; y (n, 3) [N]; near: scratch, four numbers for
    each spring of a vertex; radius: of Chebyshev's extrapolation, 0 for none; omega (1,): its factor, 0 where a step
    begins; before: scratch; older: the positions before the last sweep, p where a step begins. An extrapolation that
    raises the energy is not taken, and they begin again.
    """
    for _ in range(iterations):
        _copy(p, before)
        for block in range(len(blocks.vertex)):
            _descend(blocks, block, y, p, near)
        if radius == 0.0:
            continue
        w = (
            4.0 / (4.0 - radius**2 * omega[0])
            if omega[0] > 1.0
            else 2.0 / (2.0 - radius**2)
            if omega[0] == 1.0
            else 1.0
        )
        omega[0] = w
        for i in range(len(p)):
            for c in range(3):
                older[i, c] += w * (p[i, c] - older[i, c])
        if w > 1.0 and _rise(springs, held, y, before, older) <= 0.0:
            _copy(older, p)
        elif w > 1.0:
            omega[0] = 0.0
        _copy(before, older)

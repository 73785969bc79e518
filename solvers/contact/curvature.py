"""Hessian of the barrier potential in closed form.

With z = sum_i c_i x_i, the directions w_a in which c changes with each free local coordinate
(`contact.geometry.distance`), and D = |z|^2/2,

    D'' = c c' (x) I - B G^-1 B',     B_ia = c_i z_a + w_ia z,     z_a = sum_i w_ia x_i,     G_ab = z_a z_b

so that f(d)'' = f'' g g' + f'/d (c c' (x) (I - n n') - B G^-1 B'). f' is negative, so that only the first term in the
bracket has negative curvature. `keep` is the fraction of the negative curvature that is included. With 1
the blocks are exact; with 0 they are positive semidefinite and never less than the exact ones. A collision of k
vertices has a block of 3 k rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.barrier import law, length, pushing
from solvers.contact.blocks import NUMBERS, Blocks, Room, add_at, row
from solvers.contact.contacts import EDGES, POINT_EDGE, POINT_TRIANGLE, Contacts
from solvers.contact.grip import Grip
from solvers.contact.mollifier import add_turning, bending, crossed, mollifier
from solvers.vectors.eights import loaded, stored

Array = NDArray[np.float64]

_WORK, _SPARE = 16, 8
"""Length of a scratch row, two vectors; number of entries written beyond the end of a block."""

_G, _DC, _FIRST, _SECOND = range(4)
"""Rows of the scratch array, by content."""


def curvature(contacts: Contacts, grip: Grip, p: Array, n: int, keep: float, room: Room) -> Blocks:
    """Build the Hessian blocks of collisions and of friction.

    Args:
        contacts: active collisions.
        grip: friction.
        p: positions (N, 3) [m] of all vertices.
        n: number of vertices that move.
        keep: fraction of the negative curvature to include.
        room: memory of the blocks.

    Returns:
        Blocks [N/m].
    """
    width = np.minimum(contacts.kind, 4)
    starts = np.concatenate([[0], np.cumsum(9 * width * (width + 1) // 2)])
    packed = room.take(int(starts[-1]) + _SPARE)
    curve(contacts, p, keep, starts, np.zeros((4, _WORK)), packed)
    blocks = Blocks(contacts.vertices, starts, packed)
    if len(grip.vertices):
        blocks = blocks.followed(grip.blocks(p))
    return blocks._replace(vertices=coupled(contacts, grip, n))


def coupled(contacts: Contacts, grip: Grip, n: int) -> NDArray[np.int64]:
    """Return the block vertices (a, 4) of collisions and friction.

    Missing vertices, and those beyond the first n, are -1.
    """
    met = np.where(np.arange(4) < contacts.kind[:, None], contacts.vertices, -1)
    return moving(met, grip, n)


def moving(met: NDArray[np.int64], grip: Grip, n: int) -> NDArray[np.int64]:
    """Return vertices (a, 4) followed by those of friction; -1 for those beyond the first n."""
    both = np.concatenate([met, grip.vertices])
    return np.where(both < n, both, -1)


def add_curvature(
    contacts: Contacts, grip: Grip, p: Array, keep: float, places: NDArray[np.int64], values: Array
) -> None:
    """Add the Hessian [N/m] of collisions and friction to existing 3x3 blocks.

    Args:
        contacts: active collisions.
        grip: friction.
        p: positions (N, 3) [m] of all vertices.
        keep: fraction of the negative curvature to include.
        places: target block of each vertex pair, (a, 16); -1 for none.
        values: blocks (b, 3, 3) [N/m], updated.
    """
    many = len(contacts.vertices)
    enter(contacts, p, keep, places[:many], np.zeros((4, _WORK)), np.empty(NUMBERS + _SPARE), values)
    if len(grip.vertices):
        grip.blocks(p).add(places[many:], values)


@kernel
def curve(contacts, p, keep, starts, work, out):
    """Write the Hessian block of each collision at p (n, 3) to `out`.

    starts: first entry of each block; scratch (4, 16): zero initially.
    """
    for k in range(len(contacts.vertices)):
        _curve(contacts, k, p, keep, work, out[starts[k] :])


@kernel
def enter(contacts, p, keep, places, work, block, values):
    """Add the Hessian block of each collision at p (n, 3) to `values`.

    Args:
        contacts: active collisions.
        p: positions (n, 3) [m].
        keep: fraction of the negative curvature to include.
        places: target block of each vertex pair, (a, 16); -1 for none.
        work: (4, 16), zero initially.
        block: scratch (98,).
        values: blocks (b, 3, 3) [N/m], updated.
    """
    for k in range(len(contacts.vertices)):
        many = min(contacts.kind[k], 4)
        _curve(contacts, k, p, keep, work, block)
        add_at(block[: 9 * many * (many + 1) // 2], places[k], values)


class Terms(NamedTuple):
    """Weights of the terms of a Hessian block.

    With m = grad |u x v|^2 of edges and the G-orthogonal columns b1, b2 of B, the block is

    normal g g' + mixed (g m' + m g') + bent m m' - lag b1 b1' - hold b2 b2'
    + isotropic c c' (x) I, and turn, that of the rotation of edges (`contact.potentials.mollifier`).
    """

    along: float
    mixed: float
    bent: float
    lag: float
    hold: float
    side: float
    turn: float


@inner
def terms(contacts, k, p, keep, work):
    """Return the Hessian weights of collision k at p (n, 3).

    The vectors g, m, b1 and b2 are written to the rows of scratch, of 12 numbers or more.
    """
    x, kind = contacts.vertices[k], contacts.kind[k]
    many = min(kind, 4)
    z0, z1, z2 = contacts.between[k, 0], contacts.between[k, 1], contacts.between[k, 2]
    d, gap = length(contacts, k)
    d = max(d, 1e-300)
    c, g, dc, first, second = contacts.weights[k], work[_G], work[_DC], work[_FIRST], work[_SECOND]
    b, b1, b2 = law(pushing(gap))
    r, m, m1, m2 = contacts.scale[k] * contacts.reach, 1.0, 0.0, 0.0
    f, f1, f2 = contacts.stiffness[k] * r * r * b, contacts.stiffness[k] * r * b1, contacts.stiffness[k] * b2
    if contacts.parallel[k] > 0.0:
        m, m1, m2 = mollifier(crossed(p, x).c, contacts.parallel[k])
    across = f1 / d
    lag, hold = _rows(p, x, kind, c, z0, z1, z2, first, second)
    n0, n1, n2 = z0 / d, z1 / d, z2 / d
    for i in range(many):
        g[3 * i], g[3 * i + 1], g[3 * i + 2] = c[i] * n0, c[i] * n1, c[i] * n2
    along, side = m * (f2 - keep * across), keep * m * across
    lag, hold = m * across * lag, m * across * hold
    mixed, bent = 0.0, 0.0
    if m1 != 0.0:
        mixed, bent, share = bending(crossed(p, x), (m, m1, m2), (f, f1, f2), keep, dc)
        along += share
    else:
        dc[:] = 0.0
    if lag == 0.0:
        first[:] = 0.0
    if hold == 0.0:
        second[:] = 0.0
    return Terms(along, mixed, bent, lag, hold, side, 2.0 * f * m1)


@inner
def weighed(terms, work, r):
    """Return the factors of g, m, b1 and b2 in row r of the block."""
    g, dc = work[_G, r], work[_DC, r]
    lag, hold = terms.lag * work[_FIRST, r], terms.hold * work[_SECOND, r]
    return terms.along * g + terms.mixed * dc, terms.mixed * g + terms.bent * dc, lag, hold


@inner
def summed(weights, g, dc, first, second):
    """Return one entry of the row, or a packet of eight consecutive ones."""
    along, mixed, lag, hold = weights
    return (along * g + mixed * dc) - (lag * first + hold * second)


@inner
def _curve(contacts, k, p, keep, work, H):
    found, c, many = terms(contacts, k, p, keep, work), contacts.weights[k], min(contacts.kind[k], 4)
    g_low, dc_low = loaded(work, _G * _WORK), loaded(work, _DC * _WORK)
    g_high, dc_high = loaded(work, _G * _WORK + 8), loaded(work, _DC * _WORK + 8)
    first_low, second_low = loaded(work, _FIRST * _WORK), loaded(work, _SECOND * _WORK)
    first_high, second_high = loaded(work, _FIRST * _WORK + 8), loaded(work, _SECOND * _WORK + 8)
    for i in range(many):
        for a in range(3):
            at, r = row(i, a), 3 * i + a
            # Entries written beyond the row's end are overwritten by the rows that follow.
            weights = weighed(found, work, r)
            stored(summed(weights, g_low, dc_low, first_low, second_low), H, at)
            if i > 1:
                stored(summed(weights, g_high, dc_high, first_high, second_high), H, at + 8)
            if found.side != 0.0:
                for j in range(i + 1):
                    H[at + 3 * j + a] += found.side * c[i] * c[j]
    if found.turn != 0.0:
        add_turning(crossed(p, contacts.vertices[k]), found.turn, keep, H)


@inner
def _rows(p, x, kind, c, z0, z1, z2, first, second):
    """Write the columns of B, orthogonalised by G, and return the weights of their squares in B G^-1 B'."""
    around = kind in (POINT_EDGE, POINT_TRIANGLE)
    if around:
        one, two = (1, 2), (1, 3)
    else:
        one, two = (1, 0), (2, 3)
    firstly = around or (kind == EDGES and c[0] != 0.0 and c[1] != 0.0)
    secondly = kind == POINT_TRIANGLE or (kind == EDGES and c[2] != 0.0 and c[3] != 0.0)
    if not firstly:
        if not secondly:
            return 0.0, 0.0
        one, secondly = two, False
    a0, a1, a2 = _way(p, x, one, c, z0, z1, z2, first)
    size = a0 * a0 + a1 * a1 + a2 * a2
    if not secondly:
        return 1.0 / size, 0.0
    b0, b1, b2 = _way(p, x, two, c, z0, z1, z2, second)
    mixed = (a0 * b0 + a1 * b1 + a2 * b2) / size
    n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    for i in range(12):
        second[i] -= mixed * first[i]
    return 1.0 / size, size / (n0 * n0 + n1 * n1 + n2 * n2)


@inner
def _way(p, x, ends, c, z0, z1, z2, out):
    """Write the column of B (12,) where c moves from the second of two ends to the first; return z_a."""
    i, j = ends
    a0, a1, a2 = p[x[i], 0] - p[x[j], 0], p[x[i], 1] - p[x[j], 1], p[x[i], 2] - p[x[j], 2]
    for k in range(4):
        out[3 * k], out[3 * k + 1], out[3 * k + 2] = c[k] * a0, c[k] * a1, c[k] * a2
    for end, w in ((i, 1.0), (j, -1.0)):
        out[3 * end] += w * z0
        out[3 * end + 1] += w * z1
        out[3 * end + 2] += w * z2
    return a0, a1, a2

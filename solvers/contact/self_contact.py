"""Contact of a mesh with itself: an energy of positions alone (`solvers.contact.barrier`), and the largest safe step.

Which pairs may be near is looked up for a point, and kept for as long as the vertices stay close to it (their common
motion apart). What is kept changes no bit of what is computed: pairs out of range add nothing, and all others come in
one order. Steps are bounded by what they may meet on the way (`solvers.contact.ways`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from solvers.contact import barrier, ways
from solvers.contact.barrier import Pairs
from solvers.contact.surface import Surface
from solvers.problem import Positions

Array = NDArray[np.float64]

_ROUND = 8.0 * np.finfo(np.float64).eps
"""Of the largest coordinate: by so much boxes are made wider."""


class Blocks(NamedTuple):
    """The second derivatives of pairs that are in range. vertices (a, 4); values (a, 12, 12) [N/m]."""

    vertices: NDArray[np.int64]
    values: Array

    def add_product(self, x: Positions, out: Positions) -> None:
        """Add their product with x (n, 3) to `out`."""
        barrier.multiply(self.vertices, self.values, x, out)

    def add(self, places: NDArray[np.int64], values: Array) -> None:
        """Add them to blocks (b, 3, 3), at places (a, 16); -1 for none."""
        barrier.scatter(self.values, places, values)


class _Kept(NamedTuple):
    """Pairs that are nearer than `reach` at p (n, 3)."""

    p: Positions
    reach: float
    pairs: Pairs


@dataclass(frozen=True, eq=False)
class SelfContact:
    """Contact of a surface with itself. kept: what was found last, one or none."""

    surface: Surface
    kept: list[_Kept] = field(default_factory=list[_Kept])

    @property
    def range(self) -> float:
        """From this distance on [m] nothing is felt."""
        return self.surface.thickness + self.surface.reach

    def pairs(self, p: Positions) -> Pairs:
        """Pairs that may be in range at p (n, 3): all that are, and maybe more."""
        for kept in self.kept:
            if kept.p.shape == p.shape and 2.0 * _apart(kept.p, p) <= kept.reach - self.range:
                return kept.pairs
        reach = 2.0 * self.range + _ROUND * float(np.abs(p).max(initial=0.0))
        kept = _Kept(p.copy(), reach, self.surface.within(p, reach))
        self.kept[:] = [kept]
        return kept.pairs

    def value(self, p: Positions) -> float:
        """The energy [J] at p, shape (n, 3); infinite where a pair is nearer than the thickness."""
        p = _contiguous(p)
        return barrier.value(self.pairs(p), p) if np.isfinite(p).all() else np.inf

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N], shape (n, 3), to `out`."""
        p = _contiguous(p)
        if np.isfinite(p).all():
            barrier.add_gradient(self.pairs(p), p, out)

    def blocks(self, p: Positions, keep: float = 1.0) -> Blocks:
        """The second derivatives of each pair in range at p (n, 3); keep: of what bends downwards."""
        p = _contiguous(p)
        pairs = self.pairs(p)
        which = np.empty(len(pairs.vertices), np.int64)
        which = which[: barrier.active(pairs, p, 1.0, which)]
        out = np.empty((len(which), 12, 12))
        barrier.curve(pairs, which, p, keep, np.empty((9, 12)), out)
        return Blocks(pairs.vertices[which], out)

    def hessian(self, p: Positions) -> csr_array:
        """The Hessian [N/m], shape (3n, 3n)."""
        vertices, values = self.blocks(p)
        at = (3 * vertices[:, :, None] + np.arange(3)).reshape(len(vertices), 12)
        rows, columns = np.repeat(at, 12, axis=1).ravel(), np.tile(at, 12).ravel()
        return csr_array(coo_array((values.ravel(), (rows, columns)), shape=(p.size, p.size)))

    def largest_step(self, p: Positions, direction: Positions) -> float:
        """The largest t up to 1 by which p may go along a direction, both (n, 3), with all gaps open; 0 where one is
        closed at p. Nothing touches at any smaller t either."""
        p, way = _contiguous(p), _contiguous(direction)
        if not np.isfinite(way).all():
            return 0.0
        way = way - way.mean(axis=0)
        fast, most = float(np.sqrt(np.einsum("ij,ij->i", way, way)).max(initial=0.0)), 1.0
        pairs = None
        for kept in self.kept:
            if kept.p.shape == p.shape and 2.0 * (_apart(kept.p, p) + fast) <= kept.reach - self.surface.thickness:
                pairs = kept.pairs
        if pairs is None:
            pad = self.surface.thickness + _ROUND * float(np.abs(p).max(initial=0.0))
            pairs = self.surface.on_way(p, p + way, pad)
        scratch = np.empty(4, np.int64), np.empty((4, 3)), np.empty((4, 3))
        return ways.largest(pairs, p, way, most, *scratch)

    def closed(self, p: Positions) -> list[tuple[NDArray[np.int64], bool, float]]:
        """Pairs that are not farther apart than their thickness at p (n, 3): their vertices (4,), whether they are
        edges, and their distance [m], the nearest first."""
        p = _contiguous(p)
        pairs = self.pairs(p)
        apart = self.surface.distances(pairs, p)
        bad = np.flatnonzero(~(apart > pairs.scale * pairs.thickness))
        bad = bad[np.argsort(apart[bad], kind="stable")]
        return [(pairs.vertices[e], bool(e >= pairs.points), float(apart[e])) for e in bad.tolist()]


def _contiguous(p: Positions) -> Positions:
    return p if p.flags.carray else np.array(p, order="C")


def _apart(p: Positions, q: Positions) -> float:
    """How far vertices have moved from p to q, (n, 3) each, at most, but for their mean [m]."""
    way = q - p
    way -= way.mean(axis=0)
    return float(np.sqrt(np.einsum("ij,ij->i", way, way)).max(initial=0.0))

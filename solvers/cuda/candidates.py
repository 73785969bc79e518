"""Pairs of points, triangles and edges of surfaces that may be near each other, found on a device.

They are kept for as long as vertices stay close to where they were looked for, their common motion apart, as
`solvers.contact.known` does: what is kept changes nothing that is computed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.contact.contacts import Pairs
from solvers.contact.obstacles import Against
from solvers.contact.surface import Surface
from solvers.cuda import candidate_kernels as kernels
from solvers.cuda import sums
from solvers.cuda.candidate_kernels import Cells, Family, Rest
from solvers.cuda.run import Stream
from solvers.problem import Unsupported

_ROOM = 1.0 + 1e-9
"""Of a cell's width: round-off brings no middle two cells away."""

Ints = NDArray[np.int64]


class Found(NamedTuple):
    """Pairs on the device. many: how many there are, which may be none, though there is room for one; pairs: by rows;
    first (n + 1,), slots (4 many,): of each row of the mesh, 4 pair + corner of those that have it, in order."""

    many: int
    pairs: Pairs
    first: Any
    slots: Any


class Search:
    """What may meet of a surface. order (n,): the vertex of each row; first: the row of the first obstacle's vertex."""

    def __init__(self, solver: str, stream: Stream, surface: object, order: Ints, first: int) -> None:
        """Raises Unsupported for surfaces of one's own."""
        if not isinstance(surface, Surface | Against):
            raise Unsupported(f"{solver}: on a device knows no pairs of {type(surface).__name__}; take device: cpu")
        self.stream, self.surface, self._rows, self._first = stream, surface, len(order), first
        self._row = np.empty(len(order), np.int64)
        self._row[order] = np.arange(len(order))
        self._stiffness = stream.upload(surface.stiffness[order])
        self._two = stream.zeros(2, np.float64)
        self._families = self._of_itself(surface) if isinstance(surface, Surface) else self._of_both(surface)

    def _corners(self, corners: Ints) -> Any:
        """Corners by rows; obstacles' vertices are counted after the mesh's."""
        own = corners < self._rows
        others = corners - self._rows + self._first
        return self.stream.upload(np.where(own, self._row[np.where(own, corners, 0)], others))

    def _of_itself(self, surface: Surface) -> list[tuple[Family, Rest]]:
        points, triangles, edges = (
            self._corners(tree.corners) for tree in (surface.points, surface.triangles, surface.edges)
        )
        keys, share = (x if len(x) else np.full(1, -1, x.dtype) for x in surface.near)
        many = max(len(surface.triangles.corners), len(surface.edges.corners), 1)  # as `Surface` numbers them
        up = self.stream.upload
        near, length = (up(keys), up(share), many), up(surface.length)
        return [
            (Family(points, triangles, False, False), Rest(*near, 0, length, length, self._stiffness)),
            (
                Family(edges, edges, True, True),
                Rest(*near, many * len(surface.points.corners), length, length, self._stiffness),
            ),
        ]

    def _of_both(self, surface: Against) -> list[tuple[Family, Rest]]:
        up, a, b = self.stream.upload, surface.mesh, surface.others
        none = up(np.full(1, -1)), up(np.ones(1)), 1, 0
        met = (a.points, b.triangles, False), (b.points, a.triangles, False), (a.edges, b.edges, True)
        rest = Rest(*none, up(a.length), up(b.length), self._stiffness)
        return [
            (Family(self._corners(one.corners), self._corners(other.corners), edges, False), rest)
            for one, other, edges in met
        ]

    def on_way(self, p: Any, q: Any, reach: float, share: float) -> Found:
        """See `solvers.contact.known.Surfaces`; p, q: rows of all vertices. Waits for how many there are."""
        return self._near(p, q, reach, share, False)

    def within(self, p: Any, reach: float) -> Found:
        """See `on_way`."""
        return self._near(p, p, reach, 0.0, True)

    def _near(self, p: Any, q: Any, *limits: Any) -> Found:
        """limits: reach, share, and whether pairs are told by their distance at p too, not by boxes alone."""
        found = [self._met(family, p, q, limits) for family, _ in self._families]
        many = sum(number for number, _, _ in found)
        empty, room, surface = self.stream.empty, max(1, many), self.surface
        points = sum(
            number for (number, *_), (family, _) in zip(found, self._families, strict=True) if not family.edges
        )
        vertices, base = empty((room, 4), np.int64), 0
        scale, stiffness, parallel = (empty(room, np.float64) for _ in range(3))
        pairs = Pairs(vertices, points, scale, stiffness, parallel, surface.thickness, surface.reach)
        for (family, rest), (number, start, cells) in zip(self._families, found, strict=True):
            if not number:
                continue
            met, over = empty(number, np.int64), self._over(len(family.one))
            kernels.list_met[over](family, p, q, *limits, cells, start, base, met, vertices)
            kernels.weigh[over](family, rest, start, base, met, pairs)
            base += number
        return Found(many, pairs, *self._by_rows(vertices, many))

    def _met(self, family: Family, p: Any, q: Any, limits: Any) -> tuple[int, Any, Any]:
        """How many pairs a family has, the first of each of the first kind, and the cells of the other."""
        if not (len(family.one) and len(family.other)):
            return 0, None, None
        stream, other = self.stream, len(family.other)
        stream.put(np.zeros(2), self._two)
        for at, corners in enumerate((family.one, family.other)):
            kernels.widest[self._over(len(corners))](corners, p, q, at, self._two)
        (reach, share, _), sizes = limits, float(stream.download(self._two).sum())
        # Boxes that meet are apart by g <= reach + share (sizes + g) of three axes each.
        width = _ROOM * ((reach + 3.0 * share * sizes) / (1.0 - 3.0 * share) + 0.5 * sizes)
        buckets = stream.zeros(1 << max(1, (2 * other - 1).bit_length()), np.int64)
        place, begins = stream.empty((other, 3), np.int64), stream.empty(len(buckets) + 1, np.int64)
        cells = Cells(width, place, begins, stream.empty(other, np.int64))
        kernels.enter[self._over(other)](family.other, p, q, cells, buckets)
        self._starts(buckets, cells.start)
        kernels.fill[self._over(other)](cells, buckets)
        count, start = stream.empty(len(family.one), np.int64), stream.empty(len(family.one) + 1, np.int64)
        kernels.count_met[self._over(len(family.one))](family, p, q, *limits, cells, count)
        self._starts(count, start)
        return int(stream.download(start[-1:])[0]), start, cells

    def _by_rows(self, vertices: Any, many: int) -> tuple[Any, Any]:
        count, first = self.stream.zeros(self._rows, np.int64), self.stream.zeros(self._rows + 1, np.int64)
        slots = self.stream.empty(max(1, 4 * many), np.int64)
        if many:
            kernels.count_slots[self._over(4 * many)](vertices, count)
            self._starts(count, first)
            kernels.list_slots[self._over(4 * many)](vertices, first, count, slots)
            kernels.sort_slots[self._over(self._rows)](first, slots)
        return first, slots

    def _starts(self, count: Any, out: Any) -> None:
        kernels.starts[1, sums.THREADS, self.stream.queue](count, out)

    def _over(self, many: int) -> tuple[int, int, Any]:
        return sums.blocks(many), sums.THREADS, self.stream.queue

"""A step's springs, forms and dashpots on a device, by vertices: each thread gathers what acts on its own.

    E = sum_e k_e/2 (|v_e| - r_e)^2 + sum_e k_e/2 (n_e.v_e - o_e)^2 + sum_i h_i/2 |p_i - c_i|^2 - tr(p'f)

Of the second kind, which `rest` tells by nan, are dashpots. What holds each vertex is one number and one centre,
h c = inertia target + penalty pin, so that far-off targets round as positions do. A form is springs without length and
what holds (`solvers.core.parts`). What couples other than two vertices linearly, or not at all, is refused by name.

Vertices are in rows: the free ones first, in patches of neighbours (`solvers.linear.schwarz`), then those that exact
pins hold. Of the entries of 32 rows, a warp's, those that are read together lie side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.contact.touching import without_contact
from solvers.core.bounds import without_bounded
from solvers.core.parts import Parts, split
from solvers.cuda.target import Stream
from solvers.problem import System, Unsupported

WARP = 32
"""Rows whose entries are side by side."""

Ints = NDArray[np.int64]


class Entries(NamedTuple):
    """Edges from both of their ends. first (warps + 1,): the first entry of each warp's rows; of each entry the row of
    the other end (other), the row itself where a list is filled up, and the edge, ~edge at its second end."""

    first: Any
    other: Any
    edge: Any

    @classmethod
    def of(cls, ends: Ints, rows: int) -> Entries:
        """Of edges between rows (m, 2), for the first `rows` of them; those from a row to itself are left out."""
        kept = np.flatnonzero(ends[:, 0] != ends[:, 1])
        here, there = ends[kept].T.ravel(), ends[kept, ::-1].T.ravel()
        edge = np.concatenate([kept, ~kept])
        order = np.argsort(here, kind="stable")
        order = order[: np.searchsorted(here[order], rows)]
        here, there, edge = here[order], there[order], edge[order]
        nth = np.arange(len(here)) - np.searchsorted(here, here)
        warps = -(-rows // WARP)
        count = np.bincount(here, minlength=warps * WARP).reshape(warps, WARP).max(axis=1, initial=0)
        first = np.concatenate([[0], np.cumsum(WARP * count)])
        at = first[here // WARP] + WARP * nth + here % WARP
        lane = np.arange(first[-1]) - np.repeat(first[:-1], np.diff(first))
        other = (np.repeat(WARP * np.arange(warps), np.diff(first)) + lane % WARP).astype(np.int32)
        edges = np.zeros(first[-1], np.int32)
        other[at], edges[at] = there, edge
        return cls(first.astype(np.int32), other, edges)


class Edges(NamedTuple):
    """On the device. first, other, edge: see `Entries`; stiffness, rest: of each entry [N/m, m]; then of each edge: its
    ends (m, 2), its stiffness and rest length (m,), and its axis (m, 3) and offset (m,) [m], of a dashpot; axis: of a
    spring what it takes without a length."""

    first: Any
    other: Any
    edge: Any
    stiffness: Any
    rest: Any
    ends: Any
    strength: Any
    length: Any
    axis: Any
    offset: Any


class Given(NamedTuple):
    """On the device: what holds each free row, h (f,) [N/m], where, c (f, 3) [m], and the force (f, 3) [N]."""

    hold: Any
    centre: Any
    force: Any


@dataclass(frozen=True, eq=False)
class Network:
    """The edges of a system. order (n,): the vertex of each row; free: how many rows move; hold: h of all rows."""

    system: System
    parts: Parts
    order: Ints
    free: int
    ends: Ints
    entries: Entries
    stiffness: NDArray[np.float64]
    rest: NDArray[np.float64]
    axis: NDArray[np.float64]
    hold: NDArray[np.float64]

    @classmethod
    def of(cls, solver: str, system: System, order: Ints) -> Network:
        """order (f,): of the free vertices, as numbers among them. Raises Unsupported with the names of energies that
        are not springs, constant forms or dashpots."""
        parts = split(system)
        require_known(solver, system)
        exact = system.pins.vertices[system.pins.exact]
        order = np.concatenate([system.free[order], exact]).astype(np.int64)
        row = np.empty(system.vertices, np.int64)
        row[order] = np.arange(len(order))
        none = np.empty(0)
        dashpots = parts.dashpots
        ends = row[np.concatenate([parts.whole.edges, *(e.edges for e in dashpots)])]
        stiffness = np.concatenate([parts.whole.stiffness, *(e.stiffness for e in dashpots)])
        damped = np.full(len(ends) - len(parts.whole.edges), np.nan)
        rest = np.concatenate([parts.whole.rest_length, damped])
        axis = np.concatenate([parts.whole.rest_direction, *(e.direction for e in dashpots), none.reshape(0, 3)])
        hold = system.inertia + parts.held
        _, pinned, weight = system.penalty
        hold[pinned] += weight
        free = len(system.free)
        return cls(system, parts, order, free, ends, Entries.of(ends, free), stiffness, rest, axis, hold[order])

    @property
    def bytes(self) -> float:
        """What it takes on the device, beside vectors."""
        return 24.0 * len(self.entries.other) + 64.0 * len(self.ends)

    def upload(self, stream: Stream) -> Edges:
        """Copy it to the device."""
        first, other, edge = self.entries
        named = np.maximum(edge, ~edge)
        return Edges(
            stream.upload(first),
            stream.upload(other),
            stream.upload(edge),
            stream.upload(self.stiffness[named]),
            stream.upload(self.rest[named]),
            stream.upload(self.ends.astype(np.int32)),
            stream.upload(self.stiffness),
            stream.upload(self.rest),
            stream.upload(self.axis),
            stream.upload(np.zeros(len(self.rest))),
        )


def require_known(solver: str, system: System) -> None:
    """Raise Unsupported with the names of energies that the kernels on a device do not know."""
    bare = without_bounded(without_contact(system))
    there = {type(e).__name__ for e in system.energies if e not in bare.energies}
    parts = split(bare)
    unknown = {*there, *parts.unknown, *(type(e).__name__ for e in parts.limits)}
    if unknown:
        raise Unsupported(
            f"{solver}, device: cuda: its kernels know springs, bending, attachments, linear drag and dashpots; not "
            f"{', '.join(sorted(unknown))}; take device: cpu"
        )

"""Springs, quadratic forms and dashpots of a step on a device: each thread gathers the terms of its vertex.

    E = sum_e k_e/2 (|v_e| - r_e)^2 + sum_e k_e/2 (n_e.v_e - o_e)^2 + sum_i h_i/2 |p_i - c_i|^2 - tr(p'f)

Edges of the second kind, marked by nan in `rest`, are dashpots. Each vertex has one anchor stiffness and one centre,
h c = inertia target + penalty pin, so that distant targets round as positions do. A form is represented by zero-length
springs and anchors (`solvers.core.parts`). Energies that couple vertices nonlinearly, or more than two of
them, are not supported; the error names them.

Vertices are in rows: the free ones first, in patches of neighbours (`solvers.linear.schwarz`), then those with
exact pins. The entries of 32 rows, a warp, that are read together are contiguous.
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
"""Number of rows with interleaved entries: a warp."""

Ints = NDArray[np.int64]


class Entries(NamedTuple):
    """Edges listed at both of their ends.

    Attributes:
        first: (warps + 1,), first entry of each warp's rows.
        other: row of the other end of each entry; the row itself for padding.
        edge: edge of each entry, ~edge at its second end.
    """

    first: Any
    other: Any
    edge: Any

    @classmethod
    def of(cls, ends: Ints, rows: int) -> Entries:
        """Build the entries of edges between rows (m, 2), for the first `rows` rows, without self-loops."""
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
    """Edges on the device.

    Attributes:
        first, other, edge: see `Entries`.
        stiffness, rest: of each entry [N/m, m].
        ends: (m, 2), rows.
        strength, length: (m,) [N/m, m].
        axis: (m, 3), axis of a dashpot, or direction of a spring of zero length.
        offset: (m,) [m].
    """

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
    """Data of a step on the device.

    Anchor stiffness h (f,) [N/m], centres c (f, 3) [m] and force (f, 3) [N] of the free rows.
    """

    hold: Any
    centre: Any
    force: Any


@dataclass(frozen=True, eq=False)
class Network:
    """Edges of a system; `order` (n,) are the vertices of the rows, the first `free` rows move."""

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
        """Build the network of a system.

        Args:
            solver: name of the solver, for messages.
            system: the system.
            order: (f,), order of the free vertices, as indices among them.

        Raises:
            Unsupported: with the names of energies other than springs, constant forms and dashpots.
        """
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
        """Return the bytes of the network on the device, without vectors."""
        return 24.0 * len(self.entries.other) + 64.0 * len(self.ends)

    def upload(self, stream: Stream) -> Edges:
        """Copy the edges to the device."""
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
    """Raise Unsupported with the names of energies that the device kernels do not support."""
    bare = without_bounded(without_contact(system))
    there = {type(e).__name__ for e in system.energies if e not in bare.energies}
    parts = split(bare)
    unknown = {*there, *parts.unknown, *(type(e).__name__ for e in parts.limits)}
    if unknown:
        raise Unsupported(
            f"{solver}, device: cuda: its kernels know springs, bending, attachments, linear drag and dashpots; not "
            f"{', '.join(sorted(unknown))}; take device: cpu"
        )

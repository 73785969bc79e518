"""Additive Schwarz preconditioner on a device: `solvers.linear.schwarz` of H+.

    z = sum over levels l of P_l diag(B_l^-1) P_l' r
    H+_ii = h_i + sum over its edges of b,   H+_ij = -b,   b = s I + (k - s) n n',   s no less than zero

Node i of a level is part of node i // PATCH of the next level. An edge between two nodes of a level combines all edges
between their parts. b of a coarse edge is a sum over a list of finer edges, in a fixed order, without atomics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.cuda import device, sums
from solvers.cuda.network import Edges, Entries, Network
from solvers.cuda.schwarz_kernels import fold, kernels, packed, stiffen
from solvers.cuda.target import Stream, cuda
from solvers.linear import schwarz

THREADS = 1 if device.simulated() else 96
"""Threads per subdomain; see `sums` for the simulator's value."""

_MOST_BLOCKS = 65_535

Real = type[np.float32] | type[np.float64]


@dataclass(frozen=True, eq=False)
class Level:
    """A level on the host.

    Attributes:
        nodes: number of nodes.
        entries: edges between nodes, or to fixed rows, from both ends.
        held: (nodes,), sum of h over the parts [N/m].
        edges: number of edges.
        first, finer: (edges + 1,) and list of the finer edges of each edge; empty on the first level.
    """

    nodes: int
    entries: Entries
    held: NDArray[np.float64]
    edges: int
    first: NDArray[np.int64]
    finer: NDArray[np.int64]

    @property
    def patches(self) -> int:
        """Return the number of subdomains."""
        return -(-self.nodes // schwarz.PATCH)


def levels(network: Network, held: NDArray[np.float64]) -> list[Level]:
    """Build the levels of a network; `held` (f,) is that of its rows [N/m]."""
    none = np.zeros(1, np.int64)
    found = [Level(network.free, network.entries, held, len(network.ends), none, none)]
    ends = network.ends
    while (n := found[-1].nodes) > schwarz.PATCH:
        nodes = found[-1].patches
        ends = np.where(ends < n, ends // schwarz.PATCH, nodes)  # what does not move is one node more
        across = np.flatnonzero(ends[:, 0] != ends[:, 1])
        low, high = np.sort(ends[across], axis=1).T
        keys, which = np.unique(low * (nodes + 1) + high, return_inverse=True)
        first = np.concatenate([[0], np.cumsum(np.bincount(which, minlength=len(keys)))])
        finer = across[np.argsort(which, kind="stable")]
        ends = np.column_stack(np.divmod(keys, nodes + 1))
        held = np.add.reduceat(held, np.arange(0, n, schwarz.PATCH))
        found.append(Level(nodes, Entries.of(ends, nodes), held, len(keys), first, finer))
    return found


def needed(of: list[Level], size: int) -> float:
    """Return the bytes on the device, for numbers of `size` bytes."""
    return sum(
        1.0 * size * packed(schwarz.PATCH) * one.patches
        + 48.0 * one.edges
        + 8.0 * (len(one.entries.other) + one.edges + len(one.finer) + one.nodes)
        + 6.0 * size * one.nodes
        for one in of
    )


class UploadedLevel(NamedTuple):
    """A level on the device: its entries, h, and lists of finer edges."""

    first: Any
    other: Any
    edge: Any
    held: Any
    lists: Any
    finer: Any

    @classmethod
    def of(cls, stream: Stream, level: Level) -> UploadedLevel:
        """Copy a level to the device, which does not support empty arrays."""
        first, other, edge = level.entries
        some = np.zeros(1, np.int32)
        return cls(
            stream.upload(first),
            stream.upload(other if len(other) else some),
            stream.upload(edge if len(edge) else some),
            stream.upload(level.held),
            stream.upload(level.first, np.int32),
            stream.upload(level.finer if len(level.finer) else some, np.int32),
        )


class Schwarz:
    """Packed inverses of the subdomains of all levels for one solve; `apply` acts on r (f, 3)."""

    def __init__(self, of: list[Level], uploaded: list[UploadedLevel], stream: Stream, rows: int, real: Real) -> None:
        self._stream, self.r = stream, stream.zeros((rows, 3), real)
        self._levels, self._uploaded, self._of = of, uploaded, kernels(real, schwarz.PATCH)
        self._stiff = [cuda.device_array((6, max(1, one.edges)), np.float64) for one in of]
        half = packed(schwarz.PATCH)
        self._inverses = [cuda.device_array((one.patches, half), real) for one in of]
        self._residuals = [self.r, *(cuda.device_array((one.nodes, 3), real) for one in of[1:])]
        self._moved = [cuda.device_array((one.nodes, 3), real) for one in of[1:]]

    def linearised(self, edges: Edges, p: Any) -> None:
        """Invert the subdomains of H+ at rows p (n, 3) [m]."""
        stiffen[self._over(self._levels[0].edges)](edges, p, self._stiff[0])
        for k, (level, there, stiff) in enumerate(zip(self._levels, self._uploaded, self._stiff, strict=True)):
            if k:
                fold[self._over(level.edges)](there, level.edges, self._stiff[k - 1], stiff)
            self._of.invert[self._patches(level)](there, stiff, level.nodes, self._inverses[k])

    def apply(self, z: Any, which: int, partials: Any, now: Any) -> None:
        """Write z (f, 3), and store the first stage of r'z.

        Do nothing if now[0] is not 0.
        """
        for level, r, coarse in zip(self._levels[1:], self._residuals, self._residuals[1:], strict=False):
            self._of.gather[self._over(level.nodes)](r, coarse, now)
        moved = [z, *self._moved]
        for k in range(len(self._levels) - 1, -1, -1):
            level = self._levels[k]
            last = k == len(self._levels) - 1
            self._of.multiply[self._patches(level)](
                self._inverses[k], self._residuals[k], moved[k if last else k + 1], not last, moved[k], now
            )
        self._of.dot[self._over(len(z))](self.r, z, which, partials, now)

    def _over(self, items: int) -> tuple[int, int, Any]:
        return sums.blocks(items), sums.THREADS, self._stream.queue

    def _patches(self, level: Level) -> tuple[int, int, Any]:
        return min(level.patches, _MOST_BLOCKS), THREADS, self._stream.queue

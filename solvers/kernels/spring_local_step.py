"""The compiled local step of springs, in packets of eight vertices.

    out_i += y_i + sum over springs (i, j) of k r (p_i - p_j) / |p_i - p_j|                         `add_projection`
    out_i += y_i - h_i p_i + sum of (k r / |p_i - p_j| - k) (p_i - p_j),   minus the gradient       `add_descent`

Each vertex has its incident springs. The step is one pass, without A or d. Each spring is computed at both of its ends,
so that no vertex adds to the sum of another one. The result is therefore bitwise independent of the number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.edge_elements import AttachedEdges, EdgePackets, add_edge_forces
from springbench.solvers.kernels.packet_data import deduplicate_packets
from springbench.solvers.kernels.spring_law import unit_direction
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.model.energies.spring_energy import ZERO_LENGTH, Springs
from springbench.solvers.simd import spring_forces as vectors
from springbench.solvers.simd.spring_packets import LANES, RHS_STRIDE

ZERO_LENGTH_SQUARED = ZERO_LENGTH * ZERO_LENGTH
SORT_WINDOW = 128
"""Number of neighbouring rows that are sorted by their springs; a larger window would scatter the memory access."""


class SpringPackets(NamedTuple):
    """Springs by their ends, in b packets of eight vertices.

    A packet has as many entries as its vertex of largest degree, at least two. Padding lanes are vertex
    `padding_row`, and padding springs have zero stiffness and end at row `far`.

    Attributes:
        row_offset: offset of each lane's vertex (8 b,), four times its row.
        packet_start: first entry of each packet (b + 1,).
        neighbour_offset: of each entry, eight offsets of the other ends.
        weight_offset: of each entry, the position in `weights` of eight times k r [N] and eight times k [N/m].
        weights: these numbers, stored once for equal entries, which are nearly all in a regular mesh.
        spring_index: of each entry, eight springs, ~spring at the second end.
        rest_direction: unit directions at zero length (m, 3).
        edges: strain limits and dashpots, or None.
    """

    row_offset: NDArray[np.int32]
    packet_start: NDArray[np.int64]
    neighbour_offset: NDArray[np.int32]
    weight_offset: NDArray[np.int32]
    weights: NDArray[np.float64]
    spring_index: NDArray[np.int32]
    rest_direction: NDArray[np.float64]
    edges: EdgePackets | None

    @classmethod
    def from_springs(
        cls,
        springs: Springs,
        row: NDArray[np.int64],
        part: NDArray[np.int64],
        parts: int,
        padding_row: int,
        far: int,
        attached: AttachedEdges | None = None,
    ) -> tuple[SpringPackets, NDArray[np.int64]]:
        """Build the packets of springs.

        The second result is the first packet of each part of the rows (parts + 1,).

        Self-loops, which have no extension, are omitted.

        Args:
            springs: the springs.
            row: row of each vertex (n,).
            part: part of each vertex (n,), ascending with its row; -1 for a vertex that does not move.
            parts: number of parts.
            padding_row: row of padding lanes.
            far: row of the ends of padding springs.
            attached: strain limits and dashpots attached to the springs, or None.
        """
        springs = attached.springs if attached else springs
        keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])
        ends = springs.edges[keep]
        degree = np.bincount(ends.ravel(), minlength=len(row))
        vertices = np.flatnonzero(part >= 0)
        vertices = vertices[np.argsort(row[vertices])]
        count = np.bincount(part[vertices], minlength=parts)
        rank = np.arange(len(vertices)) - np.repeat(np.cumsum(count) - count, count)
        vertices = vertices[np.lexsort((-degree[vertices], rank // SORT_WINDOW, part[vertices]))]
        first = np.concatenate([[0], np.cumsum(-(-count // LANES))])
        place = np.full(len(row), -1)
        place[vertices] = LANES * first[part[vertices]] + rank
        own = np.full(LANES * first[-1], padding_row, np.int32)
        own[place[vertices]] = row[vertices]

        at = np.zeros(len(own), np.int64)
        at[place[vertices]] = degree[vertices]
        start = np.concatenate([[0], np.cumsum(at.reshape(-1, LANES).max(axis=1, initial=2))])
        here, there = ends.T.ravel(), ends[:, ::-1].T.ravel()
        spring = np.concatenate([keep, ~keep])
        k = springs.stiffness[np.maximum(spring, ~spring)]
        pull = k * springs.rest_length[np.maximum(spring, ~spring)]
        order = np.lexsort((pull, k, place[here]))  # so that lanes have equal springs side by side
        order = order[np.searchsorted(place[here[order]], 0) :]
        is_fixed = part[there[order]] < 0
        here, there, spring, k, pull = place[here[order]], row[there[order]], spring[order], k[order], pull[order]
        nth = np.arange(len(here)) - np.searchsorted(here, here)
        entry = LANES * (start[here // LANES] + nth) + here % LANES

        def fill_entries(values: NDArray[Any], filler: float) -> NDArray[Any]:
            out = allocate_aligned(LANES * start[-1], values.dtype)
            out[:] = filler
            out[entry] = values
            return out

        named = fill_entries(spring.astype(np.int32), 0)
        edges = None
        if attached:
            edges = attached.build_packets(
                named, fill_entries(np.ones(len(entry), bool), 0), fill_entries(is_fixed, 0), start
            )
        return cls(
            4 * own,
            start,
            fill_entries(4 * there.astype(np.int32), 4 * far),
            *deduplicate_packets(fill_entries(pull, 0.0), fill_entries(k, 0.0)),
            named,
            np.array(springs.rest_direction, order="C"),
            edges,
        ), first

    def with_own_dashpots(self) -> SpringPackets:
        """Return the packets with arrays of their own for the dashpots of a step."""
        return self if self.edges is None else self._replace(edges=self.edges.with_own_dashpots())

    def entry_weights(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return k r and k of each entry's springs."""
        pull, k = self.weights.reshape(-1, 2, LANES)[self.weight_offset // (2 * LANES)].transpose(1, 0, 2)
        return pull.ravel(), k.ravel()

    def gather_lanes(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values of the packets' vertices (8 b,), given one number per row."""
        out = allocate_aligned(len(self.row_offset))
        out[:] = values[self.row_offset // 4]
        return out

    def build_right_hand_side(self, anchor_stiffness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Build a right-hand side of zeros in the layout of the packets, with anchor stiffnesses.

        A packet has RHS_STRIDE numbers: eight x, y and z each, and eight stiffnesses. Rows that are in no packet share
        one more packet at the end.

        Args:
            anchor_stiffness: anchor stiffness of each row [N/m].
        """
        out = allocate_aligned(4 * len(self.row_offset) + RHS_STRIDE)
        out[:-RHS_STRIDE].reshape(-1, 4, LANES)[:, 3] = self.gather_lanes(anchor_stiffness).reshape(-1, LANES)
        return out

    def right_hand_side_offset(self, rows: int) -> NDArray[np.int64]:
        """Return the offset of the x coordinate of each row in the right-hand side."""
        lane = np.arange(len(self.row_offset))
        at = np.full(rows, 4 * len(lane))
        at[self.row_offset // 4] = RHS_STRIDE * (lane // LANES) + lane % LANES
        return at


@jit_inner
def add_projection(packets, begin, end, p, right, out, shift):
    """Add y + A'K d(p) of some packets.

    Args:
        packets: packets of the springs and edges.
        begin, end: range of the packets.
        p: positions in rows of four [m].
        right: right-hand side of the packets, with y.
        out: rows of four [N], updated.
        shift: number of rows from a vertex's position to its result.
    """
    moved = out[4 * shift :]
    for b in range(begin, end):
        if vectors.add_spring_projection(packets, b, p, right, moved):
            add_degenerate_packet(packets, b, p, right, moved, False)


@jit_inner
def add_descent(packets, begin, end, p, right, out, shift):
    """Add minus the gradient, y - Q p + A'K d(p), of some packets.

    Args:
        packets: packets of the springs and edges.
        begin, end: range of the packets.
        p: positions in rows of four [m].
        right: right-hand side of the packets, with y and anchor stiffness.
        out: rows of four [N], updated.
        shift: number of rows from a vertex's position to its result.
    """
    moved = out[4 * shift :]
    for b in range(begin, end):
        if vectors.add_spring_forces(packets, b, p, right, moved):
            add_degenerate_packet(packets, b, p, right, moved, True)


@jit_inner
def add_degenerate_packet(packets, b, p, right, out, correct):
    """Add the sums of a packet with a spring of zero length.

    Args:
        packets: packets of the springs and edges.
        b: index of the packet.
        p: positions in rows of four [m].
        right: right-hand side of the packets.
        out: rows of four [N], updated.
        correct: whether to add minus the gradient, as `add_descent`; if not, as `add_projection`.
    """
    add_scalar_springs(packets, b, p, out, correct)
    for lane in range(LANES):
        i, at = packets.row_offset[LANES * b + lane], RHS_STRIDE * b + lane
        for c in range(3):
            out[i + c] += right[at + LANES * c]
            if correct:
                out[i + c] -= right[at + 3 * LANES] * p[i + c]


@jit_inner
def add_scalar_springs(packets, b, p, out, correct):
    """Add a packet's springs and their edges one by one.

    A spring of zero length has the direction of its rest shape.

    Args:
        packets: packets of the springs and edges.
        b: index of the packet.
        p: positions in rows of four [m].
        out: rows of four [N], updated.
        correct: whether to add minus the gradient; A'K d is added if not.
    """
    for lane in range(LANES):
        i = packets.row_offset[LANES * b + lane]
        s0 = s1 = s2 = 0.0
        for entry in range(packets.packet_start[b], packets.packet_start[b + 1]):
            e, w = LANES * entry + lane, packets.weight_offset[entry] + lane
            j = packets.neighbour_offset[e]
            v0, v1, v2 = p[i] - p[j], p[i + 1] - p[j + 1], p[i + 2] - p[j + 2]
            if correct:
                k = packets.weights[w + LANES]
                s0, s1, s2 = s0 - k * v0, s1 - k * v1, s2 - k * v2
            scale, squared = packets.weights[w], v0 * v0 + v1 * v1 + v2 * v2
            if squared <= ZERO_LENGTH_SQUARED:
                name = packets.spring_index[e]
                if name < 0:
                    scale, name = -scale, ~name
                v0, v1, v2 = packets.rest_direction[name]
            else:
                scale /= np.sqrt(squared)
            s0, s1, s2 = s0 + scale * v0, s1 + scale * v1, s2 + scale * v2
            s0, s1, s2 = _add_edges(packets, packets.edges, i, entry, lane, p, correct, (s0, s1, s2))
        out[i], out[i + 1], out[i + 2] = out[i] + s0, out[i + 1] + s1, out[i + 2] + s2


@jit_inner
def _add_edges(packets, edges, i, entry, lane, p, correct, force):
    """Add an entry's edges, if any, to the force on the vertex at offset i."""
    if edges is None:
        return force
    e = LANES * entry + lane
    j = packets.neighbour_offset[e]
    v = p[i] - p[j], p[i + 1] - p[j + 1], p[i + 2] - p[j + 2]
    n0, n1, n2, _ = unit_direction(v[0], v[1], v[2], packets.rest_direction, packets.spring_index[e])
    return add_edge_forces(edges, entry, lane, v, (n0, n1, n2), correct, force)


@jit_inner
def squared_norm(packets, begin, end, e, measure):
    """Return |e|_Q^2 [J], with half of each spring at each end.

    Args:
        packets: packets whose springs have the stiffness of all energies.
        begin, end: range of the packets.
        e: displacements in rows of four [m].
        measure: diagonal part of Q in each lane (8 b,) [N/m].
    """
    total = 0.0
    for b in range(begin, end):
        total += vectors.spring_squared_norm(packets, b, e, measure)
    return total


@jit_kernel
def run_local_step(packets, p, y, x, b, zero, out):
    """Write y + A'K d(p).

    Args:
        packets: packets of the springs, whose rows are the vertices.
        p: positions (n, 3) [m].
        y: right-hand side (n, 3) [N].
        x: scratch, n + 2 rows of four; the last two, of padding, are not overwritten.
        b: scratch, n + 2 rows of four.
        zero: right-hand side of the packets, all zeros.
        out: output (n, 3) [N].
    """
    n = len(p)
    for i in range(n):
        for c in range(3):
            x[4 * i + c] = p[i, c]
            b[4 * i + c] = 0.0
    add_projection(packets, 0, len(packets.packet_start) - 1, x, zero, b, 0)
    for i in range(n):
        for c in range(3):
            out[i, c] = y[i, c] + b[4 * i + c]

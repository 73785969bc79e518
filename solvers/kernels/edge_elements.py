"""Strain limits and dashpots in the packets of springs.

Each is in the entry of the spring between the same vertices.

    E = sum_e k_e/2 (l_e - clip(l_e, low_e, high_e))^2      strain limits, l = |v|
      + sum_e (m_e.v_e - q_e)^2 / 2                         dashpots, m = sqrt(k) n, q = sqrt(k) o

The vector v and the length l of an entry's spring are available, so that an edge adds its arithmetic, but no memory
access to vertices. An edge without a spring gets one of zero stiffness. Both energies are projective: the gradient is
A'K b, the projection d = v - b, with b = (l - clip(l)) v/l of a limit and (n.v - o) n of a dashpot. Dashpots between
the same vertices have the same n and o in a step, and are added to one.

These are the scalar forms and the arrays; `springbench.solvers.simd.edge_packets` has the vectors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.kernels.packet_data import copy_aligned, deduplicate_packets
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH, vertex_pair_keys
from springbench.solvers.model.energies.element_energies import axial_hessian
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.simd.spring_packets import EDGE_STRIDE, LANES

if TYPE_CHECKING:
    from springbench.solvers.model.energies.dashpot_energy import Dashpots
    from springbench.solvers.model.energies.strain_limit_energy import StrainLimits

_HALF_SHARE, _FULL_SHARE = 0.25, 0.5
"""Factors of k b^2 at each end of an edge, and at the only end that moves."""


class EdgePackets(NamedTuple):
    """The strain limit and the dashpot of each entry and lane of `SpringPackets`.

    Attributes:
        limit_offset: of each entry, the position in `limit_data` of eight k [N/m], low, high [m], and energy shares.
        limit_data: these numbers, stored once for equal entries; k = 0 for none.
        dashpot_data: of each entry, eight m (three times) [(N/m)^(1/2)] and q [J^(1/2)]; zero for none.
        dashpot_blocks: of each packet, eight sums of m m' over its entries, as upper triangles row by row (48 b,).
        has_limits, has_dashpots: whether there are any.
        limit_index: of each entry, eight strain limits, -1 for none.
        dashpot_index: of each entry, eight dashpots counted from 1, negative at the second end, 0 for none.
        first_dashpot: index of the first of the concatenated dashpots between the same vertices (d,).
        dashpot_stiffness: the sum of their stiffnesses (d,) [N/m].
        packet_start: first entry of each packet (b + 1,).
    """

    limit_offset: NDArray[np.int32]
    limit_data: NDArray[np.float64]
    dashpot_data: NDArray[np.float64]
    dashpot_blocks: NDArray[np.float64]
    has_limits: bool
    has_dashpots: bool
    limit_index: NDArray[np.int32]
    dashpot_index: NDArray[np.int32]
    first_dashpot: NDArray[np.int64]
    dashpot_stiffness: NDArray[np.float64]
    packet_start: NDArray[np.int64]

    def with_limits(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> EdgePackets:
        """Return the packets with other limits.

        Args:
            low, high: shortest and longest lengths of the concatenated strain limits (m,) [m].
        """
        number = self.limit_index.reshape(-1, 1, LANES)[:, 0]
        data = self.limit_data.reshape(-1, 4, LANES)[self.limit_offset // EDGE_STRIDE].copy()
        data[:, 1], data[:, 2] = (np.where(number >= 0, x[number], y) for x, y in ((low, 0.0), (high, np.inf)))
        offset = np.arange(0, data.size, EDGE_STRIDE, dtype=np.int32)
        return self._replace(limit_offset=offset, limit_data=copy_aligned(data))

    def with_own_dashpots(self) -> EdgePackets:
        """Return the packets with arrays of their own for `write_directions`."""
        data, blocks = (allocate_aligned(len(x)) for x in (self.dashpot_data, self.dashpot_blocks))
        return self._replace(dashpot_data=data, dashpot_blocks=blocks)

    def write_directions(self, axis: Positions, offset: NDArray[np.float64]) -> None:
        """Write other directions and offsets of the dashpots.

        Args:
            axis: unit directions n of the concatenated dashpots (m, 3).
            offset: offsets o of the concatenated dashpots (m,) [m].
        """
        places = self.packet_start, self.dashpot_index, self.first_dashpot
        _write_dashpots.call(*places, self.dashpot_stiffness, axis, offset, self.dashpot_data, self.dashpot_blocks)


class AttachedEdges(NamedTuple):
    """Springs with those of zero stiffness that edges need, and the edge of each.

    Attributes:
        springs: the springs, and those of zero stiffness behind them.
        limit_index: of each spring, the strain limit, -1 for none.
        dashpot_index: of each spring, the dashpot counted from 1, negative if it runs in the opposite direction, 0 for
            none.
        first_dashpot: index of the first of the concatenated dashpots between the same vertices (d,).
        dashpot_stiffness: the sum of their stiffnesses (d,) [N/m].
        stiffness, min_length, max_length: of the concatenated strain limits (m,).
    """

    springs: Springs
    limit_index: NDArray[np.int32]
    dashpot_index: NDArray[np.int32]
    first_dashpot: NDArray[np.int64]
    dashpot_stiffness: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    min_length: NDArray[np.float64]
    max_length: NDArray[np.float64]

    @classmethod
    def from_energies(
        cls, springs: Springs, limits: tuple[StrainLimits, ...], dashpots: tuple[Dashpots, ...]
    ) -> AttachedEdges:
        """Attach the edges to the springs between the same vertices.

        A vertex pair with several springs has its edges at the first one. A second strain limit of a pair is attached
        to a spring of its own.

        Args:
            springs: the springs, to which edges without a spring add ones of zero stiffness.
            limits: strain limits, concatenated in this order.
            dashpots: dashpots, concatenated in this order; those of a vertex pair are added to one.
        """
        limit_ends = _concatenate_ends(limits)
        dashpot_ends = _concatenate_ends(dashpots)
        proper = np.flatnonzero(dashpot_ends[:, 0] != dashpot_ends[:, 1])
        size = 1 + int(max((ends.max(initial=0) for ends in (springs.edges, limit_ends, dashpot_ends)), default=0))
        _, first, kind = np.unique(vertex_pair_keys(dashpot_ends[proper], size), return_index=True, return_inverse=True)
        first_dashpot = proper[first]
        damping = np.zeros(len(first_dashpot))
        np.add.at(damping, kind, np.concatenate([np.empty(0), *(e.stiffness for e in dashpots)])[proper])
        # The spring of each edge is the first one of its vertex pair, or a new one behind the springs.
        keys = np.concatenate(
            [vertex_pair_keys(ends, size) for ends in (springs.edges, limit_ends, dashpot_ends[first_dashpot])]
        )
        rank = np.zeros(len(keys), np.int64)
        rank[len(springs.edges) : len(springs.edges) + len(limit_ends)] = _rank_repeated(
            vertex_pair_keys(limit_ends, size)
        )
        taken = np.concatenate([springs.edges, limit_ends, dashpot_ends[first_dashpot]])
        _, owner, kind = np.unique(keys * (1 + rank.max(initial=0)) + rank, return_index=True, return_inverse=True)
        owner = owner[kind]
        added = np.flatnonzero((owner == np.arange(len(keys))) & (np.arange(len(keys)) >= len(springs.edges)))
        place = np.arange(len(keys))
        place[added] = len(springs.edges) + np.arange(len(added))
        place = place[owner]
        axes = np.tile([1.0, 0.0, 0.0], (len(keys), 1))
        axes[: len(springs.edges)] = springs.rest_direction
        behind = slice(len(springs.edges), len(springs.edges) + len(limit_ends))
        axes[behind] = np.concatenate([np.empty((0, 3)), *(e.rest_direction for e in limits)])
        flat = np.zeros(len(added))
        whole = Springs.from_parts([springs, Springs(taken[added], flat, flat, axes[added])])
        limit_index, dashpot_index = np.full(len(whole.edges), -1, np.int32), np.zeros(len(whole.edges), np.int32)
        limit_index[place[behind]] = np.arange(len(limit_ends))
        # A spring of zero rest length needs no direction, so that it may have that of its limit.
        loose = np.flatnonzero((limit_index >= 0) & (whole.rest_length == 0.0))
        axis = axes[behind][limit_index[loose]]
        opposite = whole.edges[loose, 0] != limit_ends[limit_index[loose], 0]
        whole.rest_direction[loose] = np.where(opposite[:, None], -axis, axis)
        at = place[behind.stop :]
        aligned = whole.edges[at, 0] == dashpot_ends[first_dashpot, 0]
        dashpot_index[at] = np.where(aligned, 1, -1) * np.arange(1, len(first_dashpot) + 1)
        none = np.empty(0)
        numbers = (np.concatenate([none, *(getattr(e, x) for e in limits)]) for x in _LIMIT_FIELDS)
        return cls(whole, limit_index, dashpot_index, first_dashpot, damping, *numbers)

    def build_packets(
        self,
        spring_index: NDArray[np.int32],
        is_filled: NDArray[np.bool_],
        has_fixed_end: NDArray[np.bool_],
        packet_start: NDArray[np.int64],
    ) -> EdgePackets:
        """Build the edges of packets.

        Args:
            spring_index: of each entry and lane, the spring, ~spring at its second end.
            is_filled: whether it is one; the others are padding.
            has_fixed_end: whether the other end does not move.
            packet_start: first entry of each packet (b + 1,).
        """
        spring = np.maximum(spring_index, ~spring_index)
        limit = np.where(is_filled, self.limit_index[spring], -1).astype(np.int32)
        sign = np.where(spring_index < 0, -1, 1)
        dashpot = np.where(is_filled, sign * self.dashpot_index[spring], 0).astype(np.int32)
        data = np.empty((4, len(spring_index)))
        for row, values, none in zip(
            data, (self.stiffness, self.min_length, self.max_length), (0.0, 0.0, np.inf), strict=False
        ):
            row[:] = none
            row[limit >= 0] = values[limit[limit >= 0]]
        data[3] = np.where(has_fixed_end, _FULL_SHARE, _HALF_SHARE)
        offset, numbers = deduplicate_packets(*data)
        has_dashpots = len(self.first_dashpot) > 0
        many = len(spring_index) if has_dashpots else 0
        return EdgePackets(
            offset,
            numbers,
            np.zeros(4 * many),
            np.zeros(6 * LANES * (len(packet_start) - 1) if has_dashpots else 0),
            len(self.stiffness) > 0,
            has_dashpots,
            limit,
            dashpot,
            self.first_dashpot,
            self.dashpot_stiffness,
            packet_start,
        )


_LIMIT_FIELDS = "stiffness", "min_length", "max_length"


def _concatenate_ends(energies: tuple[StrainLimits, ...] | tuple[Dashpots, ...]) -> NDArray[np.int64]:
    return np.concatenate([np.empty((0, 2), np.int64), *(e.edges for e in energies)])


def _rank_repeated(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many equal numbers precede each one."""
    order = np.argsort(keys, kind="stable")
    rank = np.empty(len(keys), np.int64)
    rank[order] = np.arange(len(keys)) - np.searchsorted(keys[order], keys[order])
    return rank


@jit_kernel
def write_dashpots(packet_start, dashpot_index, first_dashpot, stiffness, axis, offset, data, blocks):
    """Write m and q of all entries, and the packets' sums of m m'.

    Args:
        packet_start, dashpot_index, first_dashpot, stiffness: those of `EdgePackets`.
        axis: unit directions n of the concatenated dashpots (m, 3).
        offset: their offsets o (m,) [m].
        data, blocks: the `dashpot_data` and `dashpot_blocks` of `EdgePackets`, overwritten.
    """
    for b in range(len(packet_start) - 1):
        for k in range(6 * LANES):
            blocks[6 * LANES * b + k] = 0.0
        for entry in range(packet_start[b], packet_start[b + 1]):
            for lane in range(LANES):
                number, at = dashpot_index[LANES * entry + lane], EDGE_STRIDE * entry + lane
                m0 = m1 = m2 = q = 0.0
                if number != 0:
                    scale, e = np.sqrt(stiffness[abs(number) - 1]), first_dashpot[abs(number) - 1]
                    along, q = scale if number > 0 else -scale, scale * offset[e]
                    m0, m1, m2 = along * axis[e, 0], along * axis[e, 1], along * axis[e, 2]
                data[at], data[at + LANES], data[at + 2 * LANES], data[at + 3 * LANES] = m0, m1, m2, q
                block = 6 * LANES * b + lane
                blocks[block] += m0 * m0
                blocks[block + LANES] += m0 * m1
                blocks[block + 2 * LANES] += m0 * m2
                blocks[block + 3 * LANES] += m1 * m1
                blocks[block + 4 * LANES] += m1 * m2
                blocks[block + 5 * LANES] += m2 * m2


_write_dashpots = TypedKernel(write_dashpots)


@jit_kernel
def sum_squared_stretch(edges, stiffness, p):
    """Return the sum of k |v|^2 [J] over edges.

    Args:
        edges: (m, 2).
        stiffness: k (m,) [N/m].
        p: positions (n, 3) [m].
    """
    total = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        v0, v1, v2 = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        total += stiffness[e] * (v0 * v0 + v1 * v1 + v2 * v2)
    return total


@jit_inner
def _limit_excess(edges, at, length):
    """Return the length beyond the limits at a data position, negative below the minimum."""
    return length - min(max(length, edges.limit_data[at + LANES]), edges.limit_data[at + 2 * LANES])


@jit_inner
def _dashpot_at(edges, entry, lane, v0, v1, v2):
    """Return m and m.v - q of an entry's dashpot."""
    if not edges.has_dashpots:
        return 0.0, 0.0, 0.0, 0.0
    at = EDGE_STRIDE * entry + lane
    m0, m1, m2 = edges.dashpot_data[at], edges.dashpot_data[at + LANES], edges.dashpot_data[at + 2 * LANES]
    return m0, m1, m2, m0 * v0 + m1 * v1 + m2 * v2 - edges.dashpot_data[at + 3 * LANES]


@jit_inner
def add_edge_forces(edges, entry, lane, v, n, correct, force):
    """Add minus the gradient of an entry's edges to a force; do nothing without edges.

    Args:
        edges: edges of the packets, or None.
        entry, lane: position of the spring in the packets.
        v: vector from the spring's other end to the vertex [m].
        n: direction of v, at zero length that of the rest shape.
        correct: whether to add minus the gradient; A'K d is added if not.
        force: force on the vertex [N], a tuple of three.

    Returns:
        The new force.
    """
    if edges is None:
        return force
    at = edges.limit_offset[entry] + lane
    k, beyond = (
        edges.limit_data[at],
        _limit_excess(edges, at, np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])),
    )
    m0, m1, m2, stretch = _dashpot_at(edges, entry, lane, v[0], v[1], v[2])
    pull = k * beyond
    s0, s1, s2 = (
        force[0] - pull * n[0] - stretch * m0,
        force[1] - pull * n[1] - stretch * m1,
        force[2] - pull * n[2] - stretch * m2,
    )
    if not correct:
        k += m0 * m0 + m1 * m1 + m2 * m2
        s0, s1, s2 = s0 + k * v[0], s1 + k * v[1], s2 + k * v[2]
    return s0, s1, s2


@jit_inner
def edge_energy(edges, entry, lane, v0, v1, v2):
    """Return an end's share of the energy [J] of an entry's edges.

    Args:
        edges: edges of the packets, or None; the energy is 0 without edges.
        entry, lane: position of the spring in the packets.
        v0, v1, v2: vector from the spring's other end to the vertex [m].
    """
    if edges is None:
        return 0.0
    at = edges.limit_offset[entry] + lane
    beyond = _limit_excess(edges, at, np.sqrt(v0 * v0 + v1 * v1 + v2 * v2))
    _, _, _, stretch = _dashpot_at(edges, entry, lane, v0, v1, v2)
    return edges.limit_data[at + 3 * LANES] * (edges.limit_data[at] * beyond * beyond + stretch * stretch)


@jit_inner
def add_edge_derivatives(edges, entry, lane, v, n, length, gradient, block):
    """Add an entry's edges to gradient and block of its vertex; do nothing without edges.

    Args:
        edges: edges of the packets, or None.
        entry, lane: position of the spring in the packets.
        v: vector from the spring's other end to the vertex [m].
        n: direction of v, at zero length that of the rest shape.
        length: length of v [m].
        gradient: gradient of the vertex [N], a tuple of three.
        block: xx, xy, xz, yy, yz and zz of the vertex's Hessian [N/m].

    Returns:
        The new gradient and the new block.
    """
    if edges is None:
        return gradient, block
    at = edges.limit_offset[entry] + lane
    k, beyond = edges.limit_data[at], _limit_excess(edges, at, length)
    m0, m1, m2, stretch = _dashpot_at(edges, entry, lane, v[0], v[1], v[2])
    gradient = (
        gradient[0] + k * beyond * n[0] + stretch * m0,
        gradient[1] + k * beyond * n[1] + stretch * m1,
        gradient[2] + k * beyond * n[2] + stretch * m2,
    )
    h0, h1, h2, h3, h4, h5 = axial_hessian(
        k if beyond != 0.0 else 0.0, k * beyond / length if length > ZERO_LENGTH else 0.0, n[0], n[1], n[2]
    )
    return gradient, (
        block[0] + h0 + m0 * m0,
        block[1] + h1 + m0 * m1,
        block[2] + h2 + m0 * m2,
        block[3] + h3 + m1 * m1,
        block[4] + h4 + m1 * m2,
        block[5] + h5 + m2 * m2,
    )


@jit_inner
def edge_energy_change(edges, entry, lane, v, d):
    """Return the change [J] of an entry's edge energies by a step, without cancellation.

    Args:
        edges: edges of the packets, or None; the change is 0 without edges.
        entry, lane: position of the spring in the packets.
        v: vector from the spring's other end to the vertex before the step [m].
        d: step of the vertex [m].
    """
    if edges is None:
        return 0.0
    at = edges.limit_offset[entry] + lane
    t0, t1, t2 = v[0] + d[0], v[1] + d[1], v[2] + d[2]
    before, after = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
    one, other = _limit_excess(edges, at, before), _limit_excess(edges, at, after)
    longer = other - one
    if one * other > 0.0:  # the same limit: the difference of the lengths, which loses no digits
        longer = (d[0] * (v[0] + t0) + d[1] * (v[1] + t1) + d[2] * (v[2] + t2)) / (before + after)
    m0, m1, m2, stretch = _dashpot_at(edges, entry, lane, v[0], v[1], v[2])
    closer = m0 * d[0] + m1 * d[1] + m2 * d[2]
    return 0.5 * edges.limit_data[at] * longer * (one + other) + closer * (stretch + 0.5 * closer)

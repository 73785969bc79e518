"""Strain limits and dashpots of eight vertices at a time, in explicit LLVM vectors.

The formulas are those of `springbench.solvers.kernels.edge_elements`. Vector, squared length and inverse length are
those of the entry's spring. Whether a system has limits and dashpots is known at run time, so that a kernel is compiled
once for both.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import cgutils
from springbench.solvers.simd.llvm_vectors import I64
from springbench.solvers.simd.spring_packets import (
    BLOCK_ENTRIES,
    EDGE_STRIDE,
    LANES,
    PacketBuilder,
    constant_packet,
)

_ZERO, _HALF = constant_packet(0.0), constant_packet(0.5)


class EdgeBuilder:
    """Builder of the code of the edges in a packet's entries."""

    def __init__(self, vectors: PacketBuilder, edges: Any, packet_index: Any) -> None:
        self._vectors, self._builder, self._edges = vectors, vectors.builder, edges
        self._packet_index = packet_index

    def subtract_forces(
        self,
        entry: Any,
        arrow: list[Any],
        squared: Any,
        root: Any,
        factor: Any,
        sums: list[Any],
        *,
        correct: bool = True,
    ) -> Any:
        """Subtract the forces of an entry's edges from those of its springs.

        Those of dashpots are subtracted from the sums, those of limits from the factor of the vectors.

        Args:
            entry: index of the entry.
            arrow: x, y and z of the vectors v from the other ends [m].
            squared: |v|^2 [m^2].
            root: 1/|v| [1/m].
            factor: factor of v in the force of the springs [N/m].
            sums: pointers to x, y and z of the force [N]; a fourth one, if any, receives the energy [J].
            correct: whether the sums are minus the gradient; if not, A'K d is added in place of the forces.

        Returns:
            The factor of v with the limits [N/m].
        """
        b, v = self._builder, self._vectors
        found = cgutils.alloca_once_value(b, factor)
        with self._if_any(self._edges.has_limits):
            k, low, high, share = self._load_limits(entry)
            beyond = self._excess(b.fmul(squared, root), low, high)
            pull = b.fmul(k, beyond)
            total = v.subtract_product(b.load(found), pull, root)
            b.store(total if correct else b.fadd(total, k), found)
            if len(sums) > 3:
                v.add_products([b.fmul(share, pull)], [beyond], sums[3:])
        with self._if_any(self._edges.has_dashpots):
            m, stretch = self._load_dashpots(entry, arrow)
            for component, total in zip(m, sums, strict=False):
                b.store(v.subtract_product(b.load(total), stretch, component), total)
            if not correct:
                b.store(b.fadd(b.load(found), v.squared_norm(m)), found)
            if len(sums) > 3:
                share = v.load_packets(self._edges.limit_data, self._edges.limit_offset, entry, 4)[3]
                v.add_products([b.fmul(share, stretch)], [stretch], sums[3:])
        return b.load(found)

    def add_derivatives(
        self, entry: Any, arrow: list[Any], squared: Any, root: Any, factors: list[Any], sums: list[Any]
    ) -> list[Any]:
        """Add the derivatives of an entry's limits and dashpots.

        Limits change the factors of their spring, dashpots the sums of their gradient.

        Args:
            entry: index of the entry.
            arrow: x, y and z of the vectors v from the other ends [m].
            squared: |v|^2 [m^2].
            root: 1/|v| [1/m].
            factors: factors of v in the force, of I and of nn' in the block [N/m].
            sums: pointers to x, y and z of the gradient of dashpots [N].

        Returns:
            The three factors with the limits.
        """
        b, v = self._builder, self._vectors
        found = [cgutils.alloca_once_value(b, factor) for factor in factors]
        with self._if_any(self._edges.has_limits):
            k, low, high, _ = self._load_limits(entry)
            beyond = self._excess(b.fmul(squared, root), low, high)
            across = b.fmul(b.fmul(k, beyond), root)
            along = b.select(b.fcmp_unordered("!=", beyond, _ZERO), k, _ZERO)
            pull, lateral, axial = (b.load(place) for place in found)
            b.store(b.fsub(pull, across), found[0])
            b.store(b.fadd(lateral, across), found[1])
            b.store(b.fadd(axial, b.fsub(along, across)), found[2])
        with self._if_any(self._edges.has_dashpots):
            m, stretch = self._load_dashpots(entry, arrow)
            v.add_products([stretch] * 3, m, sums)
        return [b.load(place) for place in found]

    def add_dashpot_blocks(self, sums: list[Any]) -> None:
        """Add the constant blocks of the packet's dashpots to six sums."""
        b = self._builder
        with self._if_any(self._edges.has_dashpots):
            for block, total in zip(self._load_blocks(), sums, strict=True):
                b.store(b.fadd(b.load(total), block), total)

    def add_limit_change(self, entry: Any, before: Any, after: Any, change: Any, by_both: Any, total: Any) -> None:
        """Add the energy change of an entry's limits.

        Args:
            entry: the entry.
            before, after: lengths.
            change: difference of their squares, without cancellation.
            by_both: inverse of their sum.
            total: accumulator.
        """
        b, v = self._builder, self._vectors
        with self._if_any(self._edges.has_limits):
            k, low, high, _ = self._load_limits(entry)
            one, other = self._excess(before, low, high), self._excess(after, low, high)
            is_same_limit = b.fcmp_ordered(">", b.fmul(one, other), _ZERO)
            longer = b.select(is_same_limit, b.fmul(change, by_both), b.fsub(other, one))
            v.add_products([b.fmul(b.fmul(_HALF, k), longer)], [b.fadd(one, other)], [total])

    def add_dashpot_change(self, gradient: list[Any], d: list[Any], total: Any) -> None:
        """Add the energy change g.d + d'Bd/2 of the packet's dashpots.

        Args:
            gradient: x, y and z of their gradient g at each vertex [N].
            d: x, y and z of the steps of the vertices [m].
            total: pointer to the sum of energy changes [J].
        """
        b, v = self._builder, self._vectors
        with self._if_any(self._edges.has_dashpots):
            xx, xy, xz, yy, yz, zz = self._load_blocks()
            rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
            for row, slope, component in zip(rows, gradient, d, strict=True):
                bent = b.fmul(row[0], d[0])
                for entry, other in zip(row[1:], d[1:], strict=True):
                    bent = v.multiply_add(entry, other, bent)
                v.add_products([v.multiply_add(_HALF, bent, slope)], [component], [total])

    def _load_limits(self, entry: Any) -> list[Any]:
        """Load k, low, high and the energy's share of an entry's limits."""
        return self._vectors.load_packets(self._edges.limit_data, self._edges.limit_offset, entry, 4)

    def _load_dashpots(self, entry: Any, arrow: list[Any]) -> tuple[list[Any], Any]:
        """Load m of an entry's dashpots, and compute m.v - q."""
        b, v = self._builder, self._vectors
        *m, stretch = v.load_adjacent(self._edges.dashpot_data, b.mul(entry, I64(EDGE_STRIDE)), 4)
        stretch = b.fsub(_ZERO, stretch)
        for one, other in zip(m, arrow, strict=True):
            stretch = v.multiply_add(one, other, stretch)
        return m, stretch

    def _load_blocks(self) -> list[Any]:
        first = self._builder.mul(self._packet_index, I64(BLOCK_ENTRIES * LANES))
        return self._vectors.load_adjacent(self._edges.dashpot_blocks, first, BLOCK_ENTRIES)

    def _excess(self, length: Any, low: Any, high: Any) -> Any:
        """Return the length beyond the limits, negative below the minimum."""
        v = self._vectors
        return self._builder.fsub(length, v.select_minimum(v.select_minimum(length, low, ">="), high))

    @contextmanager
    def _if_any(self, flag: Any) -> Iterator[None]:
        with self._builder.if_then(self._builder.icmp_unsigned("!=", flag, I64(0))):
            yield

"""Products of the Hessian of springs with a vector, in explicit LLVM vectors.

The packets of eight vertices are those of `springbench.solvers.simd.spring_packets`.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic
from springbench.solvers.simd.llvm_vectors import I64, unpack_arguments
from springbench.solvers.simd.spring_packets import LANES, PacketBuilder, SpringPacket

LINEAR_STRIDE = 4 * LANES
"""Numbers of an entry's linearised springs: eight x, y, z [(N/m)^(1/2)] and transverse stiffnesses [N/m]."""


def _spring_product_code(
    typingctx: Any, packets: Any, linear: Any, diagonal: Any, number: Any, x: Any, out: Any
) -> Any:
    """Write a packet's rows of the product."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        packets, linear, diagonal, number, x, out = unpack_arguments(context, builder, signature, args)
        v, springs = PacketBuilder(context, builder), SpringPacket.from_packets(builder, packets, number)
        places = v.load_row_offsets(springs.row_offset, number)
        centre, sums = v.gather_rows(x, places), v.allocate_sums(3)

        def read(entry: Any) -> list[Any]:
            """Load an entry's linearised springs, and the differences of x at their ends."""
            change = v.compute_spring_vectors(x, centre, springs.neighbour_offset, entry)
            return [*v.load_adjacent(linear, builder.mul(entry, I64(LINEAR_STRIDE)), 4), *change]

        def add(values: list[Any]) -> None:
            """Add an entry's springs to the sums."""
            normal, lateral, change = values[:3], values[3], values[4:]
            v.add_products([lateral] * 3, change, sums)
            v.add_products([v.inner_product(normal, change)] * 3, normal, sums)

        v.pipeline_entries(springs.first_entry, springs.end_entry, read, add)
        (stiffness,) = v.load_adjacent(diagonal, builder.mul(number, I64(LANES)), 1)
        total = [v.multiply_add(stiffness, a, builder.load(b)) for a, b in zip(centre, sums, strict=True)]
        for place, row in zip(places, v.transpose_to_rows(total), strict=True):
            v.store(row, builder.gep(out, [place]))
        return context.get_dummy_value()

    return types.void(packets, linear, diagonal, number, x, out), generate


# Numba passes the first argument itself, which type checkers cannot see.
write_spring_products: Any = intrinsic(_spring_product_code)

"""Operation counts of a phase: bytes moved and flops, for comparison with the machine's limits.

    global step   2 x 3 flops for each entry of a factor that a solve reads, once per pass, and the vectors
    local step    two indices and a weight for each spring, and the vectors

A factor whose read volume is unknown counts as L twice; without the size of L there is no count.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

_ENTRY_BYTES = {"float64": 8, "float32": 4, "float16": 2}
"""Bytes of an entry of the factor, by the solver's `precision`."""

_SPRING_BYTES, _SPRING_FLOPS = 16, 19
"""Bytes and flops per spring.

Bytes: k r and two indices. Flops: a difference, its length, a division, and a sum at each end.
"""

_LOCAL_BYTES, _GLOBAL_BYTES = 72, 176
"""Bytes of the vectors that are moved per vertex.

Local: p and y read, b written. Global: b read, p written, and a work vector of 4 numbers read and written in each pass.
"""

_VECTOR_BYTES = 80
"""Bytes of the stored vectors per vertex: b and p, or in an iteration y and p, and the work vector."""


class OperationCount(NamedTuple):
    """Bytes moved, flops, and the bytes that are accessed repeatedly."""

    bytes_moved: float
    flop_count: float
    working_set_bytes: float


def count_operations(
    stats: Mapping[str, float], vertices: int, springs: int, precision: str = "float64"
) -> dict[str, OperationCount]:
    """Count the work of a local step, a global step and an iteration.

    An iteration is both steps. Unknown counts are omitted.

    Args:
        stats: `nnz_factor`, `factor_bytes` and `flops_per_solve` of a prepared solver, as far as known.
        vertices: number of vertices.
        springs: number of springs.
        precision: number format of the factor.
    """
    moved = _SPRING_BYTES * springs + _LOCAL_BYTES * vertices
    local = OperationCount(moved, _SPRING_FLOPS * springs, moved)
    if "nnz_factor" not in stats:
        return {"local": local}
    entry = _ENTRY_BYTES[precision]
    flops = stats.get("flops_per_solve", 12 * stats["nnz_factor"])
    stored = stats.get("factor_bytes", entry * stats["nnz_factor"])
    whole = OperationCount(flops / 6 * entry + _GLOBAL_BYTES * vertices, flops, stored + _VECTOR_BYTES * vertices)
    both = OperationCount(
        local.bytes_moved + whole.bytes_moved,
        local.flop_count + flops,
        whole.working_set_bytes + _SPRING_BYTES * springs,
    )
    return {"local": local, "global": whole, "iteration": both}

"""Which linear solver for which Q: by its size and by what its factor would need, never by a clock.

The same Q, options and budget give the same choice on every machine: the limits below were measured once, and are
compared with exact counts.
"""

from __future__ import annotations

from typing import Literal, get_args

from scipy.sparse import csr_array

from solvers.linear.factors import Factor, SimplicialCholesky
from solvers.linear.inverse import Inverse
from solvers.linear.supernodal import Supernodal
from solvers.problem import Unsupported

Linear = Literal["auto", "inverse", "cholespy", "supernodal", "cg"]
Precision = Literal["float64", "float32", "float16"]

SMALL = 128
"""Up to so many vertices the inverse is the fastest: 1.4 times at 100 vertices of a sheet, the same at 144, and half
as fast as the supernodal factor at 256 (n^2 entries against n log n)."""


def factorise(Q: csr_array, linear: Linear = "auto", precision: Precision = "float64") -> tuple[Factor, str]:
    """A solver of Q out = b and, in words, which one it is and why.

    With a precision below float64 a solve is only that accurate, and is meant for corrections p - Q^-1 grad.
    Raises Unsupported, NotPositiveDefinite.
    """
    n = len(Q.indptr) - 1
    if linear not in get_args(Linear):
        raise Unsupported(f"linear: {linear!r} is not known; one of {', '.join(get_args(Linear))}")
    name = ("inverse" if n <= SMALL else "supernodal") if linear == "auto" else linear
    why = "as asked" if linear != "auto" else f"{n} vertices, {'at most' if n <= SMALL else 'more than'} {SMALL}"
    if name == "inverse":
        return Inverse(Q, precision="float64" if precision == "float64" else "float32"), f"inverse: {why}"
    if name == "cholespy":
        if precision != "float64":
            raise Unsupported(f"cholespy: is used in float64 alone, not in {precision}; use supernodal")
        return SimplicialCholesky(Q), f"cholespy: {why}"
    return Supernodal(Q, precision=precision), f"supernodal: {why}"  # pyright: ignore[reportArgumentType]

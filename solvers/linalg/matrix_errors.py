"""Errors for a matrix Q that has no Cholesky factor."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from springbench.solvers.model.step_problem import NotPositiveDefinite


def build_definiteness_error(vertex: int | None = None, place: str = "") -> NotPositiveDefinite:
    """Build the error for a Q that is not positive definite.

    Args:
        vertex: the vertex at fault, where it is known.
        place: where it was found, of a matrix that is not Q itself.
    """
    where = "" if vertex is None else f" at vertex {vertex}"
    found = f" ({place})" if place else ""
    return NotPositiveDefinite(
        f"Q = A'KA + M/dt^2 + w C'C is not positive definite in floating point{where}{found}: nothing determines a "
        "position, or stiffnesses, masses and pin weights lie too far apart, or one of them is negative or not finite; "
        "give each connected part a mass or a pin, make all of these positive, or reduce the largest ones",
        () if vertex is None else (vertex,),
    )


def require_finite_rows(Q: csr_array) -> None:
    """Require that all entries of Q are finite.

    Args:
        Q: matrix (n, n).

    Raises:
        NotPositiveDefinite: with the first row that is not finite.
    """
    is_finite = np.isfinite(Q.data)
    if not is_finite.all():
        v = int(np.repeat(np.arange(len(Q.indptr) - 1), np.diff(Q.indptr))[~is_finite][0])
        raise NotPositiveDefinite(
            f"Q is not finite in row {v}: a stiffness, a mass or a pin weight of that vertex is not; make all of them "
            "finite numbers",
            (v,),
        )

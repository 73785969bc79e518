"""Energies that couple all their vertices by a few scalars, as gas does by its volume.

    E = S(p) + phi(c(p)),   Hess E = sparse + V V'

The sparse part may be indefinite although the whole is not. A factorisation is made of the sparse part, and the rest is
added by Woodbury's formula (`solvers.core.low_rank`).
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from scipy.sparse import csr_array

from solvers.problem import Energy, Positions


@runtime_checkable
class Coupled(Energy, Protocol):
    """An energy whose Hessian is sparse plus a product of a few columns."""

    def sparse_hessian(self, p: Positions) -> csr_array:
        """Return the Hessian minus V V' [N/m], shape (3n, 3n)."""
        ...

    def columns(self, p: Positions) -> Positions:
        """Return V [(N/m)^(1/2)], one column for each scalar, shape (n, 3, r)."""
        ...

"""Energies that couple all their vertices by a few numbers of all of them, as gas does by its volume.

    E = S(p) + phi(c(p)),   Hess E = sparse + V V'

The sparse part alone may be indefinite where the whole is not. Who wants a factor takes one of the sparse part, and the
rest by Woodbury's formula (`solvers.core.low_rank`).
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from scipy.sparse import csr_array

from solvers.problem import Energy, Positions


@runtime_checkable
class Coupled(Energy, Protocol):
    """An energy whose Hessian is sparse but for a few columns."""

    def sparse_hessian(self, p: Positions) -> csr_array:
        """The Hessian less V V' [N/m], shape (3n, 3n)."""
        ...

    def columns(self, p: Positions) -> Positions:
        """V [(N/m)^(1/2)], one column for each number, shape (n, 3, r)."""
        ...

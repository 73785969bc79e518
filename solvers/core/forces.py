"""The forces of a system for explicit methods, and a bound of its frequencies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import ArpackError, eigsh

from solvers.core.driver import Iterating
from solvers.energies.quadratic import Quadratic, drag_of_vertices
from solvers.energies.springs import Springs
from solvers.kernels.forms import Form
from solvers.kernels.loop import ITERATIONS, Limits
from solvers.kernels.springs import Bundles
from solvers.memory import aligned
from solvers.problem import Positions, System, Unsupported, is_lagged

_ABOVE = 1.02
"""Margin for the largest eigenvalue, which is approximated from below to one percent."""


def frequency(system: System) -> float:
    """Return a bound of the largest angular frequency [rad/s] of springs and constant forms, with all pins fixed."""
    free = np.flatnonzero(system.unpinned)
    constant = [e for e in system.energies if isinstance(e, (Springs, Quadratic)) and not is_lagged(e)]
    if not len(free) or not constant:
        return 0.0
    K = reduce(add, (e.stiffness_matrix(system.vertices) for e in constant))
    inner = csr_array(K, copy=True) if len(free) == system.vertices else csr_array(csr_array(K[free])[:, free])
    slow = 1.0 / np.sqrt(system.mass[free])
    inner.data *= np.repeat(slow, np.diff(inner.indptr))
    inner.data *= slow[inner.indices]
    rows = float(abs(inner).sum(axis=1).max(initial=0.0))  # Gershgorin
    if len(free) < 20 or not rows:
        most = float(np.linalg.eigvalsh(inner.toarray()).max(initial=0.0))
        return _ABOVE * max(most, 0.0) ** 0.5
    try:
        given = np.random.default_rng(0).normal(size=len(free))
        most = float(eigsh(inner, 1, which="LA", tol=1e-2, v0=given, return_eigenvectors=False)[0])
    except ArpackError:
        return rows**0.5
    return min(_ABOVE * most**0.5, rows**0.5)


@dataclass(frozen=True, eq=False)
class ForceParts:
    """The forces of a system: springs and their packets, a form as in `Forces`, drag (n,) [1/s], load (n, 3) [N].

    The load is the force of the form at the origin.
    """

    springs: Springs
    bundles: Bundles
    pairs: NDArray[np.int64]
    weight: NDArray[np.float64]
    held: NDArray[np.float64]
    drag: NDArray[np.float64]
    load: Positions

    @classmethod
    def of(cls, system: System, solver: str) -> ForceParts:
        """Build the forces; raise Unsupported for energies that are not supported."""
        n = system.vertices
        springs = Springs.joined([energy for energy in system.energies if isinstance(energy, Springs)])
        drag, load, forms = np.zeros(n), np.zeros((n, 3)), list[csr_array]()
        for energy in system.energies:
            if (c := drag_of_vertices(energy)) is not None:
                drag += c
            elif isinstance(energy, Quadratic) and not is_lagged(energy):
                forms.append(energy.stiffness_matrix(n))
                energy.add_projection(load, load)
            elif not isinstance(energy, Springs):
                raise Unsupported(
                    f"{solver}: knows springs, bending and drag on vertices; the scene has {type(energy).__name__} "
                    "as well"
                )
        form = Form.of(csr_array(reduce(add, forms))) if forms else Form.none()
        part = np.where(system.unpinned, 0, -1)
        bundles, _ = Bundles.of(springs, np.arange(n), part, 1, n, n + 1)
        drag = np.divide(drag, system.mass, out=np.zeros(n), where=system.unpinned)
        return cls(
            springs, bundles, form.pairs, form.weight, form.held if form.held.any() else form.held[:0], drag, load
        )


_FAR = 1e100
"""Coordinate of the ends of padding springs, far from any vertex in any unit of length."""


def rows_of_four(x: Positions, *, far: bool = False) -> NDArray[np.float64]:
    """Return x (n, 3) in rows of four, with two padding rows.

    `far` moves the last one away from all vertices.
    """
    out = aligned(4 * (len(x) + 2))
    out.reshape(-1, 4)[: len(x), :3] = x
    if far:
        out[4 * (len(x) + 1)] = _FAR
    return out


class Whole(Iterating):
    """A whole step as the only iterate, repeated."""

    def __init__(self, p: Positions, v: Positions | None) -> None:
        """Create the state with the velocity at the end of the step, or None if it follows from the positions."""
        self.positions, self.velocity = p, v

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        return True

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        return 1, float("nan"), ITERATIONS

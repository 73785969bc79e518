"""Decomposition of a system's energies into springs and terms that the compiled methods compute like springs.

A constant quadratic form (bending, attachments, linear drag) is equivalent to springs of zero rest length between the
vertices that it couples, and a weight of each single vertex (see `solvers.kernels.forms`). So the
kernels of springs compute its forces and its value. Its force at the origin, A'W d, is constant in a step and is added
to the external force. Strain limits and dashpots are edges with their own kernel (see
`solvers.kernels.edges`); in Q they too are springs of zero rest length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers import matrices
from solvers.energies.springs import Springs
from solvers.problem import Energy, Positions, Start, StepProblem, System, is_lagged

if TYPE_CHECKING:
    from solvers.energies.dashpots import Dashpots
    from solvers.energies.strain_limits import StrainLimits
    from solvers.kernels.edges import Edges


@dataclass(frozen=True, eq=False)
class Parts:
    """The decomposition of a system's energies.

    Attributes:
        springs: springs of the system.
        whole: these and the pairs of the forms.
        pairs: all pairs in Q: these and the edges.
        held: weight h of all forms at each vertex (n,) [N/m].
        forms: builders of each form for a step.
        limits, dashpots: edge energies, with k [N/m] of both.
        unknown: names of unsupported energies.
        cancel: whether pairs and springs of some vertices cancel, so that the pattern of Q omits their
            coupling.
    """

    springs: Springs
    whole: Springs
    pairs: Springs
    held: NDArray[np.float64]
    forms: tuple[Callable[[Start], Any], ...] = field(default=())
    limits: tuple[StrainLimits, ...] = field(default=())
    dashpots: tuple[Dashpots, ...] = field(default=())
    unknown: tuple[str, ...] = field(default=())
    cancel: bool = False

    def force(self, problem: StepProblem) -> Positions:
        """Return the external force plus the constant one of the forms, (n, 3) [N]; not a copy without forms."""
        if not self.forms:
            return problem.force
        out = problem.force.copy()
        for form in self.forms:
            form(problem.start).add_projection(problem.target, out)
        return out

    def negative(self, p: Positions) -> float:
        """Return the absolute energy [J] of the pairs with negative stiffness at p (n, 3) [m]."""
        return 0.5 * abs(float(np.einsum("ij,ij->", p, self._negative @ p))) if self.forms else 0.0

    @cached_property
    def _negative(self) -> csr_array:
        below = self.whole.stiffness < 0.0
        return _pairs(self.whole.edges[below], -self.whole.stiffness[below]).stiffness_matrix(len(self.held))

    def edges(self, row: NDArray[np.int64], rows: int) -> Edges | None:
        """Build the strain limits and dashpots as they are before a step; None if there are none.

        Args:
            row: row of each vertex (n,).
            rows: number of rows.
        """
        if not (self.limits or self.dashpots):
            return None
        from solvers.kernels.edges import Edges

        both = (*self.limits, *self.dashpots)
        ends, k = np.concatenate([e.edges for e in both]), np.concatenate([e.stiffness for e in both])
        none = np.empty(0)
        low, high = (np.concatenate([none, *(getattr(e, at) for e in self.limits)]) for at in ("low", "high"))
        edges = Edges.of(ends, k, low, high, row, rows)
        edges.axis[: len(low)] = np.concatenate([none.reshape(0, 3), *(e.rest_direction for e in self.limits)])
        return edges

    def begun(self, edges: Edges | None, problem: StepProblem) -> Edges | None:
        """Return the edges updated to a step."""
        if edges is not None and any(map(is_lagged, self.limits)):
            from solvers.energies.strain_limits import StrainLimits

            limits = [e for e in problem.energies if isinstance(e, StrainLimits)]
            low, high = (np.concatenate([getattr(e, at) for e in limits]) for at in ("low", "high"))
            edges = edges._replace(low=low, high=high)
        if edges is None or not self.dashpots:
            return edges
        from solvers.energies.dashpots import Dashpots

        steps, first = [e for e in problem.energies if isinstance(e, Dashpots)], len(edges.low)
        axis, offset = edges.axis.copy(), edges.offset.copy()
        axis[first:] = np.concatenate([e.direction for e in steps])
        offset[first:] = np.concatenate([e.offset for e in steps])
        return edges._replace(axis=axis, offset=offset)

    def size(self, p: Positions) -> float:
        """Return the sum of k |v|^2 [J] over strain limits and dashpots at p (n, 3), the scale of cancellation."""
        return sum(float(e.stiffness @ e.lengths(p) ** 2) for e in (*self.limits, *self.dashpots))


def split(system: System) -> Parts:
    """Decompose the energies of a system."""
    n = system.vertices
    springs = Springs.joined([energy for energy in system.energies if isinstance(energy, Springs)])
    others = [energy for energy in system.energies if not isinstance(energy, Springs)]
    if not others:
        return Parts(springs, springs, springs, np.zeros(n))
    from solvers.energies.dashpots import Dashpots  # for those who need one of them
    from solvers.energies.quadratic import Quadratic
    from solvers.energies.strain_limits import StrainLimits
    from solvers.kernels.forms import Form

    forms = [energy for energy in others if isinstance(energy, Quadratic)]
    limits = tuple(energy for energy in others if isinstance(energy, StrainLimits))
    dashpots = tuple(
        replace(energy, stiffness=system.rate * energy.stiffness) for energy in others if isinstance(energy, Dashpots)
    )
    known = Quadratic, StrainLimits, Dashpots
    unknown = tuple(sorted({type(energy).__name__ for energy in others if not isinstance(energy, known)}))
    L: csr_array = reduce(lambda total, share: total + share, matrices.shares(system, forms), csr_array((n, n)))
    form = Form.of(L)
    whole = Springs.joined([springs, _pairs(form.pairs, form.weight)])
    edges = [_pairs(energy.edges, energy.stiffness) for energy in (*limits, *dashpots)]
    pairs = Springs.joined([whole, *edges])
    K = Springs.joined([springs, *edges]).stiffness_matrix(n)
    return Parts(
        springs,
        whole,
        pairs,
        form.held,
        tuple(form.begin_step if is_lagged(form) else _steady(form) for form in forms),
        limits,
        dashpots,
        unknown,
        matrices.without_zeros(K + L).nnz < matrices.without_zeros(abs(K) + abs(L)).nnz,
    )


def _pairs(edges: NDArray[np.int64], stiffness: NDArray[np.float64]) -> Springs:
    """Return springs of zero rest length."""
    flat = np.zeros(len(stiffness))
    return Springs(edges, stiffness, flat, flat[:, None] + [1.0, 0.0, 0.0])


def _steady(form: Energy) -> Callable[[Start], Energy]:
    return lambda start: form

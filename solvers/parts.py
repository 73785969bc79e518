"""What the compiled methods make of a system's energies: springs, and what may be computed as springs.

A constant quadratic form (bending, attachments, linear drag) is springs without length between the vertices that it
couples, and what holds each vertex by itself:

    x'Lx/2 = sum over i < j of w_ij/2 |x_i - x_j|^2 + sum over i of h_i/2 |x_i|^2,     w_ij = -L_ij,  h = L 1

So the kernels of springs add up its forces and its value, from differences of positions, which keep their digits. Where
it couples more than neighbours, as bending does, some w are negative. Its force at the origin, A'W d, is constant in a
step: one more external force.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, triu

from solvers import matrices
from solvers.energies.springs import Springs
from solvers.problem import Energy, LaggedEnergy, Positions, Start, StepProblem, System

_ROUND_OFF = 1e-13
"""Of the sum of a row's absolute values, what its sum may be and still count as zero: a dozen terms' round-off."""


@dataclass(frozen=True, eq=False)
class Parts:
    """springs: those of the system; whole: those, and the forms' pairs; held: h of all forms (n,) [N/m]; forms: each in
    a step; unknown: the names of energies that are in none of these; cancel: whether the pairs and the springs of some
    vertices cancel, so that Q does not tell that they meet."""

    springs: Springs
    whole: Springs
    held: NDArray[np.float64]
    forms: tuple[Callable[[Start], Any], ...] = field(default=())
    unknown: tuple[str, ...] = field(default=())
    cancel: bool = False

    def force(self, problem: StepProblem) -> Positions:
        """The external force and what is constant of the forms', (n, 3) [N]; the problem's own array without forms."""
        if not self.forms:
            return problem.force
        out = problem.force.copy()
        for form in self.forms:
            form(problem.start).add_projection(problem.target, out)
        return out

    def negative(self, p: Positions) -> float:
        """What pairs of negative stiffness take from the value of the others at p (n, 3) [J], not negative."""
        below = self.whole.stiffness < 0.0
        i, j = self.whole.edges[below].T
        v = p[i] - p[j]
        return -0.5 * float(self.whole.stiffness[below] @ np.einsum("ij,ij->i", v, v))


def split(system: System) -> Parts:
    """The parts of a system's energies."""
    n = system.vertices
    springs = Springs.joined([energy for energy in system.energies if isinstance(energy, Springs)])
    others = [energy for energy in system.energies if not isinstance(energy, Springs)]
    if not others:
        return Parts(springs, springs, np.zeros(n))
    from solvers.energies.quadratic import Quadratic  # for those who need it

    forms = [energy for energy in others if isinstance(energy, Quadratic)]
    unknown = tuple(sorted({type(energy).__name__ for energy in others if not isinstance(energy, Quadratic)}))
    L: csr_array = reduce(lambda total, share: total + share, matrices.shares(system, forms), csr_array((n, n)))
    above = coo_array(triu(L, 1))
    flat = np.zeros(above.nnz)
    edges = np.column_stack(above.coords).astype(np.int64)
    pairs = Springs(edges, -np.asarray(above.data, np.float64), flat, flat[:, None] + [1.0, 0.0, 0.0])
    held, size = L.sum(axis=1), abs(L).sum(axis=1)
    K = springs.stiffness_matrix(n)
    return Parts(
        springs,
        Springs.joined([springs, pairs]),
        np.where(abs(held) <= _ROUND_OFF * size, 0.0, held),
        tuple(form.begin_step if isinstance(form, LaggedEnergy) else _steady(form) for form in forms),
        unknown,
        matrices.without_zeros(K + L).nnz < matrices.without_zeros(abs(K) + abs(L)).nnz,
    )


def _steady(form: Energy) -> Callable[[Start], Energy]:
    return lambda start: form

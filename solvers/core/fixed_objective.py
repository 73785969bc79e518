"""The terms of the objective that do not change from step to step: springs, constant forms, Hessian pattern.

The degrees of freedom are the free vertices. The matrix of the Hessian is analysed once
(`solvers.core.pattern`), and terms that are constant in a run are summed once.
"""

from __future__ import annotations

from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers import matrices
from solvers.core.pattern import Matrix
from solvers.energies.elements import Elements, Law
from solvers.energies.springs import Springs
from solvers.kernels import hessian, objective
from solvers.kernels.forms import Form
from solvers.problem import Energy, ProjectiveEnergy, System, is_lagged


class Stated(NamedTuple):
    """An energy with an element-wise form in one step: its index in the system, its law and its elements."""

    number: int
    projective: bool
    law: Law
    elements: Elements


class Objective:
    """The parts of a system's objective that do not change from step to step.

    Attributes:
        stated: indices of energies with an element-wise form.
        own: indices of energies without one.
        moving: indices of quadratic forms with a force, or with one that changes from step to step.
        projective: indices of projective energies other than springs.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.springs = Springs.joined([e for e in system.energies if isinstance(e, Springs)])
        self.terms = objective.Terms.of(system, self.springs)
        self.form: Form | None = None
        self.moving: list[int] = []
        self.stated: list[int] = []
        self.own: list[int] = []
        self.projective: set[int] = set()
        others = {k: e for k, e in enumerate(system.energies) if not isinstance(e, Springs)}
        if others:
            self._sort(others)
        self._grown: Matrix | None = None

    def _sort(self, others: dict[int, Energy]) -> None:
        """Classify the energies that are not springs."""
        from solvers.energies.quadratic import Quadratic  # for those who need it

        quadratic = {k: e for k, e in others.items() if isinstance(e, Quadratic)}
        if quadratic:
            n = self.system.vertices
            shares = matrices.shares(self.system, quadratic.values())
            self.form = Form.of(reduce(lambda total, share: total + share, shares, csr_array((n, n))))
        self.moving = [k for k, e in quadratic.items() if is_lagged(e) or e.d.any()]
        rest = {k: e for k, e in others.items() if k not in quadratic}
        self.stated = [k for k, e in rest.items() if hasattr(e, "law")]
        self.own = [k for k in rest if k not in self.stated]
        self.projective = {k for k, e in others.items() if isinstance(e, ProjectiveEnergy)}

    @property
    def interpreted(self) -> str:
        """Energies without an element-wise form, which run through Python, as words to append to a description.

        It is empty if there are none.
        """
        names = sorted({type(self.system.energies[k]).__name__ for k in self.own})
        return f"; each iteration goes through Python for {', '.join(names)}" if names else ""

    @cached_property
    def matrix(self) -> Matrix:
        """The Hessian's matrix, for the pattern of springs, projective energies and elements."""
        n, s = self.system.vertices, self.system
        shares = (e.stiffness_matrix(n) for e in s.energies if isinstance(e, ProjectiveEnergy))
        pattern = reduce(lambda total, share: total + abs(share), shares, matrices.diagonal(np.ones(n)))
        free = csr_array(csr_array(pattern[s.free])[:, s.free])
        known: list[Any] = [s.energies[k].elements for k in self.stated]  # pyright: ignore[reportAttributeAccessIssue]
        ends = [self.springs.edges, *(pairs(elements.vertices) for elements in known)]
        if self.form is not None:
            ends.append(self.form.pairs)
        i, j = np.concatenate(ends).T  # what has no stiffness, or cancels, keeps its places
        return self._matrix(free, self.number[i], self.number[j])

    @cached_property
    def number(self) -> NDArray[np.int64]:
        """Index of each vertex among the free ones, -1 for the others, (n + 1,).

        The last entry is that of the vertex -1, which means none.
        """
        number = np.full(self.system.vertices + 1, -1)
        number[self.system.free] = np.arange(len(self.system.free))
        return number

    def between(self, vertices: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return all pairs of different free vertices within each row (a, k), by free index, unique and ascending."""
        (a, k), size = vertices.shape, len(self.system.free)
        keys = np.empty(a * k * (k - 1) // 2, np.int64)
        return np.divmod(np.unique(keys[: hessian.meetings(self.number, size, vertices, keys)]), size)

    def _matrix(self, graph: csr_array, i: NDArray[np.int64], j: NDArray[np.int64]) -> Matrix:
        return Matrix.of(self.system, self.terms, self.form, self.number, graph, i, j)

    def matrix_for(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> Matrix:
        """Return a matrix that also has blocks (i, j) of free vertices."""
        for known in (self.matrix, self._grown):
            if known is not None and known.has(i, j) and (known is self.matrix or known.needs(i, j, self.matrix)):
                return known
        self._grown = self._matrix(self.matrix.graph, i, j)
        return self._grown


def pairs(vertices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return all vertex pairs of each element (m, k), as rows (m k^2, 2)."""
    k = vertices.shape[1]
    return np.column_stack([np.repeat(vertices, k, axis=1).ravel(), np.tile(vertices, k).ravel()])

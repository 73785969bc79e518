"""The objective of a step, its gradient and its Hessian, evaluated fast; `StepProblem` stays the oracle.

All springs are one compiled pass, other energies bring their own value, gradient and Hessian. The unknowns are the free
vertices: exactly pinned ones stay on their targets. The Hessian's blocks lie where springs and projective energies
have theirs, in a matrix analysed once; where another energy needs more (contact), the pattern of the day is analysed
and kept for as long as it lasts, so that a result depends on the positions alone and not on what came before.
"""

from __future__ import annotations

from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from solvers import matrices
from solvers.energies.springs import Springs
from solvers.kernels import hessian, objective
from solvers.linear.block import BlockCholesky
from solvers.problem import Energy, Positions, ProjectiveEnergy, StepProblem, System

_ROUND_OFF = 4.0 * np.finfo(np.float64).eps
"""Of an energy's value, beside its size."""

_NEAR = 1e-10
"""Of that size, the change from which on its values tell less than its slopes do."""


class Objective:
    """The objective of a system's steps: what does not change from step to step."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.springs = Springs.joined([e for e in system.energies if isinstance(e, Springs)])
        self.terms = objective.Terms.of(system, self.springs)
        self._grown: Matrix | None = None

    @cached_property
    def matrix(self) -> Matrix:
        """The Hessian's matrix for the pattern of springs and projective energies."""
        n, s = self.system.vertices, self.system
        shares = (e.stiffness_matrix(n) for e in s.energies if isinstance(e, ProjectiveEnergy))
        pattern = reduce(lambda total, share: total + abs(share), shares, matrices.diagonal(np.ones(n)))
        free = csr_array(csr_array(pattern[s.free])[:, s.free])
        i, j = self.springs.edges.T  # springs of no stiffness, or that cancel, keep their places
        return self._matrix(free, self.number[i], self.number[j])

    @cached_property
    def number(self) -> NDArray[np.int64]:
        """The number of each vertex among the free ones, -1 for the others, (n,)."""
        number = np.full(self.system.vertices, -1)
        number[self.system.free] = np.arange(len(self.system.free))
        return number

    def _matrix(self, graph: csr_array, i: NDArray[np.int64], j: NDArray[np.int64]) -> Matrix:
        """A matrix with the blocks of a graph and those between vertices i and j, both ways, where both are free."""
        i, j = i[(i >= 0) & (j >= 0)], j[(i >= 0) & (j >= 0)]
        ones = np.ones(2 * len(i))
        more = csr_array(coo_array((ones, (np.append(i, j), np.append(j, i))), shape=graph.shape))
        return Matrix(self.system, self.springs.edges, matrices.without_zeros(abs(graph) + more))

    def matrix_for(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Matrix:
        """A matrix with places for entries (rows, columns) of free coordinates too."""
        i, j = rows // 3, columns // 3
        for known in (self.matrix, self._grown):
            if known is not None and known.has(i, j) and (known is self.matrix or known.needs(i, j, self.matrix)):
                return known
        self._grown = self._matrix(self.matrix.graph, i, j)
        return self._grown


class Matrix:
    """A matrix of 3 x 3 blocks between free vertices: where its entries are, and its factorisation."""

    def __init__(self, system: System, edges: NDArray[np.int64], graph: csr_array) -> None:
        """graph: its pattern of blocks (f, f), sorted, with a diagonal."""
        self.graph, self._size = graph, len(system.free)
        self.values = np.empty((graph.nnz, 3, 3))
        self.factor = BlockCholesky(graph)
        self.places = hessian.Places.of(system, edges, graph)
        rows = np.repeat(np.arange(len(graph.indptr) - 1), np.diff(graph.indptr))
        self._keys = rows * self._size + graph.indices
        self.diagonal = self.entries(*np.tile(np.arange(3 * len(system.free)), (2, 1)))

    def has(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> bool:
        """Whether it has the blocks (i, j)."""
        return bool(np.isin(i * self._size + j, self._keys).all())

    def needs(self, i: NDArray[np.int64], j: NDArray[np.int64], base: Matrix) -> bool:
        """Whether it has no blocks but those of another, and (i, j) or (j, i)."""
        size = self._size
        return len(np.unique(np.concatenate([base._keys, i * size + j, j * size + i]))) == len(self._keys)

    def entries(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Where the entries (rows, columns) lie among its values."""
        block = np.searchsorted(self._keys, rows // 3 * self._size + columns // 3)
        return 9 * block + 3 * (rows % 3) + columns % 3


class StepObjective:
    """The objective g of one step: all positions are (n, 3) [m], exactly pinned vertices on their targets."""

    def __init__(self, whole: Objective, problem: StepProblem) -> None:
        self.whole, self.problem = whole, problem
        self._given = objective.Given.of(problem)
        self.others: list[Energy] = [e for e in problem.energies if not isinstance(e, Springs)]
        pins = problem.system.pins
        self._exact, self._held = pins.vertices[pins.exact], problem.pin_targets[pins.exact]

    def placed(self, p: Positions) -> Positions:
        """A copy of p with the exactly pinned vertices on their targets."""
        out = np.array(p, np.float64, order="C")
        out[self._exact] = self._held
        return out

    def fall(self) -> Positions:
        """Free fall (n, 3): where inertia and forces alone would lead, pinned vertices on their targets."""
        problem, h = self.problem, self.problem.system.inertia[:, None]
        p = problem.target + np.divide(problem.force, h, out=np.zeros_like(problem.force), where=h > 0.0)
        p[problem.system.pins.vertices] = problem.pin_targets
        return p

    def gradient(self, p: Positions) -> Positions:
        """The gradient [N], (n, 3), zero at exactly pinned vertices."""
        out = np.empty_like(p)
        objective.gradient(self.whole.terms, self._given, p, out)
        for energy in self.others:
            energy.add_gradient(p, out)
        out[self._exact] = 0.0
        return out

    def rise(self, p: Positions, q: Positions) -> tuple[float, float]:
        """g(q) - g(p) [J], and what of it may be round-off of the energies that are not springs.

        Theirs is the difference of their values, or the mean slope where that difference has lost its digits.
        """
        change, noise = objective.rise(self.whole.terms, self._given, p, q), 0.0
        for energy in self.others:
            before, after = energy.value(p), energy.value(q)
            slope = np.zeros_like(q)
            energy.add_gradient(q, slope)
            scale = abs(before) + abs(after) + float(np.abs(slope * q).sum())
            if abs(after - before) <= _NEAR * scale < np.inf:
                energy.add_gradient(p, slope)
                change += 0.5 * float((slope * (q - p)).sum())
            else:
                change += after - before
                noise += _ROUND_OFF * scale
        return change, noise

    def tensions(self, p: Positions, d: Positions) -> NDArray[np.float64]:
        """The springs' tensions [N], (m,), at p, linearised for a step d."""
        out = np.empty(len(self.whole.terms.stiffness))
        hessian.tensions(self.whole.terms, p, d, out)
        return out

    def hessian(self, p: Positions) -> Hessian:
        """The Hessian at p, to be factorised."""
        return Hessian(self, p)


class Hessian:
    """The Hessian [N/m] at a point, over the coordinates of free vertices."""

    def __init__(self, step: StepObjective, p: Positions) -> None:
        self._step, self._p = step, p
        self._terms, self._free = step.whole.terms, step.whole.system.free
        parts = [csr_array(energy.hessian(p)) for energy in step.others]
        self._others = reduce(lambda a, b: csr_array(a + b), parts) if parts else None

    @cached_property
    def _placed(self) -> tuple[Matrix, NDArray[np.int64], NDArray[np.float64]]:
        """The matrix, and where in it which entries of the energies that are not springs go."""
        whole = self._step.whole
        if self._others is None:
            return whole.matrix, np.empty(0, np.int64), np.empty(0)
        total = self._others.tocoo()
        rows, columns = (3 * whole.number[x // 3] + x % 3 for x in total.coords)
        inside = (rows >= 0) & (columns >= 0)
        rows, columns = rows[inside], columns[inside]
        matrix = whole.matrix_for(rows, columns)
        return matrix, matrix.entries(rows, columns), np.asarray(total.data[inside], np.float64)

    def factorise(
        self,
        keep: float = 1.0,
        shift: NDArray[np.float64] | float = 0.0,
        tension: NDArray[np.float64] | None = None,
    ) -> bool:
        """Whether it is positive definite, and then ready for `solve`; without arguments it is the exact Hessian.

        keep: of the negative lateral part of springs; shift: added to the diagonal [N/m]; tension (m,): of springs [N].
        """
        matrix = self._assembled(keep, shift, tension)
        return matrix.factor.factorise(matrix.values)

    def solve_anew(
        self,
        b: Positions,
        keep: float = 1.0,
        shift: NDArray[np.float64] | float = 0.0,
        tension: NDArray[np.float64] | None = None,
    ) -> Positions | None:
        """Both at once, sooner than one after the other; None if it is not positive definite."""
        matrix, out = self._assembled(keep, shift, tension), np.zeros_like(b)
        x = matrix.factor.solve_anew(matrix.values, b[self._free])
        if x is None:
            return None
        out[self._free] = x
        return out

    def _assembled(
        self, keep: float, shift: NDArray[np.float64] | float, tension: NDArray[np.float64] | None
    ) -> Matrix:
        matrix, places, entries = self._placed
        tension = self._tension if tension is None else tension
        hessian.assemble(self._terms, matrix.places, self._p, tension, keep, matrix.values)
        values = matrix.values.reshape(-1)
        values[places] += entries
        values[matrix.diagonal] += shift
        return matrix

    def solve(self, b: Positions) -> Positions:
        """Its inverse, as it was factorised last, times b (n, 3); zero at vertices that are not free."""
        out = np.zeros_like(b)
        out[self._free] = self._placed[0].factor.solve(b[self._free])
        return out

    @cached_property
    def _tension(self) -> NDArray[np.float64]:
        return self._step.tensions(self._p, np.zeros_like(self._p))

    @cached_property
    def _linear(self) -> NDArray[np.float64]:
        linear = np.empty((len(self._terms.stiffness), 4))
        hessian.linearise(self._terms, self._p, linear)
        return linear

    def multiply(self, x: Positions) -> Positions:
        """The exact Hessian times x (n, 3), which is zero at vertices that are not free; so is the product."""
        product, out = np.empty_like(x), np.zeros_like(x)
        hessian.multiply(self._terms, self._linear, x, product)
        if self._others is not None:
            product += (self._others @ x.ravel()).reshape(-1, 3)
        out[self._free] = product[self._free]
        return out

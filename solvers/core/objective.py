"""The objective of a step, its gradient and its Hessian, evaluated fast; `StepProblem` stays the oracle.

All springs are one compiled pass, all constant quadratic forms another, and so is each energy that states the law of
its elements (`solvers.energies.elements`); what states none brings its own value, gradient and Hessian. The unknowns
are the free vertices: exactly pinned ones stay on their targets. The Hessian's blocks lie in a matrix that is analysed
once, or once a step (`core.pattern`, `core.pairs_matrix`); what does not change in a run or a step is added up once.
"""

from __future__ import annotations

from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.core import low_rank
from solvers.core.bounds import Bounded, is_bounded, reach
from solvers.core.eigenvalues import Filtered, Filtering
from solvers.core.fixed_objective import Objective, Stated
from solvers.core.pairs_matrix import PairsAt, StepMatrix
from solvers.core.pattern import Indices, Matrix
from solvers.energies.elements import Joined, add_blocks
from solvers.kernels import forms, hessian, objective
from solvers.linear.block import BlockCholesky
from solvers.problem import Energy, Positions, StepProblem

Values = NDArray[np.float64]

ROUND_OFF = 4.0 * np.finfo(np.float64).eps
"""Of an energy's value, beside its size."""

NEAR = 1e-10
"""Of that size, the change from which on its values tell less than its slopes do."""


class StepObjective:
    """The objective g of one step: all positions are (n, 3) [m], exactly pinned vertices on their targets.

    stated: energies by their elements, less those that have none in this step; own: those that state nothing; bounded:
    of these, what no step may pass through; matrix: that of its Hessians.
    """

    def __init__(self, whole: Objective, problem: StepProblem) -> None:
        """problem: of a system that has the whole's energies, in their order. Raises ValueError for others."""
        if len(problem.system.energies) != len(whole.system.energies):
            raise ValueError("the objective was made for a system of other energies than the step's")
        self.whole, self.problem = whole, problem
        self.given = objective.Given.of(problem)
        self.stated: list[Stated] = []
        self.own: list[Energy] = []
        self.bounded: list[Bounded] = []
        if whole.form is not None or whole.stated or whole.own:
            begun: Any = problem.energies
            for k in whole.moving:
                begun[k].add_projection(problem.target, self.given.force)
            found = (Stated(k, k in whole.projective, begun[k].law, begun[k].elements) for k in whole.stated)
            self.stated = [one for one in found if len(one.elements.vertices)]
            self.own = [begun[k] for k in whole.own]
            self.bounded = [energy for energy in self.own if is_bounded(energy)]
        self._constant: tuple[Matrix, Values] | None = None
        self.matrix = StepMatrix(whole, self.bounded)
        pins = problem.system.pins
        self._exact, self._held = pins.vertices[pins.exact], problem.pin_targets[pins.exact]

    @property
    def touched(self) -> bool:
        """Whether elements act that are in no Q: those of contact, where something may be touched in this step."""
        return any(not one.projective for one in self.stated)

    def reach(self, p: Positions, direction: Positions, first: float = 1.0) -> float:
        """The largest t up to `first` by which p may go along a direction, both (n, 3); see `solvers.core.bounds`."""
        return (
            first * reach(self.bounded, p, direction if first == 1.0 else first * direction) if self.bounded else first
        )

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
        objective.gradient(self.whole.terms, self.given, p, out)
        if self.whole.form is not None:
            forms.add_gradient(self.whole.form, p, out)
        for one in self.stated:
            one.law.add_gradient(one.elements, p, out)
        for energy in self.own:
            energy.add_gradient(p, out)
        out[self._exact] = 0.0
        return out

    def rise(self, p: Positions, q: Positions) -> tuple[float, float]:
        """g(q) - g(p) [J], and what of it may be round-off of the energies that state nothing.

        Theirs is the difference of their values, or the mean slope where that difference has lost its digits.
        """
        change, noise = objective.rise(self.whole.terms, self.given, p, q), 0.0
        if self.whole.form is not None:
            change += forms.rise(self.whole.form, p, q)
        for one in self.stated:
            change += one.law.rise(one.elements, p, q)
        for energy in self.own:
            before, after = energy.value(p), energy.value(q)
            if before == after == 0.0 and is_bounded(energy):
                continue  # nothing is in range, at either
            slope = np.zeros_like(q)
            energy.add_gradient(q, slope)
            scale = abs(before) + abs(after) + float(np.abs(slope * q).sum())
            if abs(after - before) <= NEAR * scale < np.inf:
                energy.add_gradient(p, slope)
                change += 0.5 * float((slope * (q - p)).sum())
            else:
                change += after - before
                noise += ROUND_OFF * scale
        return change, noise

    def tensions(self, p: Positions, d: Positions) -> Values:
        """The springs' tensions [N], (m,), at p, linearised for a step d."""
        out = np.empty(len(self.whole.terms.stiffness))
        hessian.tensions(self.whole.terms, p, d, out)
        return out

    def hessian(self, p: Positions) -> Hessian:
        """The Hessian at p, to be factorised."""
        return Hessian(self, p)

    def curvature(self, p: Positions) -> list[Values]:
        """The second derivatives of the elements at p, of each energy (m, 6) [N/m]."""
        return [self._curve(one, p) for one in self.stated]

    @staticmethod
    def _curve(one: Stated, p: Positions) -> Values:
        out = np.empty((len(one.elements.vertices), 6))
        one.law.curve(one.elements, p, out)
        return out

    def constant(self, matrix: Matrix, p: Positions) -> Values | None:
        """The blocks of a matrix that are the same at all points p of this step; None for springs alone."""
        steady = [one for one in self.stated if one.law.constant]
        if not steady:
            return matrix.constant if self.whole.form is not None else None
        if self._constant is None or self._constant[0] is not matrix:
            blocks = matrix.constant.copy()
            for one in steady:
                places = matrix.of_elements(one.number, one.elements.vertices)
                add_blocks(one.elements, places, self._curve(one, p), blocks)
            self._constant = matrix, blocks
        return self._constant[1]

    @cached_property
    def joined(self) -> Joined | None:
        """The elements of all energies, None for none."""
        return Joined.of([one.elements for one in self.stated]) if self.stated else None


class Hessian:
    """The Hessian [N/m] at a point, over the free vertices (f,). curvature, met: those of elements, and of pairs."""

    def __init__(self, step: StepObjective, p: Positions) -> None:
        self._step, self._p = step, p
        self._terms, self.free = step.whole.terms, step.whole.system.free
        parts = [low_rank.sparse_part(energy, p) for energy in step.own if energy not in step.bounded]
        self._columns = low_rank.columns(step.own, p) if step.own else None
        self._others = reduce(lambda a, b: csr_array(a + b), parts) if parts else None
        self.curvature = step.curvature(p)
        self.met = PairsAt(step.bounded, p)

    @cached_property
    def _placed(self) -> tuple[Matrix, Indices, Values]:
        """The matrix, and where in it which entries of the energies that state nothing go."""
        step, whole = self._step, self._step.whole
        rows, columns, entries = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
        if self._others is not None:
            total = self._others.tocoo()
            rows, columns = (3 * whole.number[x // 3] + x % 3 for x in total.coords)
            inside = (rows >= 0) & (columns >= 0)
            rows, columns, entries = rows[inside], columns[inside], np.asarray(total.data[inside], np.float64)
        matrix = step.matrix.at(self._p, rows // 3, columns // 3, self.met.coupled)
        return matrix, matrix.entries(rows, columns), entries

    def factorise(self, keep: float = 1.0, shift: Values | float = 0.0, tension: Values | None = None) -> bool:
        """Whether it is positive definite, and then ready for `solve`; without arguments it is the exact Hessian.

        keep: of the negative lateral part of springs; shift: added to the diagonal [N/m]; tension (m,): of springs [N].
        """
        return self._factor.factorise(self._assembled(keep, shift, tension).values)

    def filtered(self, by: Filtering) -> Filtered:
        """The same with its elements filtered by their eigenvalues; constant forms have none below zero."""
        keep, tension = by.springs(self._terms.edges, self._tension)
        stated = zip(self._step.stated, self.curvature, strict=True)
        curvature = [c if one.law.constant else by.packed(one.elements.vertices, c) for one, c in stated]
        pairs = [by.pairs(blocks) for blocks in self.met.blocks]
        return Filtered(keep, tension, curvature, pairs, by.looked, by.changed)

    def convex(self) -> Matrix:
        """The Hessian with its elements' negative eigenvalues clamped, until it is assembled again."""
        clamped = self.filtered(Filtering())
        return self._assembled(clamped.keep, 0.0, clamped.tension, clamped)

    def factorise_filtered(self, filtered: Filtered, shift: Values | float = 0.0) -> bool:
        """Whether what was filtered, and `shift` added to its diagonal [N/m], is positive definite; see `factorise`."""
        return self._factor.factorise(self._assembled(filtered.keep, shift, filtered.tension, filtered).values)

    def solve_anew(
        self, b: Positions, keep: float = 1.0, shift: Values | float = 0.0, tension: Values | None = None
    ) -> Positions | None:
        """Both at once, sooner than one after the other; None if it is not positive definite."""
        out = np.zeros_like(b)
        x = self._factor.solve_anew(self._assembled(keep, shift, tension).values, b[self.free])
        if x is None:
            return None
        out[self.free] = x
        return out

    def _assembled(
        self, keep: float, shift: Values | float, tension: Values | None, filtered: Filtered | None = None
    ) -> Matrix:
        matrix, places, entries = self._placed
        step, tension = self._step, self._tension if tension is None else tension
        constant = step.constant(matrix, self._p)
        hessian.assemble(self._terms, matrix.places, constant, self._p, tension, keep, matrix.values)
        elements = filtered.curvature if filtered else self.curvature
        for one, curvature in zip(step.stated, elements, strict=True):
            if not one.law.constant:
                at = matrix.of_elements(one.number, one.elements.vertices)
                add_blocks(one.elements, at, curvature, matrix.values)
        for k, blocks in enumerate(filtered.pairs if filtered else []):
            blocks.add(matrix.of_elements(-1 - k, blocks.vertices), matrix.values)
        if not filtered:
            self.met.add(keep, matrix)
        values = matrix.values.reshape(-1)
        values[places] += entries
        values[matrix.diagonal] += shift
        return matrix

    def solve(self, b: Positions) -> Positions:
        """Its inverse, as it was factorised last, times b (n, 3); zero at vertices that are not free."""
        out = np.zeros_like(b)
        out[self.free] = self._factor.solve(b[self.free])
        return out

    @cached_property
    def _factor(self) -> BlockCholesky | low_rank.Woodbury:
        matrix = self._placed[0]
        return matrix.factor if self._columns is None else low_rank.Woodbury(matrix, self._columns[self.free])

    @cached_property
    def _tension(self) -> Values:
        return self._step.tensions(self._p, np.zeros_like(self._p))

    @cached_property
    def _linear(self) -> Values:
        linear = np.empty((len(self._terms.stiffness), 4))
        hessian.linearise(self._terms, self._p, linear)
        return linear

    @cached_property
    def compiled(self) -> tuple[Any, ...]:
        """What `solvers.kernels.hessian.multiply` needs of it: all but the energies that state nothing."""
        step = self._step
        curvature = np.concatenate(self.curvature) if self.curvature else None
        return self._terms, self._linear, step.whole.form, step.joined, curvature

    def multiply(self, x: Positions) -> Positions:
        """The exact Hessian times x (n, 3), which is zero at vertices that are not free; so is the product."""
        product, out = np.empty_like(x), np.zeros_like(x)
        hessian.multiply(*self.compiled, x, product)
        if self._others is not None:
            product += (self._others @ x.ravel()).reshape(-1, 3)
        if self._columns is not None:
            product += self._columns @ np.einsum("nik,ni->k", self._columns, x)
        for pairs in self.met.blocks:
            pairs.add_product(x, product)
        out[self.free] = product[self.free]
        return out

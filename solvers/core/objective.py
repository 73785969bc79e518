"""The objective of a step, its gradient and its Hessian, evaluated fast; `StepProblem` is the reference evaluator.

One compiled pass evaluates all springs, another all constant quadratic forms, and one each energy with an element-wise
form (`solvers.energies.elements`). Other energies supply their own value, gradient and Hessian. The
degrees of freedom are the free vertices: exactly pinned ones stay on their targets. The matrix of the Hessian is
analysed once, or once per step (`hessian_pattern`, `matrix`). Terms that are constant in a run or a step are
summed once.
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
"""Relative rounding error of an energy's value."""

NEAR = 1e-10
"""Relative change of an energy below which the mean slope is more accurate than the difference of values."""


class StepObjective:
    """The objective g of one step. All positions are (n, 3) [m], with exactly pinned vertices on their targets.

    Attributes:
        stated: energies with an element-wise form, except those without elements in this step.
        own: energies without an element-wise form.
        bounded: barrier energies among these, which limit the step size.
        matrix: the matrix of the Hessians.
    """

    def __init__(self, whole: Objective, problem: StepProblem) -> None:
        """Build the objective of a problem; raise ValueError if its system has another number of energies."""
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
        """Whether elements act that are not part of Q, i.e. those of contact that may become active in this step."""
        return any(not one.projective for one in self.stated)

    def reach(self, p: Positions, direction: Positions, first: float = 1.0) -> float:
        """Return the largest collision-free step size up to `first`.

        It is that from p along the search direction, both (n, 3); see `barrier_energy`.
        """
        return (
            first * reach(self.bounded, p, direction if first == 1.0 else first * direction) if self.bounded else first
        )

    def placed(self, p: Positions) -> Positions:
        """Return a copy of p with the exactly pinned vertices on their targets."""
        out = np.array(p, np.float64, order="C")
        out[self._exact] = self._held
        return out

    def fall(self) -> Positions:
        """Return the positions (n, 3) under inertia and external force alone, pinned vertices on their targets."""
        problem, h = self.problem, self.problem.system.inertia[:, None]
        p = problem.target + np.divide(problem.force, h, out=np.zeros_like(problem.force), where=h > 0.0)
        p[problem.system.pins.vertices] = problem.pin_targets
        return p

    def gradient(self, p: Positions) -> Positions:
        """Return the gradient [N], (n, 3), zero at exactly pinned vertices."""
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
        """Return g(q) - g(p) [J], and the part that may be round-off of energies without an element-wise form.

        Such an energy contributes the difference of its values, or the mean slope if that difference is cancelled.
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
        """Return the springs' tensions [N], (m,), at p, linearised for a displacement d."""
        out = np.empty(len(self.whole.terms.stiffness))
        hessian.tensions(self.whole.terms, p, d, out)
        return out

    def hessian(self, p: Positions) -> Hessian:
        """Build the Hessian at p for a factorisation."""
        return Hessian(self, p)

    def curvature(self, p: Positions) -> list[Values]:
        """Return the second derivatives of the elements at p, (m, 6) [N/m] for each energy."""
        return [self._curve(one, p) for one in self.stated]

    @staticmethod
    def _curve(one: Stated, p: Positions) -> Values:
        out = np.empty((len(one.elements.vertices), 6))
        one.law.curve(one.elements, p, out)
        return out

    def constant(self, matrix: Matrix, p: Positions) -> Values | None:
        """Return the matrix blocks that do not depend on the point p of this step; None for springs alone."""
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
        """The elements of all energies in one set; None if there are none."""
        return Joined.of([one.elements for one in self.stated]) if self.stated else None


class Hessian:
    """The Hessian [N/m] at a point, over the free vertices (f,), with the blocks of elements and of collisions."""

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
        """The matrix, and the places and values in it of energies without an element-wise form."""
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
        """Factorise the Hessian and return whether it is positive definite; the defaults give the exact Hessian.

        Args:
            keep: fraction of the negative transverse part of springs to include.
            shift: value added to the diagonal [N/m].
            tension: tensions of the springs (m,) [N]; None for those at the point.

        Returns:
            True if it is positive definite, so that `solve` can be called.
        """
        return self._factor.factorise(self._assembled(keep, shift, tension).values)

    def filtered(self, by: Filtering) -> Filtered:
        """Return the Hessian with projected elements; constant forms have no negative eigenvalue."""
        keep, tension = by.springs(self._terms.edges, self._tension)
        stated = zip(self._step.stated, self.curvature, strict=True)
        curvature = [c if one.law.constant else by.packed(one.elements.vertices, c) for one, c in stated]
        pairs = [by.pairs(blocks) for blocks in self.met.blocks]
        return Filtered(keep, tension, curvature, pairs, by.looked, by.changed)

    def convex(self) -> Matrix:
        """Assemble the Hessian with negative eigenvalues of elements clamped; valid until the next assembly."""
        clamped = self.filtered(Filtering())
        return self._assembled(clamped.keep, 0.0, clamped.tension, clamped)

    def factorise_filtered(self, filtered: Filtered, shift: Values | float = 0.0) -> bool:
        """Factorise a projected Hessian plus `shift` [N/m] on its diagonal.

        Returns whether it is positive definite.
        """
        return self._factor.factorise(self._assembled(filtered.keep, shift, filtered.tension, filtered).values)

    def solve_anew(
        self, b: Positions, keep: float = 1.0, shift: Values | float = 0.0, tension: Values | None = None
    ) -> Positions | None:
        """Factorise and solve in one pass, faster than both calls.

        Returns None if it is not positive definite.
        """
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
        """Solve with the last factor for b (n, 3).

        The result is zero at vertices that are not free.
        """
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
        """Arguments of `solvers.kernels.hessian.multiply`: all terms with an element-wise form."""
        step = self._step
        curvature = np.concatenate(self.curvature) if self.curvature else None
        return self._terms, self._linear, step.whole.form, step.joined, curvature

    def multiply(self, x: Positions) -> Positions:
        """Return the exact Hessian times x (n, 3); x and the product are zero at vertices that are not free."""
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

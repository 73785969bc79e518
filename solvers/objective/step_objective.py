"""Fast evaluation of the objective of a step, its gradient and its Hessian.

`StepProblem` is the reference evaluator. One compiled pass evaluates all springs, another all constant quadratic forms,
and one each energy with an element-wise form (`springbench.solvers.model.energies.element_energies`). Other energies
supply their own value, gradient and Hessian. The degrees of freedom are the free vertices: exactly pinned ones stay on
their targets. The matrix of the Hessian is analysed once, or once per step (`hessian_pattern`, `step_matrix`). Terms
that are constant in a run or a step are summed once.
"""

from __future__ import annotations

from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.typed_kernel import as_kernel_array
from springbench.solvers.kernels import objective_kernels, spring_hessian
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky
from springbench.solvers.model.barrier_energy import BarrierEnergy, PairBlocks, is_barrier_energy, max_step_size
from springbench.solvers.model.energies.element_energies import JoinedElements, add_blocks
from springbench.solvers.model.step_problem import Energy, Positions, StepProblem
from springbench.solvers.objective import woodbury
from springbench.solvers.objective.fixed_objective import ElementEnergy, FixedObjective
from springbench.solvers.objective.hessian_pattern import BlockMatrix, IndexArray
from springbench.solvers.objective.psd_projection import ProjectedHessian, PsdProjection
from springbench.solvers.objective.step_matrix import BarrierHessian, StepMatrix

FloatArray = NDArray[np.float64]

VALUE_ROUNDOFF = 4.0 * np.finfo(np.float64).eps
"""Relative rounding error of an energy's value."""

SLOPE_FALLBACK_RATIO = 1e-10
"""Relative change of an energy below which the mean slope is more accurate than the difference of values."""


_NO_INDICES, _NO_VALUES = np.empty(0, np.int64), np.empty(0)
_TENSIONS_AT_POINT = _NO_VALUES
"""Argument of the kernels for the tensions at the positions, instead of given ones."""


class TrialStep(NamedTuple):
    """A trial of a line search.

    Attributes:
        positions: (n, 3) [m].
        change, noise: change of the objective [J] and its round-off, as of `StepObjective.objective_change`.
        gradient: gradient there (n, 3) [N], if it was computed.
    """

    positions: Positions
    change: float
    noise: float
    gradient: Positions | None


class StepObjective:
    """The objective g of one step.

    All positions are (n, 3) [m], with exactly pinned vertices on their targets.

    Attributes:
        element_energies: energies with an element-wise form, except those without elements in this step.
        other_energies: energies without an element-wise form.
        barrier_energies: barrier energies among these, which limit the step size.
    """

    def __init__(self, fixed_objective: FixedObjective, problem: StepProblem) -> None:
        """Build the objective of a problem.

        Args:
            fixed_objective: the parts that do not change, of the same system.
            problem: the step.

        Raises:
            ValueError: the system of the problem has another number of energies.
        """
        built, given = len(fixed_objective.system.energies), len(problem.system.energies)
        if built != given:
            raise ValueError(
                f"objective of a system with {built} energies, step with {given}: build it for the step's system"
            )
        self.fixed_objective, self.problem = fixed_objective, problem
        self._step_data: objective_kernels.StepData | None = None
        self._pins: objective_kernels.ExactPins | None = None
        self.element_energies: list[ElementEnergy] = []
        self.other_energies: list[Energy] = []
        self.barrier_energies: list[BarrierEnergy] = []
        if (
            fixed_objective.quadratic_form is not None
            or fixed_objective.element_energy_indices
            or fixed_objective.other_energy_indices
        ):
            begun: Any = problem.energies
            if fixed_objective.forms_with_force:
                force = problem.external_force.copy()
                for k in fixed_objective.forms_with_force:
                    begun[k].add_projection(problem.inertial_target, force)
                self._step_data = self.step_data._replace(external_force=force)
            found = (
                ElementEnergy(k, k in fixed_objective.projective_indices, begun[k].element_law, begun[k].elements)
                for k in fixed_objective.element_energy_indices
            )
            self.element_energies = [one for one in found if len(one.elements.vertices)]
            self.other_energies = [begun[k] for k in fixed_objective.other_energy_indices]
            self.barrier_energies = [energy for energy in self.other_energies if is_barrier_energy(energy)]
        self._constant_cache: tuple[BlockMatrix, FloatArray] | None = None
        self._exact_pins = fixed_objective.exact_pins
        self._has_exact_pins = len(self._exact_pins) > 0

    @property
    def step_data(self) -> objective_kernels.StepData:
        """The step's inertial target, force and targets of penalty pins, for the kernels."""
        if self._step_data is None:
            self._step_data = objective_kernels.StepData.from_problem(self.problem)
        return self._step_data

    @cached_property
    def step_matrix(self) -> StepMatrix:
        """The matrix of the Hessians."""
        return StepMatrix(self.fixed_objective, self.barrier_energies, self.problem.step_start.pattern_positions)

    @property
    def has_contact_elements(self) -> bool:
        """Whether there are elements that are not part of Q.

        These are elements of contact that may become active in this step.
        """
        return any(not one.is_projective for one in self.element_energies)

    def max_step_size(self, p: Positions, search_direction: Positions, initial_step: float = 1.0) -> float:
        """Return the largest collision-free step size up to `initial_step`, over all barriers.

        Args:
            p: positions (n, 3) [m].
            search_direction: search direction (n, 3) [m], the displacement at a step size of 1.
            initial_step: upper bound of the step size, returned without barriers.
        """
        return (
            initial_step
            * max_step_size(
                self.barrier_energies, p, search_direction if initial_step == 1.0 else initial_step * search_direction
            )
            if self.barrier_energies
            else initial_step
        )

    def compute_active_blocks(self, p: Positions) -> list[PairBlocks]:
        """Compute the Hessian blocks of the barrier energies' pairs that are active at p (n, 3) [m]."""
        found = (energy.hessian_blocks(p, 0.0) for energy in self.barrier_energies)
        return [blocks for blocks in found if len(blocks.vertices)]

    def apply_exact_pins(self, p: Positions) -> Positions:
        """Return a copy of p with the exactly pinned vertices on their targets."""
        out = np.array(p, np.float64, order="C")
        if self._has_exact_pins:
            out[self._exact_pins] = self.exact_pins.targets
        return out

    @property
    def exact_pins(self) -> objective_kernels.ExactPins:
        """The exact pins and their targets, for the kernels."""
        if self._pins is None:
            targets = self.problem.pin_targets[self.fixed_objective.exact_pin_indices]
            self._pins = objective_kernels.ExactPins(self._exact_pins, targets)
        return self._pins

    def inertial_target(self) -> Positions:
        """Return the inertial target (n, 3) [m], with pinned vertices on their targets."""
        out = np.array(self.problem.inertial_target, np.float64, order="C")
        out[self.fixed_objective.pinned_vertices] = self.problem.pin_targets
        return out

    def inertial_prediction(self) -> Positions:
        """Return the positions (n, 3) under inertia and external force alone.

        Pinned vertices are on their targets.
        """
        problem, fixed, out = self.problem, self.fixed_objective, np.empty(self.problem.inertial_target.shape)
        target, force, pins = map(
            as_kernel_array, (problem.inertial_target, problem.external_force, problem.pin_targets)
        )
        inertia = fixed.objective_terms.inertia_diagonal
        fixed.kernels.predict_positions.call(inertia, target, force, fixed.pinned_vertices, pins, out)
        return out

    def gradient(self, p: Positions) -> Positions:
        """Return the gradient [N], (n, 3), zero at exactly pinned vertices."""
        p, fixed = np.ascontiguousarray(p), self.fixed_objective
        out = np.empty_like(p)
        terms = fixed.objective_terms, fixed.quadratic_form, self.step_data, self.exact_pins
        fixed.kernels.gradient.call(*terms, p, out)
        if self.element_energies or self.other_energies:
            for one in self.element_energies:
                one.element_law.add_gradient(one.elements, p, out)
            for energy in self.other_energies:
                energy.add_gradient(p, out)
            out[self._exact_pins] = 0.0
        return out

    def objective_change(self, p: Positions, q: Positions) -> tuple[float, float]:
        """Return the change of the objective from p to q, and its round-off.

        An energy without an element-wise form contributes the difference of its values, or the mean slope if that
        difference is cancelled.

        Args:
            p, q: positions (n, 3) [m].

        Returns:
            g(q) - g(p) [J], and the part that may be round-off of energies without an element-wise form [J].
        """
        p, q, fixed = np.ascontiguousarray(p), np.ascontiguousarray(q), self.fixed_objective
        terms, noise = (fixed.objective_terms, fixed.quadratic_form, self.step_data), 0.0
        change = fixed.kernels.objective_change.call(*terms, p, q)
        for one in self.element_energies:
            change += one.element_law.energy_change(one.elements, p, q)
        for energy in self.other_energies:
            before, after = energy.value(p), energy.value(q)
            if before == after == 0.0 and is_barrier_energy(energy):
                continue  # nothing is in range, at either
            slope = np.zeros_like(q)
            energy.add_gradient(q, slope)
            scale = abs(before) + abs(after) + float(np.abs(slope * q).sum())
            if abs(after - before) <= SLOPE_FALLBACK_RATIO * scale < np.inf:
                energy.add_gradient(p, slope)
                change += 0.5 * float((slope * (q - p)).sum())
            else:
                change += after - before
                noise += VALUE_ROUNDOFF * scale
        return change, noise

    def try_step(
        self, p: Positions, direction: Positions, step_size: float, slope: float, curvature: float
    ) -> TrialStep:
        """Return the trial p + step_size * direction of a line search.

        With springs and quadratic forms alone, one kernel does this, and computes the gradient if the decrease
        suffices. With other energies the gradient is None.

        Args:
            p: positions (n, 3) [m].
            direction: search direction (n, 3) [m].
            step_size: multiple of the direction.
            slope, curvature: first and second derivative along the direction [J].
        """
        if self.element_energies or self.other_energies:
            q = self.apply_exact_pins(p + step_size * direction)
            return TrialStep(q, *self.objective_change(p, q), None)
        p, direction, fixed = np.ascontiguousarray(p), np.ascontiguousarray(direction), self.fixed_objective
        q, gradient = np.empty_like(p), np.empty_like(p)
        terms = fixed.objective_terms, fixed.quadratic_form, self.step_data, self.exact_pins
        change, is_sufficient = fixed.kernels.try_step.call(
            *terms, p, direction, step_size, slope, curvature, q, gradient
        )
        return TrialStep(q, change, 0.0, gradient if is_sufficient else None)

    def linearise_tensions(self, p: Positions, d: Positions) -> FloatArray:
        """Return the springs' tensions at p, linearised for a displacement d.

        Args:
            p: positions (n, 3) [m].
            d: displacement (n, 3) [m].

        Returns:
            Tensions (m,) [N], positive if a spring pulls.
        """
        fixed, out = self.fixed_objective, np.empty(len(self.fixed_objective.objective_terms.stiffness))
        p, d = np.ascontiguousarray(p), np.ascontiguousarray(d)
        fixed.kernels.linearise_tensions.call(fixed.objective_terms, p, d, out)
        return out

    def hessian(self, p: Positions) -> Hessian:
        """Build the Hessian at p (n, 3)."""
        return Hessian(self, p)

    def element_hessians(self, p: Positions) -> list[FloatArray]:
        """Return the second derivatives of the elements at p, (m, 6) [N/m] for each energy."""
        return [self._evaluate_hessian(one, p) for one in self.element_energies]

    @staticmethod
    def _evaluate_hessian(one: ElementEnergy, p: Positions) -> FloatArray:
        out = np.empty((len(one.elements.vertices), 6))
        one.element_law.evaluate_hessians(one.elements, p, out)
        return out

    def constant_blocks(self, matrix: BlockMatrix, p: Positions) -> FloatArray | None:
        """Return the matrix blocks that do not depend on the positions in this step.

        Args:
            matrix: matrix whose pattern the blocks have.
            p: any positions (n, 3) [m]; constant Hessians of elements are evaluated there.

        Returns:
            Blocks (b, 3, 3) [N/m] of inertia, penalty pins, forms and elements; None if there are neither forms nor
            elements with a constant Hessian.
        """
        steady = [one for one in self.element_energies if one.element_law.has_constant_hessian]
        if not steady:
            return matrix.constant_blocks if self.fixed_objective.quadratic_form is not None else None
        if self._constant_cache is None or self._constant_cache[0] is not matrix:
            blocks = matrix.constant_blocks.copy()
            for one in steady:
                places = matrix.element_block_indices(one.energy_index, one.elements.vertices)
                add_blocks(one.elements, places, self._evaluate_hessian(one, p), blocks)
            self._constant_cache = matrix, blocks
        return self._constant_cache[1]

    @cached_property
    def joined_elements(self) -> JoinedElements | None:
        """The elements of all energies in one set; None if there are none."""
        return (
            JoinedElements.from_elements([one.elements for one in self.element_energies])
            if self.element_energies
            else None
        )


class Hessian:
    """The Hessian [N/m] at a point, over the free vertices (f,).

    It includes the blocks of elements and of collisions.
    """

    def __init__(self, step: StepObjective, p: Positions) -> None:
        self._step_objective, self._positions, self._kernels = step, p, step.fixed_objective.kernels
        self._objective_terms, self.free_vertices = (
            step.fixed_objective.objective_terms,
            step.fixed_objective.system.free_vertices,
        )
        self._low_rank_columns, self._sparse_part = None, None
        if step.other_energies:
            parts = [
                woodbury.sparse_part(energy, p) for energy in step.other_energies if energy not in step.barrier_energies
            ]
            self._low_rank_columns = woodbury.low_rank_columns(step.other_energies, p)
            self._sparse_part = reduce(lambda a, b: csr_array(a + b), parts) if parts else None
        self.element_hessians = step.element_hessians(p) if step.element_energies else []
        self.barrier_hessian = BarrierHessian(step.barrier_energies, p)

    @property
    def _matrix_and_entries(self) -> tuple[BlockMatrix, IndexArray, FloatArray]:
        """The matrix, and the places and values in it of energies without an element-wise form."""
        if not self._step_objective.other_energies:
            return self._step_objective.fixed_objective.hessian_matrix, _NO_INDICES, _NO_VALUES
        return self._extended_matrix_and_entries

    @cached_property
    def _extended_matrix_and_entries(self) -> tuple[BlockMatrix, IndexArray, FloatArray]:
        step, whole = self._step_objective, self._step_objective.fixed_objective
        rows, columns, entries = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
        if self._sparse_part is not None:
            total = self._sparse_part.tocoo()
            rows, columns = (3 * whole.free_index[x // 3] + x % 3 for x in total.coords)
            inside = (rows >= 0) & (columns >= 0)
            rows, columns, entries = rows[inside], columns[inside], np.asarray(total.data[inside], np.float64)
        matrix = step.step_matrix.matrix_at(
            self._positions, rows // 3, columns // 3, self.barrier_hessian.block_vertices
        )
        return matrix, matrix.entry_indices(rows, columns), entries

    def factorise(
        self, negative_fraction: float = 1.0, shift: FloatArray | float = 0.0, tension: FloatArray | None = None
    ) -> bool:
        """Factorise the Hessian and return whether it is positive definite.

        The defaults give the exact Hessian.

        Args:
            negative_fraction: fraction of the negative transverse part of springs to include.
            shift: value added to the diagonal [N/m].
            tension: tensions of the springs (m,) [N]; None for those at the point.

        Returns:
            True if it is positive definite, so that `solve` can be called.
        """
        return self._factor.factorise(self._assemble(negative_fraction, shift, tension).values)

    def project_to_psd(self, psd_projection: PsdProjection) -> ProjectedHessian:
        """Return the Hessian with projected elements; constant forms have no negative eigenvalue."""
        keep, tension = psd_projection.project_springs(self._objective_terms.edges, self._current_tensions)
        stated = zip(self._step_objective.element_energies, self.element_hessians, strict=True)
        curvature = [
            c if one.element_law.has_constant_hessian else psd_projection.project_packed(one.elements.vertices, c)
            for one, c in stated
        ]
        pairs = [psd_projection.project_pairs(blocks) for blocks in self.barrier_hessian.pair_blocks]
        return ProjectedHessian(
            keep, tension, curvature, pairs, psd_projection.num_examined, psd_projection.num_projected
        )

    def assemble_clamped(self) -> BlockMatrix:
        """Assemble the Hessian with negative eigenvalues of elements clamped; valid until the next assembly."""
        clamped = self.project_to_psd(PsdProjection())
        return self._assemble(clamped.negative_fraction, 0.0, clamped.spring_tensions, clamped)

    def factorise_projected(self, projected: ProjectedHessian, shift: FloatArray | float = 0.0) -> bool:
        """Factorise a projected Hessian, and return whether it is positive definite.

        Args:
            projected: the result of `project_to_psd` of this Hessian.
            shift: value added to the diagonal [N/m], one number or one for each free coordinate (3f,).
        """
        return self._factor.factorise(
            self._assemble(projected.negative_fraction, shift, projected.spring_tensions, projected).values
        )

    def factorise_and_solve(
        self,
        b: Positions,
        negative_fraction: float = 1.0,
        shift: FloatArray | float = 0.0,
        tension: FloatArray | None = None,
    ) -> Positions | None:
        """Factorise and solve in one pass, faster than both calls.

        Args:
            b: right-hand side (n, 3) [N].
            negative_fraction: fraction of the negative transverse part of springs to include.
            shift: value added to the diagonal [N/m], one number or one for each free coordinate (3f,).
            tension: tensions of the springs (m,) [N]; None for those at the point.

        Returns:
            Solution (n, 3) [m], zero at vertices that are not free; None if the Hessian is not positive definite.
        """
        values = self._assemble(negative_fraction, shift, tension).values
        x = self._factor.factorise_and_solve(values, self._select_free(b))
        return None if x is None else self._extend_to_all(x, b)

    def _assemble(
        self,
        negative_fraction: float,
        shift: FloatArray | float,
        tension: FloatArray | None,
        projected: ProjectedHessian | None = None,
    ) -> BlockMatrix:
        matrix, places, entries = self._matrix_and_entries
        step, tension = self._step_objective, _TENSIONS_AT_POINT if tension is None else tension
        constant = step.constant_blocks(matrix, self._positions)
        terms, p = self._objective_terms, np.ascontiguousarray(self._positions)
        kernel, bounds = self._kernels.assemble_hessian, ()
        if (threads := matrix.num_threads) > 1:
            kernel, bounds = self._kernels.assemble_hessian_in_threads, (matrix.divide_rows(threads),)
        # The blocks of elements are constant in some steps only, so that their type changes.
        assemble = kernel.kernel if step.element_energies else kernel.call
        assemble(terms, matrix.block_indices, constant, p, tension, float(negative_fraction), matrix.values, *bounds)
        if step.element_energies:
            self._add_elements(matrix, projected.element_hessians if projected else self.element_hessians)
        if projected:
            for k, blocks in enumerate(projected.pair_blocks):
                blocks.add_blocks(matrix.element_block_indices(-1 - k, blocks.vertices), matrix.values)
        elif step.barrier_energies:
            self.barrier_hessian.add_to_matrix(negative_fraction, matrix)
        if len(places):
            matrix.values.reshape(-1)[places] += entries
        if isinstance(shift, np.ndarray) or shift != 0.0:
            matrix.values.reshape(-1)[matrix.diagonal_entries] += shift
        return matrix

    def _add_elements(self, matrix: BlockMatrix, element_hessians: list[FloatArray]) -> None:
        """Add the Hessians of the elements of each energy that are not constant."""
        for one, curvature in zip(self._step_objective.element_energies, element_hessians, strict=True):
            if not one.element_law.has_constant_hessian:
                at = matrix.element_block_indices(one.energy_index, one.elements.vertices)
                add_blocks(one.elements, at, curvature, matrix.values)

    def solve(self, b: Positions) -> Positions:
        """Solve with the last factor for b (n, 3).

        The result is zero at vertices that are not free.
        """
        return self._extend_to_all(self._factor.solve(self._select_free(b)), b)

    def _select_free(self, b: Positions) -> Positions:
        return b.take(self.free_vertices, axis=0) if len(self.free_vertices) < len(b) else b

    def _extend_to_all(self, x: Positions, b: Positions) -> Positions:
        """Return x (f, 3) with rows of zeros at vertices that are not free.

        The result has the shape of b.
        """
        if len(x) == len(b):
            return x
        out = np.zeros_like(b)
        out[self.free_vertices] = x
        return out

    @property
    def _factor(self) -> BlockCholesky | woodbury.Woodbury:
        return self._matrix_and_entries[0].factor if self._low_rank_columns is None else self._updated_factor

    @cached_property
    def _updated_factor(self) -> woodbury.Woodbury:
        assert self._low_rank_columns is not None
        return woodbury.Woodbury(self._matrix_and_entries[0], self._low_rank_columns[self.free_vertices])

    @cached_property
    def _current_tensions(self) -> FloatArray:
        return self._step_objective.linearise_tensions(self._positions, np.zeros_like(self._positions))

    @cached_property
    def _linear_terms(self) -> FloatArray:
        linear = np.empty((len(self._objective_terms.stiffness), 4))
        self._kernels.linearise_springs.call(self._objective_terms, np.ascontiguousarray(self._positions), linear)
        return linear

    @cached_property
    def kernel_arguments(self) -> tuple[Any, ...]:
        """Arguments of `spring_hessian.multiply_hessian`: all terms with an element-wise form."""
        step = self._step_objective
        curvature = np.concatenate(self.element_hessians) if self.element_hessians else None
        return (
            self._objective_terms,
            self._linear_terms,
            step.fixed_objective.quadratic_form,
            step.joined_elements,
            curvature,
        )

    def is_finite(self) -> bool:
        """Return whether all entries of the exact Hessian are finite."""
        with np.errstate(all="ignore"):
            return bool(np.isfinite(self.matvec(np.ones_like(self._positions))).all())

    def matvec(self, x: Positions) -> Positions:
        """Return the exact Hessian times x (n, 3).

        The product is zero at vertices that are not free.
        """
        x = np.ascontiguousarray(x)
        product, has_elements = np.empty_like(x), bool(self._step_objective.element_energies)
        multiply = spring_hessian.multiply_hessian if has_elements else self._kernels.multiply_hessian.call
        multiply(*self.kernel_arguments, x, product)
        if self._sparse_part is not None:
            product += (self._sparse_part @ x.ravel()).reshape(-1, 3)
        if self._low_rank_columns is not None:
            product += self._low_rank_columns @ np.einsum("nik,ni->k", self._low_rank_columns, x)
        for pairs in self.barrier_hessian.pair_blocks if self._step_objective.barrier_energies else ():
            pairs.add_product(x, product)
        return self._extend_to_all(self._select_free(product), x)

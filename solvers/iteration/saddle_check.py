"""The check whether a solve has ended at a saddle point.

It is for methods that do not factorise the Hessian. Methods that follow gradients preserve symmetry, and so they may
converge to a saddle; the residual does not show it.
First a bound over springs and vertices rules out negative curvature, at the cost of one gradient; it succeeds where no
spring is compressed by more than inertia resists. Else conjugate gradients search for a direction of negative curvature
within a limited number of products with the Hessian (`springbench.solvers.kernels.curvature_search`). A search that
finds none proves nothing.

Negative curvature counts if it leads to a point that is lower by more than the round-off of the objective. So a valley
of minima, along which the curvature is zero up to round-off of either sign, is no saddle.

Systems with length constraints are not checked: there the curvature within the constraints decides.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from springbench.solvers.iteration.vertex_terms import compute_anchor_stiffness
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.kernels import curvature_search
from springbench.solvers.kernels.curvature_search import EXHAUSTED_RATIO, CurvatureScratch
from springbench.solvers.kernels.hessian_packets import HessianPackets
from springbench.solvers.kernels.line_search_conditions import is_armijo_step
from springbench.solvers.linalg.krylov import NEGATIVE_CURVATURE, ConjugateGradientIteration
from springbench.solvers.model.step_problem import Positions, StepProblem
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import VALUE_ROUNDOFF, Hessian, StepObjective

_MIN_PRODUCTS = 32
"""Smallest limit of products per search. Saddles of the hard cases need 1 to 28; motion-burst, a rotating block, needs
most."""

_ITERATIONS_PER_PRODUCT = 16
"""Iterations of a solve per product of its limit, if that is larger. A product costs a third of an L-BFGS iteration."""

_MAX_HALVINGS = 40
"""Maximum number of halvings: from the extent of the mesh to 1e-12 of it."""


class SaddleCheck:
    """The check of the end points of solves, for one system."""

    def __init__(self, fixed_objective: FixedObjective) -> None:
        self.system = system = fixed_objective.system
        self._fixed_objective = fixed_objective
        self._has_springs_alone = not (fixed_objective.element_energy_indices or fixed_objective.other_energy_indices)
        self._anchor_stiffness = compute_anchor_stiffness(system)
        self._linear_terms = np.empty((len(self._fixed_objective.springs.stiffness), 4))
        self._negative_stiffness = np.empty(system.num_vertices)
        self._bound_by_springs = TypedKernel(curvature_search.bound_by_springs)

    def find_lower_point(self, problem: StepProblem, p: Positions, num_iterations: int) -> Positions | None:
        """Return a lower point to which negative curvature leads, or None if none was found.

        Args:
            problem: the step.
            p: end point of the solve (n, 3) [m].
            num_iterations: number of iterations of the solve, which limits the cost of the search.

        Returns:
            Positions (n, 3) [m].
        """
        found = self.find_negative_curvature(problem, p, max(_MIN_PRODUCTS, num_iterations // _ITERATIONS_PER_PRODUCT))
        if found is None:
            return None
        step = StepObjective(self._fixed_objective, problem)
        lower = _find_lower_prediction(step, p)
        return _descend_along(step, p, *found) if lower is None else lower

    def find_negative_curvature(
        self, problem: StepProblem, p: Positions, max_products: int
    ) -> tuple[Positions, float] | None:
        """Return a direction of negative curvature and the curvature along it, or None.

        The direction (n, 3) has maximum 1; the curvature is in N/m.

        Args:
            problem: the step.
            p: positions (n, 3) [m].
            max_products: maximum number of products with the Hessian.
        """
        whole, hessian, is_compiled = self._fixed_objective, None, True
        anchor_stiffness, negative = self._anchor_stiffness, self._negative_stiffness
        if self._has_springs_alone:
            arguments = whole.objective_terms, self._linear_terms, whole.quadratic_form, None, None
            is_bounded = self.is_bounded_by_springs(p)
        else:
            step = StepObjective(whole, problem)
            hessian = step.hessian(p)
            terms, linear, _, joined, curvature = arguments = hessian.kernel_arguments
            is_compiled = _has_element_form(step, hessian)
            is_bounded = is_compiled and curvature_search.bound_by_elements(
                terms, linear, joined, curvature, anchor_stiffness, negative
            )
        if is_bounded:
            return None
        scratch = self._scratch
        if hessian and not is_compiled:
            curvature_search.fill_preconditioner(*arguments, anchor_stiffness, scratch)
            found = _InterpretedSearch(hessian, scratch).find_curvature(max_products)
        else:
            found = curvature_search.search_compiled(*arguments, anchor_stiffness, self._packets, max_products, scratch)
        direction = scratch.direction[: len(p), :3]
        size = float(np.abs(direction).max(initial=0.0))
        return (direction / size, found / size**2) if found < 0.0 else None

    def is_bounded_by_springs(self, p: Positions) -> bool:
        """Return whether the bound over springs rules out negative curvature at p (n, 3) [m]."""
        scratch = self._linear_terms, self._negative_stiffness
        return self._has_springs_alone and self._bound_by_springs.call(
            self._fixed_objective.objective_terms, as_kernel_array(p), self._anchor_stiffness, *scratch
        )

    @cached_property
    def _packets(self) -> HessianPackets:
        return HessianPackets.from_springs(self._fixed_objective.springs, self._anchor_stiffness)

    @cached_property
    def _scratch(self) -> CurvatureScratch:
        return CurvatureScratch.from_size(self.system.num_vertices)


def _has_element_form(step: StepObjective, hessian: Hessian) -> bool:
    """Return whether all active energies have an element-wise form.

    Barrier energies out of range are not active.
    """
    return len(step.other_energies) == len(step.barrier_energies) and not any(
        len(blocks.vertices) for blocks in hessian.barrier_hessian.pair_blocks
    )


class _InterpretedSearch(ConjugateGradientIteration):
    """The search with energies that have no element-wise form."""

    def __init__(self, hessian: Hessian, scratch: CurvatureScratch) -> None:
        self._hessian, self._scratch = hessian, scratch
        self._product = curvature_search.start_search(scratch)
        self._limit = EXHAUSTED_RATIO * self._product

    def find_curvature(self, max_products: int) -> float:
        """Return the curvature [J] along the scratch's direction, 0 if none is negative."""
        _, ended = self.run_iterations(self._product, max_products)
        return curvature_search.measure_curvature(self._scratch) if ended == NEGATIVE_CURVATURE else 0.0

    def update_direction(self, product: float, previous_product: float) -> float:
        """Update the direction; return the curvature along it."""
        curvature_search.update_search_direction(self._scratch, product / previous_product)
        vertices = np.s_[: len(self._scratch.residual), :3]
        self._scratch.product[vertices] = self._hessian.matvec(np.ascontiguousarray(self._scratch.direction[vertices]))
        return curvature_search.measure_curvature(self._scratch)

    def update_iterate(self, product: float, curvature: float) -> float:
        """Update the residual; return r'z."""
        return curvature_search.update_residual(self._scratch, product / curvature)

    def is_convex(self, curvature: float) -> bool:
        """Return whether the curvature is positive beyond round-off."""
        return curvature > 0.0

    def is_converged(self, product: float) -> bool:
        """Return whether the Krylov space is exhausted."""
        return not product > self._limit


def _round_off(step: StepObjective, p: Positions) -> float:
    """Return the round-off of the objective's value [J]."""
    return VALUE_ROUNDOFF * step.problem.value_scale(p)


def _find_lower_prediction(step: StepObjective, p: Positions) -> Positions | None:
    """Return the inertial prediction if it is lower than p, else None.

    It is tried first, because a stiff system is slow to leave a saddle.
    """
    fall = step.inertial_prediction()
    change, noise = step.objective_change(p, fall)
    is_lower = change + noise < -_round_off(step, p)
    return fall if is_lower and step.max_step_size(p, fall - p) == 1.0 else None


def _descend_along(step: StepObjective, p: Positions, x: Positions, curvature: float) -> Positions | None:
    """Return the lowest point along a direction of negative curvature.

    The candidates are p + t x and p - t x, for t the extent of the mesh, half of it, and so on.

    Args:
        step: the objective.
        p: positions (n, 3) [m].
        x: direction (n, 3) of negative curvature, with maximum 1.
        curvature: second derivative along it [N/m].

    Returns:
        Positions (n, 3) [m]; None if no point is lower by more than round-off.
    """
    lowest, found = -_round_off(step, p), None
    slope, extent = float(np.einsum("ij,ij->", step.gradient(p), x)), float(np.ptp(p, axis=0).max(initial=0.0)) or 1.0
    for d, slope_along in ((x, slope), (-x, -slope)):
        before = np.inf
        for halvings in range(_MAX_HALVINGS):
            t = step.max_step_size(p, d, 0.5**halvings * extent)
            q = step.apply_exact_pins(p + t * d)
            change, noise = step.objective_change(p, q)
            if change + noise < lowest and is_armijo_step(change, t, slope_along, curvature):
                lowest, found = change + noise, q
            elif before <= change and before < 0.0:
                break
            before = change
    return found

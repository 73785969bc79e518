"""Preconditioners of conjugate gradients, in Newton's methods and in nonlinear ones.

    factor          Q^-1                                               a solve with the prefactored matrix
    schwarz         dense inverses of patches of H+, on levels         `springbench.solvers.linalg.additive_schwarz`
    block-jacobi    inverses of the 3 x 3 blocks on the diagonal of H+

H+ is the Hessian at each point, with the negative eigenvalues of its elements clamped; the last two are built from it.
Both consist of products only, which suits a graphics processor. They use Q's factor for residuals only.

Contact is far stiffer than Q, at a few vertices. There P = S Q S replaces Q, where S_i = (I + W_i/Q_ii)^(1/2)
and W_i is the block that contact adds to H. At these vertices P is Q + W except for couplings; elsewhere it is Q.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.descent_method import ResidualMetric
from springbench.solvers.kernels import quadratic_form_kernels
from springbench.solvers.kernels import spring_hessian as springs
from springbench.solvers.linalg.additive_schwarz import SubdomainHierarchy, order_into_subdomains
from springbench.solvers.model.barrier_energy import is_barrier_energy
from springbench.solvers.model.energies.element_energies import add_blocks
from springbench.solvers.model.step_problem import Positions, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.hessian_pattern import BlockMatrix
from springbench.solvers.objective.psd_projection import PsdProjection
from springbench.solvers.objective.step_objective import Hessian, StepObjective

PreconditionerName = Literal["cholesky", "schwarz", "block-jacobi"]
"""The names of the preconditioners."""

Preconditioner = Callable[[Positions], Positions]
"""A map from gradients [N] to displacements [m], both (n, 3)."""

PreconditionerBuilder = Callable[[StepObjective, Positions], tuple[Hessian, Preconditioner]]
"""A function that returns the Hessian at p (n, 3) and its preconditioner."""

MIN_DIAGONAL_FRACTION = 1e-6
"""Fraction of Q's diagonal added to blocks, because the springs at a massless vertex may act in one direction only."""


def build_preconditioner(
    name: PreconditionerName, metric: ResidualMetric, objective: FixedObjective, solver: str
) -> PreconditionerBuilder:
    """Return the builder of a preconditioner.

    Args:
        name: name of the preconditioner.
        metric: Q, whose factor is the preconditioner or whose diagonal regularises its blocks.
        objective: the objective. Except for `cholesky`, its energies without elements must be barriers.
        solver: name of the solver, for the message.

    Raises:
        Unsupported: an energy without elements would have to be clamped.
    """
    if name == "cholesky":
        return _FactorPreconditioner(metric)
    energies = objective.system.energies
    unknown = {type(energies[k]).__name__ for k in objective.other_energy_indices if not is_barrier_energy(energies[k])}
    if unknown:
        raise Unsupported(
            f"{solver}, preconditioner: {name}: clamps second derivatives element by element, and there are none of "
            f"{', '.join(sorted(unknown))}; take preconditioner: cholesky"
        )
    return _SchwarzPreconditioner(metric) if name == "schwarz" else _BlockJacobiPreconditioner(metric)


class _FactorPreconditioner:
    """Q^-1, or (S Q S)^-1 with active contact."""

    def __init__(self, metric: ResidualMetric) -> None:
        self._metric = metric

    def __call__(self, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
        hessian = step.hessian(p)
        beyond = step.has_contact_elements or (
            step.barrier_energies and any(len(blocks.vertices) for blocks in hessian.barrier_hessian.pair_blocks)
        )
        return hessian, ScaledPreconditioner(
            self._metric, *_contact_blocks(step, hessian, len(p))
        ) if beyond else self._metric.solve


class _BlockJacobiPreconditioner:
    """Block Jacobi with the diagonal blocks of the clamped Hessian."""

    def __init__(self, metric: ResidualMetric) -> None:
        self._free_vertices, self._diagonal_blocks = metric.system.free_vertices, _minimum_diagonal_blocks(metric)

    def __call__(self, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
        hessian = step.hessian(p)
        inverses = np.linalg.inv(assemble_diagonal_blocks(step, hessian, p) + self._diagonal_blocks)
        return hessian, _extend_to_all_vertices(self._free_vertices, lambda r: np.einsum("fij,fj->fi", inverses, r))


class _SchwarzPreconditioner:
    """Additive Schwarz with patches of the clamped Hessian."""

    def __init__(self, metric: ResidualMetric) -> None:
        self._free_vertices, self._diagonal_blocks = metric.system.free_vertices, _minimum_diagonal_blocks(metric)
        self._order = order_into_subdomains(metric.free_block)
        self._cached_patches: tuple[BlockMatrix, SubdomainHierarchy] | None = None

    def __call__(self, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
        hessian = step.hessian(p)
        matrix = hessian.assemble_clamped()
        if self._cached_patches is None or self._cached_patches[0] is not matrix:
            self._cached_patches = matrix, SubdomainHierarchy(matrix.graph, self._order)
        blocks = matrix.values.copy()
        blocks[matrix.block_indices.diagonal_block[self._free_vertices]] += self._diagonal_blocks
        return hessian, _extend_to_all_vertices(
            self._free_vertices, self._cached_patches[1].build_preconditioner(blocks).apply_preconditioner
        )


def _minimum_diagonal_blocks(metric: ResidualMetric) -> NDArray[np.float64]:
    """Return blocks (f, 3, 3) [N/m] to add to the diagonal."""
    return MIN_DIAGONAL_FRACTION * metric.free_diagonal[:, None, None] * np.eye(3)


def _extend_to_all_vertices(free: NDArray[np.int64], solve: Preconditioner) -> Preconditioner:
    """Extend a solve for free vertices (f,) to all vertices (n, 3)."""

    def solve_free(b: Positions) -> Positions:
        out = np.zeros_like(b)
        out[free] = solve(b[free])
        return out

    return solve_free


def assemble_diagonal_blocks(step: StepObjective, hessian: Hessian, p: Positions) -> NDArray[np.float64]:
    """Return the diagonal blocks of the clamped Hessian, without assembling that matrix.

    They include springs, forms, elements and pairs.

    Args:
        step: the objective.
        hessian: its Hessian at p.
        p: positions (n, 3) [m].

    Returns:
        Blocks of the free vertices (f, 3, 3) [N/m].
    """
    whole, clamped = step.fixed_objective, hessian.project_to_psd(PsdProjection())
    terms, number, form = whole.objective_terms, whole.free_index, whole.quadratic_form
    places = springs.BlockIndices(whole.system.free_vertices, number, np.full((len(terms.stiffness), 2), -1))
    out = np.empty((len(whole.system.free_vertices), 3, 3))
    springs.assemble_hessian(terms, places, None, p, clamped.spring_tensions, clamped.negative_fraction, out)
    if form is not None:
        quadratic_form_kernels.add_quadratic_blocks(form, number, np.full((len(form.pair_weight), 2), -1), out)
    for one, curvature in zip(step.element_energies, clamped.element_hessians, strict=True):
        add_blocks(one.elements, _diagonal_block_indices(number, one.elements.vertices), curvature, out)
    for pairs in clamped.pair_blocks:
        if len(pairs.vertices):
            pairs.add_blocks(_diagonal_block_indices(number, pairs.vertices), out)
    return out


def _diagonal_block_indices(number: NDArray[np.int64], vertices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices of the diagonal blocks of elements, -1 for the other blocks.

    Args:
        number: index of the diagonal block of each vertex (n + 1,); the last entry is for the vertex -1.
        vertices: vertices of the elements (m, k), -1 for none.

    Returns:
        Indices (m, k^2).
    """
    k = vertices.shape[1]
    places = np.full((len(vertices), k * k), -1)
    places[:, :: k + 1] = number[vertices]
    return places


class ScaledPreconditioner:
    """The preconditioner (S Q S)^-1.

    S_i is (I + W_i/Q_ii)^(1/2) at some vertices, and I at all others.

    Attributes:
        inverse_scaling: these vertices (c,), and S_i^-1 (c, 3, 3).
    """

    def __init__(self, metric: ResidualMetric, vertices: NDArray[np.int64], blocks: NDArray[np.float64]) -> None:
        """Create the preconditioner from the blocks that are added to Q.

        Args:
            metric: factorised Q.
            vertices: scaled vertices (c,).
            blocks: their positive semidefinite blocks W (c, 3, 3) [N/m].
        """
        self._metric, system = metric, metric.system
        resists = np.full(system.num_vertices, np.inf)
        resists[system.free_vertices] = metric.free_diagonal
        size, axes = np.linalg.eigh(blocks)
        shrunk = (1.0 + np.maximum(0.0, size) / resists[vertices, None]) ** -0.5
        self.inverse_scaling = vertices, (axes * shrunk[:, None, :]) @ axes.transpose(0, 2, 1)

    def __call__(self, b: Positions) -> Positions:
        """Return (S Q S)^-1 b, (n, 3)."""
        scaled = b.copy()
        self._apply_scaling(scaled)
        x = self._metric.solve(scaled)
        self._apply_scaling(x)
        return x

    def _apply_scaling(self, x: Positions) -> None:
        vertices, root = self.inverse_scaling
        x[vertices] = np.einsum("vij,vj->vi", root, x[vertices])


def _contact_blocks(step: StepObjective, hessian: Hessian, n: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the vertices (c,) with contact and their blocks (c, 3, 3) [N/m].

    The blocks are those of elements and pairs outside Q.
    """
    blocks, acted, number = np.zeros((n, 3, 3)), np.zeros(n, np.bool_), np.append(np.arange(n), -1)
    for one, curvature in zip(step.element_energies, hessian.element_hessians, strict=True):
        if not one.is_projective:
            add_blocks(one.elements, _diagonal_block_indices(number, one.elements.vertices), curvature, blocks)
            acted[one.elements.vertices] = True
    for pairs in hessian.barrier_hessian.pair_blocks:
        pairs.add_blocks(_diagonal_block_indices(number, pairs.vertices), blocks)
        acted[pairs.vertices] = True
    acted &= blocks.any(axis=(1, 2))
    return np.flatnonzero(acted), blocks[acted]

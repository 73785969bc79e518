"""JGS2: Jacobi's method with precomputed local responses of the mesh (Lan et al. 2025).

    p <- p + t d,     d_i = -(U_i' H U_i)^-1 U_i' grad g,     U_i = R W_i R_i'

    W_i = X_i (E_i' X_i)^-1,     X_i = (H0 among P)^-1 E_i

A vertex that lowers only its own energy overshoots, or converges slowly. In JGS2 it moves together with the vertices P
within a few rings of springs, along U_i: their equilibrium response to a displacement of i, with all other vertices
fixed. If P were the whole mesh and H0 the Hessian H, d would be Newton's step, because U_i' H U_i is then the Schur
complement of i. H0 is the Hessian of the rest shape, so W_i is computed once. W_i is rotated by per-vertex rotations R,
those nearest to the rotation of the incident springs (polar decomposition). At rest springs have no lateral stiffness;
in H0 they have the fraction `lateral_stiffness_ratio` of their stiffness there, as if they were stretched.

The paper approximates U'HU by a sum over sampled elements (cubature); here the sum is over all springs of P. Elements
of H with negative eigenvalues are clamped, so that U'HU is positive definite. The step size t is halved from 1 until
the objective decreases sufficiently. If d is no descent direction, vertices move individually, P = {i}: the combination
of these steps always descends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array, kron
from springbench.solvers.contact.half_space.vertex_contact import is_vertex_contact
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
    PreparedDescent,
    ResidualMetric,
    backtracking_line_search,
    inner_product,
)
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.linalg import memory
from springbench.solvers.linalg.direct_solvers import DenseCholesky
from springbench.solvers.methods.vertex_block import jgs2_patches as kernels
from springbench.solvers.methods.vertex_block.jgs2_patches import PatchScratch, VertexPatches
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.edge_energy import unit_directions
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import NotPositiveDefinite, Positions, ProjectiveEnergy, System, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.hessian_pattern import BlockMatrix
from springbench.solvers.objective.step_objective import StepObjective

_DEGENERATE_ROTATION_SHIFT = 1e-10
"""Weight of the identity added to the rotation estimate: it decides where springs do not, as for points on a line."""


@dataclass(frozen=True)
class Jgs2:
    """Jacobi's method with precomputed responses.

    Args:
        neighbour_rings: rings of springs around a vertex that respond to it; 0 gives Jacobi's method.
        lateral_stiffness_ratio: lateral stiffness of a spring at rest, relative to its stiffness, 0 to 1.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "vertex block descent",
        Citation(
            "Lan, Lei and Lu, Zixuan and Yuan, Chun and Xu, Weiwei and Su, Hao and Wang, Huamin and Jiang, Chenfanfu "
            "and Yang, Yin",
            2025,
            "JGS2: Near second-order converging Jacobi/Gauss-Seidel for GPU elastodynamics",
            "10.48550/arXiv.2506.06494",
        ),
        formula="dᵢ = (UᵢᵀHUᵢ)⁻¹ Uᵢᵀ∇g, all vertices at once",
        cost="products with H on one patch per vertex",
    )

    neighbour_rings: int = 4
    lateral_stiffness_ratio: float = 0.03

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        if self.neighbour_rings < 0:
            raise ValueError(f"neighbour_rings: should not be negative, not {self.neighbour_rings}")
        if not 0.0 <= self.lateral_stiffness_ratio <= 1.0:
            raise ValueError(f"lateral_stiffness_ratio: should be from 0 to 1, not {self.lateral_stiffness_ratio}")

    def prepare(self, system: System) -> PreparedDescent:
        """Prepare the method for a system.

        Raises:
            Unsupported: for contact, for energies that are not projective, and if the responses do not fit in memory.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        unknown = {
            type(e).__name__ for e in system.energies if is_vertex_contact(e) or not isinstance(e, ProjectiveEnergy)
        }
        if unknown:
            raise Unsupported(
                f"jgs2: responses are precomputed from the rest shape, which does not cover "
                f"{', '.join(sorted(unknown))}; use newton, lbfgs or hybrid"
            )
        metric, objective = ResidualMetric(system), FixedObjective(system)
        patches = compute_responses(
            assemble_rest_hessian(system, objective.springs, self.lateral_stiffness_ratio),
            objective.hessian_matrix.graph,
            self.neighbour_rings,
        )
        mean = len(patches.patch_vertices) / max(1, len(patches.patch_starts) - 1)
        choice = (
            f"responses of {mean:.1f} vertices on average, in {memory.format_bytes(patches.response.nbytes)}; "
            f"residuals by {metric.description}{objective.interpreted_energies}"
        )
        return PreparedDescent(
            objective, metric, _Jgs2Iteration(metric, objective.springs, patches), choice, metric.stats
        )


def assemble_rest_hessian(system: System, springs: Springs, lateral: float) -> csr_array:
    """Assemble the Hessian H0 of the rest shape.

    Args:
        system: the system; its other projective energies contribute as in Q.
        springs: all springs of the system.
        lateral: lateral stiffness of a spring at rest, relative to its stiffness.

    Returns:
        H0 [N/m] over the coordinates of the free vertices, (3f, 3f).
    """
    others = [e for e in system.energies if isinstance(e, ProjectiveEnergy) and not isinstance(e, Springs)]
    anchor_stiffness = vertex_terms.compute_anchor_stiffness(system)
    anchor_stiffness[np.isinf(anchor_stiffness)] = 0.0
    shares = reduce(
        lambda total, share: total + share,
        system_matrix_assembly.stiffness_shares(system, others),
        system_matrix_assembly.diagonal_matrix(anchor_stiffness),
    )
    whole = csr_array(kron(shares, eye_array(3))) + springs.rest_hessian(lateral, system.num_vertices)
    free = (3 * system.free_vertices[:, None] + np.arange(3)).ravel()
    return csr_array(csr_array(csr_array(whole)[free])[:, free])


def compute_responses(H: csr_array, graph: csr_array, rings: int) -> VertexPatches:
    """Compute the responses W of all vertices.

    If a patch has no Cholesky factor, its other vertices do not respond to the vertex.

    Args:
        H: Hessian of the rest shape (3f, 3f).
        graph: adjacency of the free vertices (f, f), with a full diagonal.
        rings: rings of springs in a patch.

    Raises:
        Unsupported: if the responses do not fit in memory.
    """
    f = len(graph.indptr) - 1
    link = csr_array((np.ones(graph.nnz), graph.indices, graph.indptr), shape=(f, f))
    reach = csr_array(eye_array(f))
    for _ in range(rings):
        wider = csr_array(reach @ link)
        wider.data[:] = 1.0
        if wider.nnz == reach.nnz:
            break
        reach = wider
    reach.sort_indices()
    needs, free = 72.0 * reach.nnz, memory.compute_memory_limit()
    if needs > free:
        raise Unsupported(
            f"jgs2: the responses within {rings} rings of each vertex need {memory.format_bytes(needs)} of memory, of "
            f"which {memory.format_bytes(free)} are available; use fewer `neighbour_rings` or a coarser mesh"
        )
    start, near = np.asarray(reach.indptr, np.int64), np.asarray(reach.indices, np.int64)
    response, known = np.zeros((len(near), 3, 3)), _PatchFactor(H)
    for i in range(f):
        at = slice(start[i], start[i + 1])
        response[at] = known.compute_response(near[at], i)
    return VertexPatches(start, near, response)


class _PatchFactor:
    """Factor of H on a patch of vertices.

    It is reused if the next vertex has the same patch.
    """

    def __init__(self, H: csr_array) -> None:
        self._H, self._patch_vertices = H, np.empty(0, np.int64)
        self._factor: DenseCholesky | None = None
        self._inverse = np.empty((0, 0))

    def compute_response(self, patch_vertices: NDArray[np.int64], vertex: int) -> NDArray[np.float64]:
        """Compute the response W (k, 3, 3) of a vertex.

        `patch_vertices` (k,) are the vertices of its patch.
        """
        if not np.array_equal(patch_vertices, self._patch_vertices):
            self._patch_vertices, self._factor = patch_vertices, self._factorise_patch(patch_vertices)
        own, alone = int(np.searchsorted(patch_vertices, vertex)), np.zeros((len(patch_vertices), 3, 3))
        alone[own] = np.eye(3)
        if self._factor is None:
            return alone
        X = self._inverse_columns(self._factor, own).reshape(-1, 3, 3)
        W = X @ np.linalg.inv(X[own])
        W[own] = np.eye(3)
        return W if np.isfinite(W).all() else alone

    def _inverse_columns(self, factor: DenseCholesky, own: int) -> NDArray[np.float64]:
        """Return the columns of the inverse for patch vertex `own`, (3k, 3)."""
        rows, columns = 3 * len(self._patch_vertices), slice(3 * own, 3 * own + 3)
        if rows < self._H.shape[0]:
            out = np.empty((rows, 3))
            factor.solve(np.eye(rows, 3, -3 * own), out)
            return out
        if len(self._inverse) < rows:  # all vertices share the patch of the whole mesh: invert it once
            self._inverse = np.empty((rows, rows))
            factor.solve(np.eye(rows), self._inverse)
        return self._inverse[:, columns]

    def _factorise_patch(self, near: NDArray[np.int64]) -> DenseCholesky | None:
        rows = (3 * near[:, None] + np.arange(3)).ravel()
        try:
            return DenseCholesky(csr_array(csr_array(self._H[rows])[:, rows]).toarray())
        except NotPositiveDefinite:
            return None


class _VertexRotations:
    """Rotations of the free vertices, estimated from all springs with a rest length."""

    def __init__(self, system: System, springs: Springs) -> None:
        i, j = springs.edges.T
        oriented = (springs.rest_length > 0.0) & (i != j)
        self._edges, self._rest_directions = springs.edges[oriented], springs.rest_direction[oriented]
        k = springs.stiffness[oriented]
        weight = k / k.max(initial=np.finfo(np.float64).tiny)
        count, rows = len(k), self._edges.T.ravel()
        shares = csr_array(
            (np.tile(weight, 2), (rows, np.tile(np.arange(count), 2))), shape=(system.num_vertices, count)
        )
        self._shares = csr_array(shares[system.free_vertices])

    def compute_rotations(self, p: Positions) -> NDArray[np.float64]:
        """Compute the rotations R (f, 3, 3) at positions p (n, 3).

        R is the rotation nearest to the sum of k n n0' over the incident springs, with n the direction of a spring and
        n0 its direction at rest.
        """
        i, j = self._edges.T
        _, unit = unit_directions(p[i] - p[j], self._rest_directions)
        sums = (self._shares @ (unit[:, :, None] * self._rest_directions[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
        size = np.linalg.norm(sums, axis=(1, 2))[:, None, None]
        left, _, right = np.linalg.svd(sums + np.where(size > 0.0, _DEGENERATE_ROTATION_SHIFT * size, 1.0) * np.eye(3))
        left[np.linalg.det(left @ right) < 0.0, :, 2] *= -1.0
        return left @ right


class _Jgs2Iteration:
    """The JGS2 iteration for one system."""

    can_identify_saddles: ClassVar[bool] = False

    def __init__(self, metric: ResidualMetric, springs: Springs, patches: VertexPatches) -> None:
        self._metric, self._rotations, self._free_vertices = (
            metric,
            _VertexRotations(metric.system, springs),
            metric.system.free_vertices,
        )
        f = len(self._free_vertices)
        alone = VertexPatches(np.arange(f + 1), np.arange(f), np.tile(np.eye(3), (f, 1, 1)))
        variants = (patches, alone) if len(patches.patch_vertices) > f else (alone,)
        self._patch_variants = [(variant, PatchScratch.from_patches(variant)) for variant in variants]

    def iterate_points(self, step: StepObjective, start: DescentPoint) -> Iterator[DescentPoint]:
        """Yield the points after `start`."""
        point = start
        while not point.is_stalled:
            point = self._next_point(step, point) or point._replace(is_stalled=True)
            yield point

    def can_terminate(self, step: StepObjective, at: DescentPoint) -> bool:
        """Return whether `at` may be the last point; clamped elements cannot separate saddles from minima."""
        return True

    def iteration_phases(self, step: StepObjective, at: DescentPoint) -> dict[str, Callable[[], object]]:
        """Return the gradient, the Hessian, the rotations and the vertex steps as callables."""
        hessian, turns = step.hessian(at.positions).assemble_clamped(), self._rotations.compute_rotations(at.positions)
        return {
            "gradient": lambda: step.gradient(at.positions),
            "hessian": lambda: step.hessian(at.positions).assemble_clamped(),
            "rotations": lambda: self._rotations.compute_rotations(at.positions),
            "steps": lambda: self._compute_direction(hessian, turns, at, *self._patch_variants[0]),
        }

    def _next_point(self, step: StepObjective, at: DescentPoint) -> DescentPoint | None:
        """Return the next point, None if round-off prevents descent."""
        hessian, turns = step.hessian(at.positions).assemble_clamped(), self._rotations.compute_rotations(at.positions)
        for variant in self._patch_variants:
            direction = self._compute_direction(hessian, turns, at, *variant)
            if -inner_product(at.gradient, direction) > self._metric.energy_roundoff(at.positions):
                found = backtracking_line_search(step, at, direction)
                if found is not None:
                    return found
        return None

    def _compute_direction(
        self,
        hessian: BlockMatrix,
        turns: NDArray[np.float64],
        at: DescentPoint,
        patches: VertexPatches,
        scratch: PatchScratch,
    ) -> Positions:
        """Compute the steps of all vertices (n, 3), zero for pinned vertices."""
        graph, free = hessian.graph, self._free_vertices
        steps, out = np.empty((len(free), 3)), np.zeros_like(at.positions)
        pointers, columns = np.asarray(graph.indptr, np.int64), np.asarray(graph.indices, np.int64)
        kernels.compute_directions(patches, turns, pointers, columns, hessian.values, at.gradient[free], scratch, steps)
        out[free] = steps
        return out

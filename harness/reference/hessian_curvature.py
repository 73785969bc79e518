"""Smallest eigenvalue of the Hessian at a point, with a bound on its uncertainty.

    lambda = x' H x,   |x| = 1
    doubt  = 4 eps |x|' |H| |x|  +  4 max over roundings p' of p of |x' (H(p') - H(p)) x|  +  1.1 d

The first term bounds the round-off of the sums. It is weighted by the components of x, so a stiff part that does not
move contributes nothing. The second term is the effect on the Hessian of rounding the positions, by one unit in the
last place up or down at each coordinate. The third term, d, is the decrease of |x' H x| within Newton's next step
across x, since the curvature in question is that of the nearby stationary point: in a curved valley, a point away from
the valley floor loses all of its curvature there.

A stationary point is a minimum where lambda > doubt and a saddle where lambda < -doubt. In between it is degenerate:
the minima may form a continuum, along a symmetry of the step, and float64 cannot distinguish these cases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import LinearOperator, eigsh
from springbench.harness.reference.reference_evaluator import factorise_symmetric_lu
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions, StepProblem
from springbench.solvers.model.system_matrix_assembly import diagonal_matrix
from springbench.solvers.objective.woodbury import RankUpdateEnergy

LARGE_SIZE = 30_000
"""Number of unknowns above which the block Cholesky factor replaces SuperLU, which would need gigabytes.

The factor only guides the search, since the eigenvalue is a product with the Hessian."""
NUM_ROUNDINGS = 3
MAX_STEP_FRACTION = 1e-4
"""Step length relative to the mesh extent above which a step gives no information on a nearby stationary point."""
SHIFTS = (0.0, *(10.0**k for k in range(-17, 2)))
"""Shifts relative to the Hessian's largest row sum.

The first one that makes it positive definite is close to the smallest eigenvalue."""


SolveFunction = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class SplitHessian(NamedTuple):
    """H = S + V V' [N/m] without the exactly pinned vertices.

    Attributes:
        sparse: S (3 f, 3 f).
        columns: V (3 f, r), with r = 0 where all energies have sparse Hessians (see
            `springbench.solvers.objective.woodbury`).
    """

    sparse: csr_array
    columns: NDArray[np.float64]

    def multiply(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return H x, (3 f,)."""
        return self.sparse @ x + self.columns @ (self.columns.T @ x)

    def quadratic_form(self, x: NDArray[np.float64]) -> float:
        """Return x' H x."""
        along = self.columns.T @ x
        return float(x @ (self.sparse @ x) + along @ along)

    def absolute_form(self, x: NDArray[np.float64]) -> float:
        """Return an upper bound of |x|' |H| |x|."""
        along = np.abs(self.columns).T @ np.abs(x)
        return float(np.abs(x) @ (abs(self.sparse) @ np.abs(x)) + along @ along)

    def toarray(self) -> NDArray[np.float64]:
        """Return all entries as a dense array."""
        return self.sparse.toarray() + self.columns @ self.columns.T


@dataclass(frozen=True, slots=True, eq=False)
class HessianCurvature:
    """Smallest eigenvalue of the Hessian at a point.

    Attributes:
        min_eigenvalue: smallest eigenvalue [N/m], infinite where no vertex is free.
        eigenvalue_uncertainty: bound on its uncertainty by round-off [N/m].
        direction: its eigenvector (n, 3), zero at exactly pinned vertices.
        solve: product with the inverse of the Hessian (3 f,), with the smallest shift that makes it positive definite.
    """

    min_eigenvalue: float
    eigenvalue_uncertainty: float
    direction: Positions
    solve: SolveFunction

    @property
    def is_convex(self) -> bool:
        """Whether the curvature is positive in all directions, beyond round-off."""
        return self.min_eigenvalue > self.eigenvalue_uncertainty

    @property
    def is_saddle(self) -> bool:
        """Whether it is negative in some direction, beyond round-off: a saddle, where the gradient vanishes."""
        return self.min_eigenvalue < -self.eigenvalue_uncertainty

    @property
    def is_degenerate(self) -> bool:
        """Whether the smallest eigenvalue is zero within its uncertainty."""
        return abs(self.min_eigenvalue) <= self.eigenvalue_uncertainty


def compute_curvature(problem: StepProblem, p: Positions) -> HessianCurvature:
    """Compute the smallest eigenvalue of the Hessian at p, and its uncertainty.

    Args:
        problem: step problem, of whose objective the Hessian is taken.
        p: positions (n, 3) [m], with exact pins at their targets.

    Returns:
        The curvature; its eigenvalue is infinite where no vertex is free, and nan where the Hessian is not finite.
    """
    free, direction = problem.system.free_vertices, np.zeros_like(p)
    if not len(free):
        return HessianCurvature(np.inf, 0.0, direction, np.copy)
    H = build_free_hessian(problem, p)
    if not (np.isfinite(H.sparse.data).all() and np.isfinite(H.columns).all()):
        return HessianCurvature(np.nan, np.inf, direction, np.copy)
    x, solve = _compute_softest_mode(H)
    smallest, rng = H.quadratic_form(x), np.random.default_rng(0)

    def change(q: Positions) -> float:
        return build_free_hessian(problem, q).quadratic_form(x) - smallest

    moved = max(abs(change(p * (1.0 + EPS * rng.integers(-1, 2, p.shape)))) for _ in range(NUM_ROUNDINGS))
    sums = EPS * H.absolute_form(x)
    direction[free] = x.reshape(-1, 3)
    here = HessianCurvature(smallest, 4.0 * (sums + moved), direction, solve)
    lost = -np.sign(smallest) * change(step_across(problem, p, here))
    return replace(here, eigenvalue_uncertainty=here.eigenvalue_uncertainty + 1.1 * max(0.0, float(lost)))


def step_across(
    problem: StepProblem, p: Positions, at: HessianCurvature, *, max_fraction: float = MAX_STEP_FRACTION
) -> Positions:
    """Return p after Newton's step orthogonal to the softest direction.

    Args:
        problem: step problem.
        p: positions (n, 3) [m].
        at: curvature at p.
        max_fraction: maximum length of the step relative to the mesh extent; longer steps are scaled down.

    Returns:
        Positions (n, 3) [m].
    """
    free, q, x = problem.system.free_vertices, p.copy(), at.direction[problem.system.free_vertices].ravel()
    gradient = problem.gradient(p)[free].ravel()
    step = at.solve(gradient - (x @ gradient) * x)
    step -= (x @ step) * x
    length, max_fraction = np.abs(step).max(), max_fraction * (float(np.ptp(p, axis=0).max()) or 1.0)
    q[free] -= (step * min(1.0, max_fraction / length) if length else step).reshape(-1, 3)
    return q


def build_free_hessian(problem: StepProblem, p: Positions) -> SplitHessian:
    """Assemble the objective's Hessian at p.

    Args:
        problem: step problem; inertia, penalty pins and all energies contribute.
        p: positions (n, 3) [m].

    Returns:
        The Hessian [N/m] without the rows and columns of exactly pinned vertices.
    """
    system = problem.system
    _, vertices, weight = system.penalty_pins
    anchor_stiffness = system.inertia_diagonal + np.bincount(vertices, weight, minlength=system.num_vertices)
    total, columns = diagonal_matrix(np.repeat(anchor_stiffness, 3)), [np.empty((*p.shape, 0))]
    for energy in problem.energies:
        if isinstance(energy, RankUpdateEnergy):
            total = csr_array(total + energy.sparse_hessian(p))
            columns.append(energy.low_rank_columns(p))
        else:
            total = csr_array(total + energy.hessian(p))
    free = (3 * system.free_vertices[:, None] + np.arange(3)).ravel()
    V = np.concatenate(columns, axis=2).reshape(p.size, -1)
    return SplitHessian(csr_array(total[free][:, free]), V[free])


def _compute_softest_mode(H: SplitHessian) -> tuple[NDArray[np.float64], SolveFunction]:
    """Compute the unit eigenvector of a symmetric matrix for its smallest eigenvalue, and a solver.

    The solver is the product with the inverse of the matrix, with the smallest shift that makes it positive definite.
    """
    size = H.sparse.indptr.size - 1
    rows = abs(H.sparse).sum(axis=1) + np.abs(H.columns) @ np.abs(H.columns).sum(axis=0)
    scale = float(rows.max())
    start = np.random.default_rng(0).normal(size=size)  # the same eigenvector each time
    for shift in SHIFTS:
        solve = factorise_definite(
            H._replace(sparse=csr_array(H.sparse + diagonal_matrix(np.full(size, shift * scale))))
        )
        if solve is not None:
            given: Any = {"shape": H.sparse.shape, "dtype": np.dtype(np.float64)}
            settings: Any = {
                "k": 1,
                "sigma": -shift * scale,
                "OPinv": LinearOperator(matvec=solve, **given),
                "v0": start,
                "tol": 1e-8,
            }
            A = LinearOperator(matvec=H.multiply, **given) if H.columns.size else H.sparse
            _, vectors = cast(tuple[Any, NDArray[np.float64]], eigsh(A, **settings))
            return vectors[:, 0], solve
    raise ValueError("a Hessian that no multiple of the identity makes positive definite is not symmetric")


def factorise_definite(H: SplitHessian) -> SolveFunction | None:
    """Factorise a symmetric 3 x 3 block matrix, and return the product with its inverse.

    The result is None for a matrix that is not positive definite: in floating point some pivot of the factor is not
    positive. For S + V V', the number of negative eigenvalues is that of S less that of I + V'S^-1 V
    (Sylvester's law of inertia).
    """
    S, V = H
    if S.indptr.size > LARGE_SIZE:
        blocks = bsr_array(S, blocksize=(3, 3))
        blocks.sort_indices()
        cholesky = BlockCholesky(csr_array((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr)))
        if not cholesky.factorise(np.array(blocks.data, np.float64)):
            return None
        inner: SolveFunction = lambda x: cholesky.solve(x.reshape(-1, 3)).ravel()  # noqa: E731
        negative = 0
    else:
        try:
            factor = factorise_symmetric_lu(S)
        except RuntimeError:  # a pivot is zero
            return None
        pivots = factor.U.diagonal()
        if not np.array_equal(factor.perm_r, factor.perm_c):  # SuperLU chose a pivot off the diagonal
            return None
        inner, negative = factor.solve, int(np.count_nonzero(~(pivots > 0.0)))
    if not V.size:
        return inner if negative == 0 else None
    W = np.stack([inner(np.ascontiguousarray(column)) for column in V.T], axis=1)
    C = np.eye(V.shape[1]) + V.T @ W
    if not np.isfinite(C).all() or negative != np.count_nonzero(np.linalg.eigvalsh(0.5 * (C + C.T)) < 0.0):
        return None

    def solve(b: NDArray[np.float64]) -> NDArray[np.float64]:
        x = inner(b)
        return x - W @ np.linalg.solve(C, V.T @ x)

    return solve

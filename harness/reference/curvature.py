"""The curvature at a point: the Hessian's smallest eigenvalue, and what of it is not to be relied on.

    lambda = x' H x,   |x| = 1
    doubt  = 4 eps |x|' |H| |x|  +  4 max over roundings p' of p of |x' (H(p') - H(p)) x|  +  1.1 d

The first part is what sums lose, over the places that x is at: a stiff part that does not move has no share in it. The
second is what the rounding of the positions makes of the Hessian, a last bit up or down at each coordinate; the third,
d, is by how much |x' H x| falls within Newton's next step across x, for the curvature in question is that of the
stationary point nearby: in a valley all that a point beside its floor has is lost there.
A stationary point is a minimum where lambda > doubt and a saddle where lambda < -doubt. In between it is flat: the
minima may be a continuum, along a symmetry of the step, and no float64 number tells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import LinearOperator, eigsh

from harness.reference.oracle import symmetric_lu
from solvers.linear.block import BlockCholesky
from solvers.matrices import diagonal
from solvers.problem import Positions, StepProblem
from solvers.round_off import EPS

LARGE = 30_000
"""Unknowns from which on SuperLU would need gigabytes, and the blocks' own Cholesky factor takes its place; it guides
the search alone, for the eigenvalue is a product with the Hessian."""
ROUNDINGS = 3
SHORT = 1e-4
"""Of the shape: steps that are longer tell of no stationary point nearby."""
SHIFTS = (0.0, *(10.0**k for k in range(-17, 2)))
"""Of the Hessian's largest row: the first that makes it positive definite lies next to the smallest eigenvalue."""


Solve = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class Curvature:
    """smallest: the Hessian's smallest eigenvalue [N/m], infinite where nothing is free; doubt: what of it may be
    round-off [N/m]; direction: its eigenvector (n, 3), zero at exactly pinned vertices; solve: the product with the
    inverse of the Hessian (3 f,), shifted as little as makes it positive definite."""

    smallest: float
    doubt: float
    direction: Positions
    solve: Solve

    @property
    def convex(self) -> bool:
        """Whether the curvature is positive in all directions, beyond round-off."""
        return self.smallest > self.doubt

    @property
    def falls(self) -> bool:
        """Whether it is negative in some direction, beyond round-off: a saddle, where the gradient vanishes."""
        return self.smallest < -self.doubt

    @property
    def flat(self) -> bool:
        """Whether there is a direction in which it may be zero, and none in which it is negative."""
        return abs(self.smallest) <= self.doubt


def curvature(problem: StepProblem, p: Positions) -> Curvature:
    """The curvature at p (n, 3) [m], exactly pinned vertices on their targets."""
    free, direction = problem.system.free, np.zeros_like(p)
    if not len(free):
        return Curvature(np.inf, 0.0, direction, np.copy)
    H = free_hessian(problem, p)
    if not np.isfinite(H.data).all():
        return Curvature(np.nan, np.inf, direction, np.copy)
    x, solve = _softest(H)
    smallest, rng = float(x @ (H @ x)), np.random.default_rng(0)

    def change(q: Positions) -> float:
        return float(x @ (free_hessian(problem, q) @ x)) - smallest

    moved = max(abs(change(p * (1.0 + EPS * rng.integers(-1, 2, p.shape)))) for _ in range(ROUNDINGS))
    sums = EPS * float(np.abs(x) @ (abs(H) @ np.abs(x)))
    direction[free] = x.reshape(-1, 3)
    here = Curvature(smallest, 4.0 * (sums + moved), direction, solve)
    lost = -np.sign(smallest) * change(across(problem, p, here))
    return replace(here, doubt=here.doubt + 1.1 * max(0.0, float(lost)))


def across(problem: StepProblem, p: Positions, at: Curvature, *, most: float = SHORT) -> Positions:
    """p less Newton's step across the softest direction, or less the first part of it, up to `most` of the shape."""
    free, q, x = problem.system.free, p.copy(), at.direction[problem.system.free].ravel()
    gradient = problem.gradient(p)[free].ravel()
    step = at.solve(gradient - (x @ gradient) * x)
    step -= (x @ step) * x
    length, most = np.abs(step).max(), most * (float(np.ptp(p, axis=0).max()) or 1.0)
    q[free] -= (step * min(1.0, most / length) if length else step).reshape(-1, 3)
    return q


def free_hessian(problem: StepProblem, p: Positions) -> csr_array:
    """The objective's Hessian at p [N/m], without the exactly pinned vertices, (3 f, 3 f)."""
    system = problem.system
    _, vertices, weight = system.penalty
    held = system.inertia + np.bincount(vertices, weight, minlength=system.vertices)
    total = diagonal(np.repeat(held, 3))
    for energy in problem.energies:
        total = csr_array(total + energy.hessian(p))
    free = (3 * system.free[:, None] + np.arange(3)).ravel()
    return csr_array(total[free][:, free])


def _softest(H: csr_array) -> tuple[NDArray[np.float64], Solve]:
    """The eigenvector of the smallest eigenvalue of a symmetric matrix, of length 1, and the product with the inverse
    of the matrix, shifted as little as makes it positive definite."""
    size = H.indptr.size - 1
    scale = float(abs(H).sum(axis=1).max())
    start = np.random.default_rng(0).normal(size=size)  # the same eigenvector each time
    for shift in SHIFTS:
        solve = definite(csr_array(H + diagonal(np.full(size, shift * scale))))
        if solve is not None:
            given: Any = {"shape": H.shape, "matvec": solve, "dtype": np.dtype(np.float64)}
            settings: Any = {
                "k": 1,
                "sigma": -shift * scale,
                "OPinv": LinearOperator(**given),
                "v0": start,
                "tol": 1e-8,
            }
            _, vectors = cast(tuple[Any, NDArray[np.float64]], eigsh(H, **settings))
            return vectors[:, 0], solve
    raise ValueError("a Hessian that no multiple of the identity makes positive definite is not symmetric")


def definite(H: csr_array) -> Solve | None:
    """The product with the inverse of a symmetric matrix of 3 x 3 blocks; None where it is not positive definite in
    floating point: some pivot of its factor is not positive."""
    if H.indptr.size > LARGE:
        blocks = bsr_array(H, blocksize=(3, 3))
        blocks.sort_indices()
        cholesky = BlockCholesky(csr_array((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr)))
        if not cholesky.factorise(np.array(blocks.data, np.float64)):
            return None
        return lambda x: cholesky.solve(x.reshape(-1, 3)).ravel()
    try:
        factor = symmetric_lu(H)
    except RuntimeError:  # a pivot is zero
        return None
    symmetric = np.array_equal(factor.perm_r, factor.perm_c)  # else a pivot was not to be had on the diagonal
    return factor.solve if symmetric and (factor.U.diagonal() > 0.0).all() else None

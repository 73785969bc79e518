"""Preconditioners of conjugate gradients, in Newton's methods and in nonlinear ones.

    factor          Q^-1                                               a solve with the prefactored matrix
    schwarz         dense inverses of patches of H+, on levels         see `solvers.linear.schwarz`
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

from solvers.core.bounds import is_bounded
from solvers.core.descent import Metric
from solvers.core.eigenvalues import Filtering
from solvers.core.fixed_objective import Objective
from solvers.core.objective import Hessian, StepObjective
from solvers.core.pattern import Matrix
from solvers.energies.elements import add_blocks
from solvers.kernels import forms
from solvers.kernels import hessian as springs
from solvers.linear.schwarz import Patches, ordered
from solvers.problem import Positions, Unsupported

Preconditioning = Literal["factor", "schwarz", "block-jacobi"]
"""The names of the preconditioners."""

Preconditioner = Callable[[Positions], Positions]
"""A map from gradients [N] to displacements [m], both (n, 3)."""

At = Callable[[StepObjective, Positions], tuple[Hessian, Preconditioner]]
"""A function that returns the Hessian at p (n, 3) and its preconditioner."""

LEAST = 1e-6
"""Fraction of Q's diagonal added to blocks, because the springs at a massless vertex may act in one direction only."""


def preconditioning(name: Preconditioning, metric: Metric, objective: Objective, solver: str) -> At:
    """Return the builder of a preconditioner.

    Raises Unsupported if an energy without elements must be clamped.
    """
    if name == "factor":
        return _Factor(metric)
    energies = objective.system.energies
    unknown = {type(energies[k]).__name__ for k in objective.own if not is_bounded(energies[k])}
    if unknown:
        raise Unsupported(
            f"{solver}, preconditioner: {name}: clamps second derivatives element by element, and there are none of "
            f"{', '.join(sorted(unknown))}; take preconditioner: factor"
        )
    return _Schwarz(metric) if name == "schwarz" else _Blocks(metric)


class _Factor:
    """Q^-1, or (S Q S)^-1 with active contact."""

    def __init__(self, metric: Metric) -> None:
        self._metric = metric

    def __call__(self, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
        hessian = step.hessian(p)
        beyond = step.touched or any(len(blocks.vertices) for blocks in hessian.met.blocks)
        return hessian, Scaled(self._metric, *_beyond(step, hessian, len(p))) if beyond else self._metric.solve


class _Blocks:
    """Block Jacobi with the diagonal blocks of the clamped Hessian."""

    def __init__(self, metric: Metric) -> None:
        self._free, self._least = metric.system.free, _least(metric)

    def __call__(self, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
        hessian = step.hessian(p)
        inverses = np.linalg.inv(diagonal_blocks(step, hessian, p) + self._least)
        return hessian, _among(self._free, lambda r: np.einsum("fij,fj->fi", inverses, r))


class _Schwarz:
    """Additive Schwarz with patches of the clamped Hessian."""

    def __init__(self, metric: Metric) -> None:
        self._free, self._least = metric.system.free, _least(metric)
        self._order = ordered(metric.inner)
        self._known: tuple[Matrix, Patches] | None = None

    def __call__(self, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
        hessian = step.hessian(p)
        matrix = hessian.convex()
        if self._known is None or self._known[0] is not matrix:
            self._known = matrix, Patches(matrix.graph, self._order)
        blocks = matrix.values.copy()
        blocks[matrix.places.diagonal[self._free]] += self._least
        return hessian, _among(self._free, self._known[1].inverted(blocks).solve)


def _least(metric: Metric) -> NDArray[np.float64]:
    """Return blocks (f, 3, 3) [N/m] to add to the diagonal."""
    return LEAST * metric.diagonal[:, None, None] * np.eye(3)


def _among(free: NDArray[np.int64], solve: Preconditioner) -> Preconditioner:
    """Extend a solve for free vertices (f,) to all vertices (n, 3)."""

    def whole(b: Positions) -> Positions:
        out = np.zeros_like(b)
        out[free] = solve(b[free])
        return out

    return whole


def diagonal_blocks(step: StepObjective, hessian: Hessian, p: Positions) -> NDArray[np.float64]:
    """Return the diagonal blocks (f, 3, 3) [N/m] of the clamped Hessian without assembling that matrix.

    They include springs, forms, elements and pairs.
    """
    whole, clamped = step.whole, hessian.filtered(Filtering())
    terms, number, form = whole.terms, whole.number, whole.form
    places = springs.Places(whole.system.free, number, np.full((len(terms.stiffness), 2), -1))
    out = np.empty((len(whole.system.free), 3, 3))
    springs.assemble(terms, places, None, p, clamped.tension, clamped.keep, out)
    if form is not None:
        forms.add_blocks(form, number, np.full((len(form.weight), 2), -1), out)
    for one, curvature in zip(step.stated, clamped.curvature, strict=True):
        add_blocks(one.elements, _on_diagonal(number, one.elements.vertices), curvature, out)
    for pairs in clamped.pairs:
        if len(pairs.vertices):
            pairs.add(_on_diagonal(number, pairs.vertices), out)
    return out


def _on_diagonal(number: NDArray[np.int64], vertices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the diagonal blocks of elements with vertices (m, k), as (m, k^2), -1 off the diagonal.

    The block is the vertex's index (n + 1,), whose last entry is for the vertex -1.
    """
    k = vertices.shape[1]
    places = np.full((len(vertices), k * k), -1)
    places[:, :: k + 1] = number[vertices]
    return places


class Scaled:
    """The preconditioner (S Q S)^-1 with S_i = (I + W_i/Q_ii)^(1/2) at some vertices, I at all others.

    Attributes:
        shrunk: these vertices (c,), and S_i^-1 (c, 3, 3).
    """

    def __init__(self, metric: Metric, vertices: NDArray[np.int64], blocks: NDArray[np.float64]) -> None:
        """Create the preconditioner for positive semidefinite blocks W (c, 3, 3) [N/m] of vertices (c,)."""
        self._metric, system = metric, metric.system
        resists = np.full(system.vertices, np.inf)
        resists[system.free] = metric.diagonal
        size, axes = np.linalg.eigh(blocks)
        shrunk = (1.0 + np.maximum(0.0, size) / resists[vertices, None]) ** -0.5
        self.shrunk = vertices, (axes * shrunk[:, None, :]) @ axes.transpose(0, 2, 1)

    def __call__(self, b: Positions) -> Positions:
        """Return (S Q S)^-1 b, (n, 3)."""
        scaled = b.copy()
        self._shrink(scaled)
        x = self._metric.solve(scaled)
        self._shrink(x)
        return x

    def _shrink(self, x: Positions) -> None:
        vertices, root = self.shrunk
        x[vertices] = np.einsum("vij,vj->vi", root, x[vertices])


def _beyond(step: StepObjective, hessian: Hessian, n: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the vertices (c,) with contact and the blocks (c, 3, 3) [N/m] of elements and pairs outside Q."""
    blocks, acted, number = np.zeros((n, 3, 3)), np.zeros(n, np.bool_), np.append(np.arange(n), -1)
    for one, curvature in zip(step.stated, hessian.curvature, strict=True):
        if not one.projective:
            add_blocks(one.elements, _on_diagonal(number, one.elements.vertices), curvature, blocks)
            acted[one.elements.vertices] = True
    for pairs in hessian.met.blocks:
        pairs.add(_on_diagonal(number, pairs.vertices), blocks)
        acted[pairs.vertices] = True
    acted &= blocks.any(axis=(1, 2))
    return np.flatnonzero(acted), blocks[acted]

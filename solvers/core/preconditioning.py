"""What conjugate gradients are preconditioned by, in Newton's methods and in nonlinear ones.

    factor          Q^-1                                               a solve with the prefactored matrix
    schwarz         dense inverses of patches of H+, on levels         see `solvers.linear.schwarz`
    block-jacobi    inverses of the 3 x 3 blocks on H+'s diagonal

H+ is the Hessian at each point, of elements whose negative eigenvalues are clamped: what the last two are of. They are
products alone, as suit a graphics processor; they leave Q's factor to what measures residuals.

Contact is far stiffer than Q, on a few vertices. There P = S Q S takes the place of Q, with S_i = (I + W_i/Q_ii)^(1/2)
of the blocks W_i that it adds to H: on these vertices P is Q + W but for what couples them, and it is Q on all others.
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
"""Their names."""

Preconditioner = Callable[[Positions], Positions]
"""Gradients [N] to displacements [m], both (n, 3)."""

At = Callable[[StepObjective, Positions], tuple[Hessian, Preconditioner]]
"""The Hessian at p (n, 3), and what preconditions it there."""

LEAST = 1e-6
"""Of Q's diagonal, what is added to blocks: a vertex without mass may hang on springs that resist in one direction."""


def preconditioning(name: Preconditioning, metric: Metric, objective: Objective, solver: str) -> At:
    """What does so in a system. Raises Unsupported where energies that state no elements would have to be clamped."""
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
    """Q^-1, or (S Q S)^-1 where something is touched."""

    def __init__(self, metric: Metric) -> None:
        self._metric = metric

    def __call__(self, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
        hessian = step.hessian(p)
        beyond = step.touched or any(len(blocks.vertices) for blocks in hessian.met.blocks)
        return hessian, Scaled(self._metric, *_beyond(step, hessian, len(p))) if beyond else self._metric.solve


class _Blocks:
    """The diagonal blocks of the clamped Hessian."""

    def __init__(self, metric: Metric) -> None:
        self._free, self._least = metric.system.free, _least(metric)

    def __call__(self, step: StepObjective, p: Positions) -> tuple[Hessian, Preconditioner]:
        hessian = step.hessian(p)
        inverses = np.linalg.inv(diagonal_blocks(step, hessian, p) + self._least)
        return hessian, _among(self._free, lambda r: np.einsum("fij,fj->fi", inverses, r))


class _Schwarz:
    """Patches of the clamped Hessian."""

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
    """Blocks (f, 3, 3) [N/m]."""
    return LEAST * metric.diagonal[:, None, None] * np.eye(3)


def _among(free: NDArray[np.int64], solve: Preconditioner) -> Preconditioner:
    """What is solved for free vertices (f,), for all (n, 3)."""

    def whole(b: Positions) -> Positions:
        out = np.zeros_like(b)
        out[free] = solve(b[free])
        return out

    return whole


def diagonal_blocks(step: StepObjective, hessian: Hessian, p: Positions) -> NDArray[np.float64]:
    """The blocks (f, 3, 3) [N/m] on the diagonal of `hessian.convex()`, at p, without that matrix: of springs, forms,
    elements and pairs."""
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
    """Where the blocks of elements of vertices (m, k) lie, (m, k^2), where a vertex has one with itself alone: that of
    its number (n + 1,), the last of them of the vertex -1; -1 for none."""
    k = vertices.shape[1]
    places = np.full((len(vertices), k * k), -1)
    places[:, :: k + 1] = number[vertices]
    return places


class Scaled:
    """(S Q S)^-1 with S_i = (I + W_i/Q_ii)^(1/2) for some vertices, I for all others.

    shrunk: these vertices (c,), and S_i^-1 (c, 3, 3)."""

    def __init__(self, metric: Metric, vertices: NDArray[np.int64], blocks: NDArray[np.float64]) -> None:
        """blocks: W (c, 3, 3) [N/m] of vertices (c,), positive semidefinite."""
        self._metric, system = metric, metric.system
        resists = np.full(system.vertices, np.inf)
        resists[system.free] = metric.diagonal
        size, axes = np.linalg.eigh(blocks)
        shrunk = (1.0 + np.maximum(0.0, size) / resists[vertices, None]) ** -0.5
        self.shrunk = vertices, (axes * shrunk[:, None, :]) @ axes.transpose(0, 2, 1)

    def __call__(self, b: Positions) -> Positions:
        """(S Q S)^-1 b, (n, 3)."""
        scaled = b.copy()
        self._shrink(scaled)
        x = self._metric.solve(scaled)
        self._shrink(x)
        return x

    def _shrink(self, x: Positions) -> None:
        vertices, root = self.shrunk
        x[vertices] = np.einsum("vij,vj->vi", root, x[vertices])


def _beyond(step: StepObjective, hessian: Hessian, n: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """What elements that are in no Q add to the blocks of n vertices: which (c,), and the blocks (c, 3, 3) [N/m]."""
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

"""Barrier contact for vertex block descent (VBD).

Each sweep uses a contact model that is separable by vertex:

    g_i.(x_i - p_i) + 4/2 (x_i - p_i)' H_ii (x_i - p_i)      for each vertex i of a pair, at the positions p of a sweep

g: gradient of the barriers and their friction; H_ii: diagonal blocks of a pair's clamped Hessian. A positive
semidefinite H of four vertices is at most four times the diagonal of its blocks. The model therefore majorises the
quadratic model, whatever colours the four vertices have. A sweep gives q from p, and the step is t (q - p). t is the
first of 1, 1/2, ... that is collision-free and decreases the objective sufficiently. If there is none, each vertex
moves along its own block's Newton direction instead, which is a descent direction.

Chen, Liu, Yang and Yuksel 2024 add contact to the vertices' own blocks. Their energy is not a barrier, so that vertices
may interpenetrate. Steps are extrapolated by Chebyshev's factors, as in sweeps without contact, where the extrapolation
is collision-free and does not increase the objective. While no pair is active, sweeps are bitwise identical to those
without contact.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from solvers.contact.energy import Planes
from solvers.core.bounds import PairBlocks
from solvers.core.descent import Point, search
from solvers.core.driver import Iterating
from solvers.core.objective import StepObjective
from solvers.problem import Positions

Array = NDArray[np.float64]

LEAST = 1e-6
"""Stiffness added in every direction, relative to the majorant of a vertex."""


class Separable(NamedTuple):
    """Separable contact model at a point.

    Attributes:
        vertices: (v,).
        gradient: gradient of contact (v, 3) [N].
        block: four times the diagonal Hessian blocks (v, 3, 3) [N/m].
    """

    vertices: NDArray[np.int64]
    gradient: Positions
    block: Array

    def planes(self, p: Positions, held: Array) -> Planes:
        """Express the model as two-sided planes normal to three axes per vertex.

        Args:
            p: positions of the model (n, 3) [m].
            held: stiffness of each vertex without contact (n,) [N/m].
        """
        curve, axes = np.linalg.eigh(self.block)
        k = np.maximum(curve, 0.0) + LEAST * held[self.vertices, None]
        normal = np.swapaxes(axes, 1, 2)
        offset = np.einsum("vai,vi->va", normal, p[self.vertices]) - np.einsum("vai,vi->va", normal, self.gradient) / k
        normal, none = normal.reshape(-1, 3), np.zeros(k.size)
        return Planes(np.repeat(self.vertices, 3), normal, offset.ravel(), np.zeros_like(normal), k.ravel(), none)


class Sweeps(Protocol):
    """Vertex block descent sweeps of one step."""

    def alone(self, p: Positions) -> Positions:
        """Return the positions after a sweep from p without contact, (n, 3) each.

        Chebyshev extrapolation uses the preceding sweeps since the last `pushed`.
        """
        ...

    def pushed(self, p: Positions, planes: Planes) -> Positions:
        """Return the positions after a sweep from p with contact planes, without extrapolation."""
        ...


class Guarded(Iterating):
    """Iteration state of VBD with barriers.

    majorant (n,) [N/m]: of all energies but contact; gauge: returns the residual of positions.
    """

    def __init__(
        self,
        sweeps: Sweeps,
        step: StepObjective,
        guess: Positions,
        majorant: Array,
        radius: float,
        gauge: Callable[[Positions], float],
    ) -> None:
        self._sweeps, self._step, self._majorant, self._gauge = sweeps, step, majorant, gauge
        self._squared, self._factor = radius**2, 0.0
        self.positions = step.placed(guess)
        self._older = self.positions

    def residual(self) -> float:
        """Return the residual of the current positions."""
        return self._gauge(self.positions)

    def advance(self) -> bool:
        """Perform one iteration."""
        p, blocks = self.positions, self._blocks(self.positions)
        if not blocks:
            q = self._sweeps.alone(p)
            if self._step.reach(p, q - p) == 1.0 and not self._blocks(q):
                self.positions, self._older, self._factor = q, p, 0.0
                return True
        at, model = Point(p, self._step.gradient(p)), self._model(p, blocks)
        q = self._sweeps.pushed(p, model.planes(p, self._majorant))
        found = search(self._step, at, q - p) or search(self._step, at, self._each(at.gradient, model))
        if found is None:
            return False
        self.positions, self._older = self._further(found.positions), p
        return True

    def _blocks(self, p: Positions) -> list[PairBlocks]:
        found = (energy.blocks(p, 0.0) for energy in self._step.bounded)
        return [blocks for blocks in found if len(blocks.vertices)]

    def _model(self, p: Positions, blocks: list[PairBlocks]) -> Separable:
        gradient, total, known = np.zeros_like(p), np.zeros((len(p), 3, 3)), np.zeros(len(p), bool)
        for energy in self._step.bounded:
            energy.add_gradient(p, gradient)
        for one in blocks:
            k = one.vertices.shape[1]
            own = np.einsum("piajb,ij->piab", one.values.reshape(-1, k, 3, k, 3), np.eye(k))
            moves = one.vertices >= 0
            np.add.at(total, one.vertices[moves], k * own[moves])
            known[one.vertices[moves]] = True
        vertices = np.flatnonzero(known)
        return Separable(vertices, gradient[vertices], total[vertices])

    def _each(self, gradient: Positions, model: Separable) -> Positions:
        """Return the Newton direction of each vertex with its own block."""
        block = self._majorant[:, None, None] * np.eye(3)
        block[model.vertices] += model.block
        return np.asarray(-np.linalg.solve(block, gradient[:, :, None])[:, :, 0], np.float64)

    def _further(self, q: Positions) -> Positions:
        """Extrapolate q from the previous start if that is collision-free and does not increase the objective."""
        if not self._squared:
            return q
        before = self._factor
        w = 4.0 / (4.0 - self._squared * before) if before > 1.0 else 2.0 / (2.0 - self._squared) if before else 1.0
        self._factor = w
        if w > 1.0:
            way = self._step.placed(self._older + w * (q - self._older)) - q
            if self._step.reach(q, way) == 1.0 and self._step.rise(q, q + way)[0] <= 0.0:
                return q + way
            self._factor = 0.0
        return q

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
from springbench.solvers.contact.half_space.half_space_potential import ContactPlanes
from springbench.solvers.iteration.descent_method import DescentPoint, backtracking_line_search
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.model.barrier_energy import PairBlocks
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.objective.step_objective import StepObjective

FloatArray = NDArray[np.float64]

MIN_STIFFNESS_RATIO = 1e-6
"""Stiffness added in every direction, relative to the majorant of a vertex."""


class SeparableModel(NamedTuple):
    """Separable contact model at a point.

    Attributes:
        vertices: (v,).
        gradient: gradient of contact (v, 3) [N].
        diagonal_blocks: four times the diagonal Hessian blocks (v, 3, 3) [N/m].
    """

    vertices: NDArray[np.int64]
    gradient: Positions
    diagonal_blocks: FloatArray

    def to_contact_planes(self, p: Positions, majorant: FloatArray) -> ContactPlanes:
        """Express the model as two-sided planes normal to three axes per vertex.

        Args:
            p: positions of the model (n, 3) [m].
            majorant: stiffness of each vertex without contact (n,) [N/m].
        """
        curve, axes = np.linalg.eigh(self.diagonal_blocks)
        k = np.maximum(curve, 0.0) + MIN_STIFFNESS_RATIO * majorant[self.vertices, None]
        normal = np.swapaxes(axes, 1, 2)
        offset = np.einsum("vai,vi->va", normal, p[self.vertices]) - np.einsum("vai,vi->va", normal, self.gradient) / k
        normal, none = normal.reshape(-1, 3), np.zeros(k.size)
        return ContactPlanes(
            np.repeat(self.vertices, 3), normal, offset.ravel(), np.zeros_like(normal), k.ravel(), none
        )


class VbdSweeps(Protocol):
    """Vertex block descent sweeps of one step."""

    def sweep_without_contact(self, p: Positions) -> Positions:
        """Return the positions after a sweep from p without contact, (n, 3) each.

        Chebyshev extrapolation uses the preceding sweeps since the last `sweep_with_planes`.
        """
        ...

    def sweep_with_planes(self, p: Positions, planes: ContactPlanes) -> Positions:
        """Return the positions after a sweep from p with contact planes, without extrapolation.

        Args:
            p: positions (n, 3) [m] at which the sweep starts.
            planes: two-sided planes normal to three axes per vertex.

        Returns:
            Positions (n, 3) [m].
        """
        ...


class BarrierVbdState(SolverState):
    """Iteration state of VBD with barriers."""

    def __init__(
        self,
        sweeps: VbdSweeps,
        step: StepObjective,
        initial_guess: Positions,
        majorant: FloatArray,
        radius: float,
        compute_residual: Callable[[Positions], float],
    ) -> None:
        """Start the iteration.

        Args:
            sweeps: sweeps of the step without contact.
            step: objective of the step.
            initial_guess: positions without intersections (n, 3) [m], not modified.
            majorant: stiffness of each vertex by all energies except contact (n,) [N/m].
            radius: rho of the Chebyshev acceleration, 0 for none.
            compute_residual: returns the residual [J^(1/2)] at positions.
        """
        self._sweeps, self._step, self._majorant, self._compute_residual = sweeps, step, majorant, compute_residual
        self._squared, self._factor = radius**2, 0.0
        self.positions = step.apply_exact_pins(initial_guess)
        self._previous_positions = self.positions

    def residual(self) -> float:
        """Return the residual of the current positions."""
        return self._compute_residual(self.positions)

    def step_state(self) -> bool:
        """Perform one iteration."""
        p, blocks = self.positions, self._step.compute_active_blocks(self.positions)
        if not blocks:
            q = self._sweeps.sweep_without_contact(p)
            if self._step.max_step_size(p, q - p) == 1.0 and not self._step.compute_active_blocks(q):
                self.positions, self._previous_positions, self._factor = q, p, 0.0
                return True
        at, model = DescentPoint(p, self._step.gradient(p)), self._build_model(p, blocks)
        q = self._sweeps.sweep_with_planes(p, model.to_contact_planes(p, self._majorant))
        found = backtracking_line_search(self._step, at, q - p) or backtracking_line_search(
            self._step, at, self._vertex_newton_steps(at.gradient, model)
        )
        if found is None:
            return False
        self.positions, self._previous_positions = self._extrapolate(found.positions), p
        return True

    def _build_model(self, p: Positions, blocks: list[PairBlocks]) -> SeparableModel:
        gradient, total, known = np.zeros_like(p), np.zeros((len(p), 3, 3)), np.zeros(len(p), bool)
        for energy in self._step.barrier_energies:
            energy.add_gradient(p, gradient)
        for one in blocks:
            k = one.vertices.shape[1]
            # A positive semidefinite matrix of k x k blocks is at most k times the matrix of its diagonal blocks.
            own = np.einsum("piajb,ij->piab", one.values.reshape(-1, k, 3, k, 3), np.eye(k))
            moves = one.vertices >= 0
            np.add.at(total, one.vertices[moves], k * own[moves])
            known[one.vertices[moves]] = True
        vertices = np.flatnonzero(known)
        return SeparableModel(vertices, gradient[vertices], total[vertices])

    def _vertex_newton_steps(self, gradient: Positions, model: SeparableModel) -> Positions:
        """Return the Newton direction of each vertex with its own block."""
        block = self._majorant[:, None, None] * np.eye(3)
        block[model.vertices] += model.diagonal_blocks
        return np.asarray(-np.linalg.solve(block, gradient[:, :, None])[:, :, 0], np.float64)

    def _extrapolate(self, q: Positions) -> Positions:
        """Extrapolate q from the start of the previous iteration, if that is permitted.

        The extrapolation must be collision-free and must not increase the objective.
        """
        if not self._squared:
            return q
        before = self._factor
        w = 4.0 / (4.0 - self._squared * before) if before > 1.0 else 2.0 / (2.0 - self._squared) if before else 1.0
        self._factor = w
        if w > 1.0:
            displacement = (
                self._step.apply_exact_pins(self._previous_positions + w * (q - self._previous_positions)) - q
            )
            if (
                self._step.max_step_size(q, displacement) == 1.0
                and self._step.objective_change(q, q + displacement)[0] <= 0.0
            ):
                return q + displacement
            self._factor = 0.0
        return q

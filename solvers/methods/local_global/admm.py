"""ADMM for the step problem (Overby, Brown, Li and Narain 2017, "ADMM contains projective dynamics").

    min  U(z) + terms quadratic in p   subject to   A p = z,   weighted by W K

    z <- argmin U(z) + W/2 |A p + u - z|_K^2
    u <- u + A p - z
    p <- argmin of the quadratic part + W/2 |A p - z + u|_K^2

For a projective energy U(z) = |z - d(z)|_K^2/2, where d(z) is the nearest vector of zero energy,
z = (d(v) + W v)/(1 + W) with v = A p + u. With W = 1 the matrix is Q and z - u = d(v). An iteration is then one of
local-global, except that it projects A p + u, the edges extended by their accumulated error. The first iteration, with
u = 0, equals local-global.

Descent is not guaranteed. At a fixed point v has the length l + (l - r)/W. A spring shorter than r/(1 + W) has no
fixed point, because its negative curvature exceeds the curvature of the weight. Small weights converge fast where no
spring is compressed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.linalg.solver_selection import build_linear_solver
from springbench.solvers.methods.local_global.prefactored import (
    PreparedLocalGlobal,
    prepare_local_global,
    require_projective,
)
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH, EdgeEnergy
from springbench.solvers.model.energies.quadratic_energy import Quadratic
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits
from springbench.solvers.model.step_problem import Energy, Positions, StepProblem, System, Unsupported, is_lagged
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective


@dataclass(frozen=True)
class Admm:
    """ADMM for springs, strain limits and constant quadratic forms.

    Args:
        penalty_weight: W, relative to the stiffness of each edge.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = False
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "accelerated local-global",
        Citation(
            "Overby, Matthew and Brown, George E. and Li, Jie and Narain, Rahul",
            2017,
            "ADMM ⊇ Projective Dynamics: Fast Simulation of Hyperelastic Models with Dynamic Constraints",
            "10.1109/TVCG.2017.2730875",
        ),
        formula="local-global on A p + u, u⁺ = u + A p − z",
        cost="2 solves, 1 pass, 1 gradient",
    )

    penalty_weight: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        if not 0.0 < self.penalty_weight < np.inf:
            raise ValueError(f"penalty_weight: should be positive and finite, not {self.penalty_weight}")

    def prepare(self, system: System) -> PreparedAdmm:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy has no projection along edges.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        others = {type(e).__name__ for e in system.energies if not isinstance(e, Springs | StrainLimits | Quadratic)}
        if others:
            raise Unsupported(
                f"admm: projects springs and strain limits, and solves for quadratic forms; the scene has "
                f"{', '.join(sorted(others))} as well"
            )
        energies = require_projective(system, "admm")
        weighted = [
            replace(e, stiffness=self.penalty_weight * e.stiffness) if isinstance(e, EdgeEnergy) else e
            for e in energies
        ]
        base = measure = prepare_local_global(system, weighted, build_linear_solver)
        if self.penalty_weight != 1.0:
            measure = prepare_local_global(system, energies, build_linear_solver)
        return PreparedAdmm(
            base, measure, FixedObjective(system), _ProjectedEdges.from_energies(system.energies), self.penalty_weight
        )


class _ProjectedEdges(NamedTuple):
    """Edges of all springs and strain limits, with the lengths of zero energy.

    Attributes:
        edges: (m, 2) vertex indices.
        stiffness: (m,) [N/m].
        min_length, max_length: (m,) [m], bounds of the lengths at which an edge has no energy.
        rest_direction: (m, 3), unit vectors for edges of zero length.
    """

    edges: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    min_length: NDArray[np.float64]
    max_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

    @classmethod
    def from_energies(cls, energies: Sequence[Energy]) -> _ProjectedEdges:
        """Concatenate the springs and strain limits among the energies."""
        springs = Springs.from_parts([energy for energy in energies if isinstance(energy, Springs)])
        limits = [energy for energy in energies if isinstance(energy, StrainLimits)]
        return cls(
            np.concatenate([springs.edges, *(e.edges for e in limits)]),
            np.concatenate([springs.stiffness, *(e.stiffness for e in limits)]),
            np.concatenate([springs.rest_length, *(e.min_length for e in limits)]),
            np.concatenate([springs.rest_length, *(e.max_length for e in limits)]),
            np.concatenate([springs.rest_direction, *(e.rest_direction for e in limits)]),
        )


class PreparedAdmm(IterativeSolver):
    """ADMM, prepared for a system.

    Attributes:
        local_global: the factorised ADMM matrix.
        residual_metric: Q with its factor, for residuals.
        project_edges: the kernel of the local step.
        has_lagged_limits: whether strain limits change from step to step.
    """

    def __init__(
        self,
        base: PreparedLocalGlobal,
        measure: PreparedLocalGlobal,
        objective: FixedObjective,
        edges: _ProjectedEdges,
        weight: float,
    ) -> None:
        self.local_global, self.residual_metric, self.fixed_objective, self.projected_edges, self.penalty_weight = (
            base,
            measure,
            objective,
            edges,
            weight,
        )
        self.description, self.stats = base.description, base.stats
        self.project_edges = TypedKernel(run_admm_local_step)
        self.has_lagged_limits = any(isinstance(e, StrainLimits) and is_lagged(e) for e in objective.system.energies)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return _AdmmState(self, problem, initial_guess)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return self.residual_metric.residual_scale(problem)


class _AdmmState(SolverState):
    """State of an ADMM solve: positions and scaled dual variables.

    The scaled dual variable u (m, 3) [m] has a row per edge.
    """

    def __init__(self, prepared: PreparedAdmm, problem: StepProblem, guess: Positions) -> None:
        self._local_global, self._residual_metric, edges = (
            prepared.local_global,
            prepared.residual_metric,
            prepared.projected_edges,
        )
        if prepared.has_lagged_limits:
            edges = _ProjectedEdges.from_energies(problem.energies)
        self._edges, self._penalty_weight, self._project_edges = edges, prepared.penalty_weight, prepared.project_edges
        self._step = StepObjective(prepared.fixed_objective, problem)
        self._constant_term = self._local_global.constant_right_hand_side(problem)
        for k in prepared.fixed_objective.forms_with_force:
            form: Any = problem.energies[k]
            form.add_projection(problem.inertial_target, self._constant_term)
        self.positions = vertex_terms.apply_exact_pins(guess, problem)
        self._right_hand_side, self._scaled_dual = np.empty_like(self.positions), np.zeros((len(edges.edges), 3))

    def step_state(self) -> bool:
        """Do one iteration; return True."""
        vectors = self.positions, self._constant_term, self._scaled_dual, self._right_hand_side
        self._project_edges.call(*self._edges, self._penalty_weight, *vectors)
        self._local_global.solve_correction(self._right_hand_side, self.positions)
        return True

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate.

        It costs a gradient and a solve in addition to those of the iteration.
        """
        gradient = self._step.gradient(self.positions)
        return self._residual_metric.correction_residual(
            self._residual_metric.solve_correction(gradient, np.empty_like(gradient))
        )


@jit_kernel
def run_admm_local_step(edges, stiffness, low, high, rest_direction, weight, p, constant, u, out):
    """Write constant + W A'K (z - u) [N] to `out` and update u.

    Args:
        edges: (m, 2).
        stiffness: (m,) [N/m].
        low, high: minimum and maximum lengths [m] without energy (m,).
        rest_direction: direction at zero length (m, 3).
        weight: W.
        p: positions (n, 3) [m].
        constant: constant part (n, 3) [N].
        u: scaled dual variables (m, 3) [m].
        out: output (n, 3) [N].
    """
    # z - u = (2 d + (W - 1) v)/(1 + W), with v = A p + u and d the nearest vector without energy
    share, multiplier_share = 1.0 / (1.0 + weight), weight * (weight - 1.0) / (1.0 + weight)
    for i in range(len(p)):
        for c in range(3):
            out[i, c] = constant[i, c]
    for e in range(len(edges)):
        i, j, k = edges[e, 0], edges[e, 1], stiffness[e]
        v0, v1, v2 = p[i, 0] - p[j, 0] + u[e, 0], p[i, 1] - p[j, 1] + u[e, 1], p[i, 2] - p[j, 2] + u[e, 2]
        length = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        d0, d1, d2 = rest_direction[e, 0], rest_direction[e, 1], rest_direction[e, 2]
        if length > ZERO_LENGTH:
            d0, d1, d2 = v0 / length, v1 / length, v2 / length
        t = min(max(length, low[e]), high[e])
        d0, d1, d2 = t * d0, t * d1, t * d2
        u[e, 0], u[e, 1], u[e, 2] = share * (v0 - d0), share * (v1 - d1), share * (v2 - d2)
        f0, f1, f2 = 2.0 * weight * share * d0, 2.0 * weight * share * d1, 2.0 * weight * share * d2
        f0, f1, f2 = (
            k * (f0 + multiplier_share * v0),
            k * (f1 + multiplier_share * v1),
            k * (f2 + multiplier_share * v2),
        )
        out[i, 0] += f0
        out[i, 1] += f1
        out[i, 2] += f2
        out[j, 0] -= f0
        out[j, 1] -= f1
        out[j, 2] -= f2

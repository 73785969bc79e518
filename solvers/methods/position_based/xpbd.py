"""Extended position based dynamics (XPBD): springs as compliant constraints, projected one after another.

XPBD (Macklin, Mueller and Chentanez 2016) starts at the positions without springs, with zero tensions. An iteration
passes over all springs and moves the two ends of each spring, so that its accumulated tension t becomes
k (|p_i - p_j| - r):

    dt = (k (|p_i - p_j| - r) - t) / (1 + k (1/q_i + 1/q_j)),    p_i -= dt/q_i n,    p_j += dt/q_j n

with n the direction of the spring and q = c m/dt^2 + w the anchor stiffness of a vertex, so that pins of any weight
need no separate constraints (`springbench.solvers.iteration.vertex_terms`). This is the paper's formula in terms of
forces, lambda = -t dt^2, and valid from k = 0 to the largest k. The variant with small steps (Macklin et al. 2019)
divides the time step instead, with one iteration per substep.

Neither minimises the objective of the step. Tensions are accumulated along directions that rotate during the iteration,
without correction terms. The fixed point is the minimiser if springs do not rotate (a straight chain), and close to it
if they rotate little in a step. `device: cuda` computes the same iterates in
`springbench.solvers.methods.position_based.device_xpbd`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.device_interface import PrecisionOptions
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState, SubsteppingState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.methods.position_based import xpbd_projection as kernels
from springbench.solvers.methods.vertex_block import colouring
from springbench.solvers.model.step_problem import Positions, PreparedSolver, ResidualIterate, StepProblem, System


@dataclass(frozen=True)
class Xpbd(PrecisionOptions):
    """XPBD; uses neither the initial guess nor a tolerance."""

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "position-based",
        Citation(
            "Macklin, Miles and Müller, Matthias and Chentanez, Nuttapong",
            2016,
            "XPBD: position-based simulation of compliant constrained dynamics",
            "10.1145/2994258.2994272",
        ),
        formula="Δλ = −(C + α λ)/(w₁ + w₂ + α), α = 1/(k dt²)",
        cost="1 pass, no factor",
    )

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and for unpinned vertices without mass.
        """
        anchor_stiffness = vertex_terms.compute_anchor_stiffness(system)
        if self.device == "cuda":
            return _prepare_on_device(self, system, anchor_stiffness, "xpbd", small_steps=False)
        constraints, _, choice = _colour_constraints(system, anchor_stiffness, "xpbd")
        return PreparedXpbd(system, constraints, *_compute_compliance(constraints, anchor_stiffness), choice)


@dataclass(frozen=True)
class XpbdSmallSteps(PrecisionOptions):
    """XPBD with small steps, each with one iteration.

    A step has as many substeps as the stop rule has iterations: the k-th iterate is the whole step in k substeps. Pins
    move at constant velocity, and forces are constant within a step. Neither the initial guess nor a tolerance is used.
    """

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "position-based",
        Citation(
            "Macklin, Miles and Storey, Kier and Lu, Michelle and Terdiman, Pierre and Chentanez, Nuttapong and "
            "Jeschke, Stefan and Müller, Matthias",
            2019,
            "Small steps in physics simulation",
            "10.1145/3309486.3340247",
        ),
        is_substepping=True,
        is_family_default=True,
        formula="one XPBD iteration in each substep",
        cost="1 pass per substep, no factor",
    )

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: as for `Xpbd`, and for integrators other than implicit Euler.
        """
        vertex_terms.require_implicit_euler(system, "xpbd-small-steps")
        anchor_stiffness = vertex_terms.compute_anchor_stiffness(system)
        if self.device == "cuda":
            return _prepare_on_device(self, system, anchor_stiffness, "xpbd-small-steps", small_steps=True)
        constraints, _, choice = _colour_constraints(system, anchor_stiffness, "xpbd-small-steps")
        return PreparedXpbdSmallSteps(system, constraints, choice)


@dataclass(frozen=True, eq=False)
class PreparedXpbd(IterativeSolver):
    """XPBD, prepared for a system.

    Attributes:
        coloured_constraints: the springs by colour.
        vertex_compliance: 1/q (n,) [m/N].
        constraint_relaxation: factor 1/(1 + k (1/q_i + 1/q_j)) of each spring's correction (m,).
    """

    residual_iterate: ClassVar[ResidualIterate] = "none"

    system: System
    coloured_constraints: kernels.SpringConstraints
    vertex_compliance: NDArray[np.float64]
    constraint_relaxation: NDArray[np.float64]
    description: str
    stats: dict[str, float] = field(default_factory=dict)

    @cached_property
    def project_springs(self) -> TypedKernel:
        """The kernel of the iterations."""
        return TypedKernel(kernels.run_projections)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> XpbdState:
        """Start a solve at the positions that the vertices have without springs.

        Args:
            problem: step whose inertia, forces and pins determine these positions.
            initial_guess: not used.
        """
        return XpbdState(self, vertex_terms.compute_anchor_positions(problem))


class XpbdState(SolverState):
    """State of an XPBD solve; `spring_tensions` t (m,) [N] in the order of `coloured_constraints`."""

    def __init__(self, prepared: PreparedXpbd, p: Positions) -> None:
        self._prepared, self.spring_tensions, self.positions = (
            prepared,
            np.zeros_like(prepared.constraint_relaxation),
            p,
        )

    def step_state(self) -> bool:
        """Do one iteration; return True."""
        return self.run_unchecked(1) == 1

    def run_unchecked(self, num_iterations: int) -> int:
        """Do iterations in one call; return their number."""
        made = self._prepared
        made.project_springs.call(
            made.coloured_constraints,
            made.constraint_relaxation,
            made.vertex_compliance,
            self.spring_tensions,
            self.positions,
            num_iterations,
        )
        return num_iterations


@dataclass(frozen=True, eq=False)
class PreparedXpbdSmallSteps(IterativeSolver):
    """XPBD with small steps, prepared; `coloured_constraints` are the springs by colour."""

    residual_iterate: ClassVar[ResidualIterate] = "none"
    has_inner_solves: ClassVar[bool] = True

    system: System
    coloured_constraints: kernels.SpringConstraints
    description: str
    stats: dict[str, float] = field(default_factory=dict)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve at the start of the step.

        Args:
            problem: step that each iteration integrates again, with one more substep.
            initial_guess: not used.
        """
        return SubsteppingState(self.step, problem)

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate the step in equal substeps.

        Args:
            problem: step with its start, pin targets and external force.
            substeps: number of substeps.

        Returns:
            Positions (n, 3) [m] and velocities (n, 3) [m/s] at the end of the step.
        """
        s, pins, start = self.system, self.system.pins, problem.step_start
        h = s.time_step / substeps
        compliance, ease = _compute_compliance(
            self.coloured_constraints, vertex_terms.compute_anchor_stiffness(replace(s, time_step=h))
        )
        begin = start.positions[pins.vertices]
        pinned = kernels.PinMotion(pins.vertices.copy(), pins.weight.copy(), begin, problem.pin_targets.copy())
        p, v = start.positions.copy(), start.velocity.copy()
        force, before = problem.external_force.copy(), np.empty_like(p)
        kernels.run_substeps(self.coloured_constraints, ease, compliance, pinned, force, before, p, v, h, substeps)
        return p, v


def _prepare_on_device(
    method: PrecisionOptions, system: System, anchor_stiffness: NDArray[np.float64], solver: str, *, small_steps: bool
) -> PreparedSolver:
    """Prepare the method on a CUDA device (`springbench.solvers.methods.position_based.device_xpbd`)."""
    from springbench.solvers.cuda.cuda_device import require_device  # imported only for a device

    require_device(solver)
    from springbench.solvers.methods.position_based.device_xpbd import prepare_xpbd

    constraints, first, choice = _colour_constraints(system, anchor_stiffness, solver)
    return prepare_xpbd(system, constraints, first, method.real_dtype, choice, small_steps=small_steps)


def _colour_constraints(
    system: System, anchor_stiffness: NDArray[np.float64], solver: str
) -> tuple[kernels.SpringConstraints, NDArray[np.int64], str]:
    """Group the springs by colour, without self-loops, which have no elongation.

    Returns:
        The constraints, the first constraint of each colour (colours + 1,), and a description.
    """
    springs = require_only_springs(system, solver)
    vertex_terms.require_mass(system, anchor_stiffness, solver)
    keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])
    coloured = colouring.colour_springs(springs.edges[keep], system.num_vertices)
    constraints = kernels.SpringConstraints.from_springs(springs, keep[coloured.item_order])
    return constraints, coloured.colour_starts, f"springs in {coloured.num_colours} colours"


def _compute_compliance(
    constraints: kernels.SpringConstraints, anchor_stiffness: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the compliance 1/q (n,) [m/N] and the factor 1/(1 + k (1/q_i + 1/q_j)) of each spring (m,)."""
    compliance = 1.0 / anchor_stiffness
    i, j = constraints.end_vertices.T
    return compliance, 1.0 / (1.0 + constraints.stiffness * (compliance[i] + compliance[j]))

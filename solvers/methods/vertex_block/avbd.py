"""Augmented vertex block descent: length constraints within the sweeps of VBD.

Source: Giles, Diaz and Yuksel 2025. A constrained edge of length l has a tension t [N] and a stiffness k [N/m]:

    E_e = k/2 (l + t/k - clip(l + t/k, low, high))^2      in a sweep of `vertex_block.vbd` over all vertices
    t <- k (l + t/k - clip(l + t/k, low, high)),   k <- min(k + beta |l - clip(l, low, high)|, bound k_0)     after it

so t converges to the Lagrange multipliers of the step (`springbench.solvers.model.energies.augmented_lagrangian`), and
the lengths to their feasible values, for any k. A solve converges when the gradient that the best multipliers leave is
below the tolerance (`springbench.solvers.methods.vertex_block.lagrange_multipliers`), because the tensions t may cancel
the gradient while lengths are still wrong. Here beta = ramp k_0/high and k_0 = 1/(1/q_i + 1/q_j), the anchor stiffness
of the two ends; the paper has a beta of 10 N/m^2 and starts at 1 N/m. The choice here does not depend on the units of
mass, length and time. A larger ramp corrects lengths sooner, but leaves a larger gradient in the meantime.

A step starts with gamma t and max(gamma k, k_0) of the previous step, which the solution stores for this warm start,
gamma = `warm_start_decay`. `error_stabilisation` alpha widens the limits by alpha times the error at the start of the
step, l - alpha (l^t - clip l^t): errors that few iterations left are corrected over several steps, not in one. With 0,
the default, a solve converges to the minimum of the step; the paper uses .95, and multiplies t by it too. With
`ramp_spring_stiffness`, springs are edges too; their stiffness starts low and grows by the same rule up to its own
value (section 3.4), for large ratios of stiffness.

Further differences from the paper: instead of a diagonal in which the length of each column represents the second
derivatives across an edge, those of a tensile force are exact and those of a compressive force are dropped. A vertex
whose step would raise the augmented energy uses the step of its majorant. Sweeps are not accelerated, because each has
another energy; several accelerated sweeps before a dual step left larger length errors for the same work. Without
constrained edges and without `ramp_spring_stiffness`, the method equals VBD.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.kernels import iteration_loop
from springbench.solvers.kernels.iteration_loop import LoopLimits
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.vertex_block import avbd_dual_step as kernels
from springbench.solvers.methods.vertex_block.lagrange_multipliers import LagrangeMultipliers
from springbench.solvers.methods.vertex_block.vbd import PreparedVertexBlockDescent, SweepState, VertexBlockDescent
from springbench.solvers.model.barrier_energy import is_barrier_energy
from springbench.solvers.model.energies.augmented_lagrangian import (
    AugmentedLagrangian,
    build_augmented_system,
    compute_penalty_stiffness,
    concatenate_constraints,
    length_errors,
)
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import (
    LengthConstraints,
    Positions,
    PreparedSolver,
    StepProblem,
    System,
    Unsupported,
)

if TYPE_CHECKING:
    from springbench.solvers.methods.local_global.half_space_contact import ContactFreeSolver


@dataclass(frozen=True)
class AugmentedVertexBlockDescent:
    """Augmented vertex block descent for the energies of vertex block descent and length constraints.

    Args:
        stiffness_ramp: growth of an edge's stiffness for a relative length error of 1, as a multiple of its initial
            stiffness; not negative.
        max_stiffness_ratio: largest stiffness as a multiple of the initial one, at least 1.
        warm_start_decay: fraction of tensions and stiffnesses that the next step starts with, 0 to 1.
        error_stabilisation: fraction of the initial length error that a step retains, 0 to 1.
        ramp_spring_stiffness: whether the stiffness of springs starts low and grows.
        spectral_radius: as in `VertexBlockDescent`, used if nothing is constrained or ramped.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = False
    supports_length_constraints: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "vertex block descent",
        Citation(
            "Giles, Chris and Diaz, Elie and Yuksel, Cem",
            2025,
            "Augmented vertex block descent",
            "10.1145/3731195",
        ),
        formula="VBD sweep, then t⁺ = t + k (l − r) and larger k",
        cost="1 pass, no factor",
    )

    stiffness_ramp: float = 1e3
    max_stiffness_ratio: float = 1e6
    warm_start_decay: float = 0.99
    error_stabilisation: float = 0.0
    ramp_spring_stiffness: bool = False
    spectral_radius: float = 0.999

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        for name, least, most in (
            ("stiffness_ramp", 0, np.inf),
            ("max_stiffness_ratio", 1, np.inf),
            ("warm_start_decay", 0, 1),
            ("error_stabilisation", 0, 1),
        ):
            if not least <= (got := getattr(self, name)) <= most:
                expected = f"from {least} to {most}" if most == 1 else f"at least {least}"
                raise ValueError(f"{name}: should be {expected}, not {got}")
        VertexBlockDescent(self.spectral_radius)

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: for what `VertexBlockDescent` does not support, and for surface contact.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        usual = VertexBlockDescent(self.spectral_radius)
        if not (system.length_constraints or self.ramp_spring_stiffness):
            return usual.prepare(system)
        if any(map(is_barrier_energy, system.energies)):
            raise Unsupported(
                "avbd: does not support surface contact together with length constraints; remove self-contact and "
                "surface-contact, or give springs and strain limits a numerical stiffness"
            )
        edges, energies, k = concatenate_constraints(system.length_constraints), system.energies, np.empty(0)
        if self.ramp_spring_stiffness:
            springs = Springs.from_parts([energy for energy in energies if isinstance(energy, Springs)])
            energies = tuple(energy for energy in energies if not isinstance(energy, Springs))
            r, k = springs.rest_length, springs.stiffness
            edges = concatenate_constraints([edges, LengthConstraints(springs.edges, r, r, springs.rest_direction)])
        exact = np.arange(len(edges.min_length)) < len(edges.min_length) - len(k)
        bare = replace(system, energies=energies)
        least = compute_penalty_stiffness(bare, edges)
        most = np.concatenate([self.max_stiffness_ratio * least[exact], k])
        least = np.minimum(least, most)
        made = usual.prepare(build_augmented_system(bare, edges, least, np.zeros(len(least))))
        return PreparedAugmentedVertexBlockDescent(
            system, cast(PreparedVertexBlockDescent, made), self, edges, least, most, exact
        )


@dataclass(frozen=True, eq=False)
class PreparedAugmentedVertexBlockDescent(IterativeSolver):
    """AVBD, prepared for a system.

    Attributes:
        vertex_block_descent: vertex block descent of the other energies, with the initial stiffness of the edges in its
            majorant.
        augmented_edges: constrained edges, and springs with ramped stiffness.
        min_stiffness, max_stiffness: (m,) [N/m], bounds of the edges' stiffness.
        exact_mask: (m,), whether an edge is constrained.
    """

    supports_length_constraints: ClassVar[bool] = True

    system: System
    vertex_block_descent: PreparedVertexBlockDescent
    parameters: AugmentedVertexBlockDescent
    augmented_edges: LengthConstraints
    min_stiffness: NDArray[np.float64]
    max_stiffness: NDArray[np.float64]
    exact_mask: NDArray[np.bool_]

    @cached_property
    def augmented_iteration(self) -> TypedKernel:
        """The kernel of sweeps and dual updates, for steps without active contacts."""
        elements = self.vertex_block_descent.vertex_elements
        return TypedKernel(kernels.build_augmented_iteration(elements.iteration_kernel))

    @cached_property
    def least_squares_multipliers(self) -> LagrangeMultipliers:
        """The least-squares multipliers of the length constraints."""
        return LagrangeMultipliers(
            self._augment_system(np.zeros(len(self.min_stiffness))),
            self._exact_lengths,
            self.min_stiffness[self.exact_mask],
        )

    @property
    def description(self) -> str:
        """Description of the prepared solver."""
        return self.vertex_block_descent.description

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.vertex_block_descent.stats

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose warm start, if any, has the tensions and stiffnesses of the edges.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return AugmentedSweepState(self, problem, initial_guess)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] with zero tensions.

        Args:
            problem: step whose objective is minimised.
            p: positions (n, 3) [m].
        """
        return self.augmented_residual(problem, p, np.zeros(len(self.min_stiffness)))

    def augmented_residual(self, problem: StepProblem, p: Positions, tension: NDArray[np.float64]) -> float:
        """Return |Q^-1 grad L|_Q [J^(1/2)] of the augmented Lagrangian.

        Args:
            problem: the step problem.
            p: positions (n, 3) [m].
            tension: (m,) [N].

        Returns:
            The residual of L with the initial stiffnesses, which are part of Q.
        """
        return self._residual_solver.build_residual(replace(problem, system=self._augment_system(tension)))(p)

    def _augment_system(self, tension: NDArray[np.float64]) -> System:
        """Return the system of L: the constrained lengths and the other energies."""
        exact = self.exact_mask
        return build_augmented_system(self.system, self._exact_lengths, self.min_stiffness[exact], tension[exact])

    @cached_property
    def _exact_lengths(self) -> LengthConstraints:
        e, exact = self.augmented_edges, self.exact_mask
        return LengthConstraints(e.edges[exact], e.min_length[exact], e.max_length[exact], e.rest_direction[exact])

    @cached_property
    def _residual_solver(self) -> ContactFreeSolver:
        """The residual solver: that of `VertexBlockDescent`, or with full spring stiffness if ramped."""
        if self.exact_mask.all():
            return self.vertex_block_descent.residual_solver
        return cast(
            "ContactFreeSolver", CompiledLocalGlobal().prepare(self._augment_system(np.zeros(len(self.min_stiffness))))
        )


class AugmentedSweepState(SweepState):
    """State of an AVBD solve: sweeps and dual updates of one step problem."""

    def __init__(self, prepared: PreparedAugmentedVertexBlockDescent, problem: StepProblem, guess: Positions) -> None:
        made, method, edges = prepared.vertex_block_descent, prepared.parameters, prepared.augmented_edges
        super().__init__(made, replace(problem, system=made.system), guess)
        self._augmented_solver, self._problem = prepared, problem
        warm_start = problem.step_start.warm_start
        begun = (
            np.zeros((len(prepared.min_stiffness), 2)) if warm_start is None else method.warm_start_decay * warm_start
        )
        past = method.error_stabilisation * np.where(
            prepared.exact_mask, length_errors(edges, problem.step_start.positions), 0.0
        )
        base = np.ones(made.system.num_vertices + 2)
        first = cast(AugmentedLagrangian, made.system.energies[-1])
        base[made.row_of_vertex] = made.hessian_majorant - first.stiffness_matrix(made.system.num_vertices).diagonal()
        self._duals = kernels.DualState(
            edges.min_length + past,
            edges.max_length + past,
            prepared.exact_mask,
            method.stiffness_ramp * prepared.min_stiffness / np.where(edges.max_length > 0.0, edges.max_length, 1.0),
            prepared.max_stiffness,
            prepared.max_stiffness * edges.max_length,
            np.clip(begun[:, 1], prepared.min_stiffness, prepared.max_stiffness),
            np.where(prepared.exact_mask, begun[:, 0], 0.0),
            base,
            np.empty_like(base),
        )
        *others, hard = cast(tuple[Any, ...], self._element_data)  # one for each law, the edges of L last
        self._constraint_elements = hard._replace(parameters=hard.parameters.copy())
        self._element_data = (*others, self._constraint_elements)
        self._colour_packets = self._colour_packets._replace(majorant=self._colour_packets.majorant.copy())
        self._kernel = prepared.augmented_iteration.kernel
        kernels.write_edge_parameters(self._colour_packets, self._constraint_elements, self._duals, self._rows)

    @property
    def warm_start(self) -> NDArray[np.float64]:
        """Tensions [N] and stiffnesses [N/m], (m, 2), for the warm start of the next step."""
        return np.column_stack([self._duals.tension, self._duals.stiffness])

    def residual(self) -> float:
        """Return the residual with the current tensions; it may be small while lengths are wrong."""
        return self._augmented_solver.augmented_residual(self._problem, self.positions, self._duals.tension)

    def constrained_residual(self) -> float:
        """Return the residual [J^(1/2)] with least-squares multipliers, which includes length errors."""
        if not np.isfinite(self.positions).all():
            return self.residual()
        tension = np.zeros(len(self._duals.exact_mask))
        tension[self._duals.exact_mask] = self._augmented_solver.least_squares_multipliers.multipliers_at(
            self._problem, self.positions
        )
        return self._augmented_solver.augmented_residual(self._problem, self.positions, tension)

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Run iterations within the limits; the returned residual is `constrained_residual`.

        `constrained_residual` requires a factorisation. It is evaluated once the residual with the method's own
        tensions is small enough, and again each time the number of iterations has grown by half since.
        """
        count, residual, ended = super().run_iterations(limits)
        if limits.residual_mode == iteration_loop.RESIDUAL_NEVER or not self._duals.exact_mask.any():
            return count, residual, ended
        residual, since = self.constrained_residual(), 0
        while ended == iteration_loop.REASON_TOLERANCE and not residual <= limits.residual_limit:
            some = min(1 + since // 2, limits.max_iterations - count)
            if some == 0:
                return count, residual, iteration_loop.REASON_ITERATIONS
            self.run_unchecked(some)
            count, since, residual = count + some, since + some, self.constrained_residual()
        return count, residual, ended

    def run_unchecked(self, num_iterations: int) -> int:
        """Run sweeps, each followed by a dual update; return their number."""
        kernel = self._augmented_solver.augmented_iteration
        (kernel.call if self._half_spaces is None else self._kernel)(
            self._colour_packets, self._half_spaces, self._element_data, self._right_hand_side,
            self._sweep_scratch, self._rows, num_iterations, self._constraint_elements, self._duals,
        )  # fmt: skip
        self._read_positions()
        return num_iterations

"""Vertex block descent: one Newton step per vertex, one vertex after another.

Source: Chen, Liu, Yang and Yuksel 2024.

    B_i d_i = -grad_i g(p),   p_i += d_i,   B_i = q_i I + sum over its springs of k (nn' + max(0, 1 - r/l) (I - nn'))

with n the direction and l the length of a spring, and q the anchor stiffness (inertia and penalty pins). Compressed
springs lose their negative lateral curvature, so B_i is positive definite. A quadratic form adds its diagonal entry.
Contact adds its exact second derivatives, since it acts on single vertices. Strain limits and dashpots add theirs in
the packets of the springs, any other projective energy of elements those of the vertex's elements. The paper has no
line search. Here a step that would raise the energy is replaced by that of the majorant (q_i + sum of k) I, which
cannot raise it; hence no sweep raises the objective. Energies without such a majorant, that is, energies that are not
projective, are not supported.
`device: cuda` computes the same iterates in `springbench.solvers.methods.vertex_block.device_vbd`. Vertices are
processed by colour: no spring, form or element joins two of the same colour.

    p_{k+1} = w_{k+1} (sweep(p_k) - p_{k-1}) + p_{k-1},    w_1 = 1,  w_2 = 2/(2 - rho^2),  w_{k+1} = 4/(4 - rho^2 w_k),

with a safeguard: an extrapolation that would raise the objective above that of p_k is rejected, and the weights restart
at w_1. With these restarts rho needs no tuning: overestimates perform as well as the exact value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.half_space_steps import HalfSpaces
from springbench.solvers.contact.half_space.vertex_contact import (
    VertexContactEnergy,
    begin_active_contacts,
    without_vertex_contact,
)
from springbench.solvers.iteration.device_interface import PrecisionOptions
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState, compute_max_coordinate
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.kernels import step_setup
from springbench.solvers.kernels.spring_objective import ObjectiveWeights
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.vertex_block import vbd_sweeps as kernels
from springbench.solvers.methods.vertex_block.colour_blocks import VertexBlocks
from springbench.solvers.methods.vertex_block.vbd_packets import PACKET_SCRATCH_SIZE, SPRING_SCRATCH_SIZE
from springbench.solvers.methods.vertex_block.vertex_elements import VertexElements
from springbench.solvers.model.barrier_energy import is_barrier_energy, without_barriers
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, System, Unsupported
from springbench.solvers.objective.spring_form import SpringForm, decompose_energies
from springbench.solvers.simd.spring_packets import LANES

if TYPE_CHECKING:
    from springbench.solvers.contact.half_space.half_space_potential import ContactPlanes
    from springbench.solvers.methods.local_global.half_space_contact import ContactFreeSolver
    from springbench.solvers.objective.fixed_objective import FixedObjective


@dataclass(frozen=True)
class VertexBlockDescent(PrecisionOptions):
    """Vertex block descent for springs, quadratic forms, elements of projective energies, and contact.

    Args:
        spectral_radius: rho of the Chebyshev acceleration, in [0, 1); 0 disables it.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "vertex block descent",
        Citation(
            "Chen, Anka He and Liu, Ziheng and Yang, Yin and Yuksel, Cem",
            2024,
            "Vertex block descent",
            "10.1145/3658179",
        ),
        formula="pᵢ⁺ = pᵢ − Hᵢᵢ⁻¹ ∇ᵢg, one colour after another",
        cost="1 pass, no factor",
    )

    spectral_radius: float = 0.999

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        super().__post_init__()
        if not 0.0 <= self.spectral_radius < 1.0:
            raise ValueError(f"spectral_radius: should be at least 0 and less than 1, not {self.spectral_radius}")

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: for other energies.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        if self.device == "cuda":
            from springbench.solvers.cuda.cuda_device import require_device  # imported only for a device

            require_device("vbd")
        parts, vertex_elements, made = decompose_system(system, "vbd")
        if self.device == "cuda":
            from springbench.solvers.methods.vertex_block.device_vbd import prepare_vbd  # imported only for a device

            return prepare_vbd(system, parts, made, self.spectral_radius, self.real_dtype)
        gauge: Any = CompiledLocalGlobal().prepare(system)
        found = PreparedVertexBlockDescent.from_blocks(
            system, parts, vertex_elements, made, self.spectral_radius, gauge
        )
        return skip_idle_contact(
            found,
            system,
            lambda: replace(found, system=without_barriers(system), residual_solver=gauge.contact_free),
        )


def decompose_system(system: System, solver: str) -> tuple[SpringForm, VertexElements, VertexBlocks]:
    """Decompose a system without its contact into springs, elements, and free vertices by colour.

    Args:
        system: the system; its barriers and its contact of vertices are left out.
        solver: name of the solver, with which the message of an error begins.

    Returns:
        Springs and quadratic forms, elements of the other energies, and rows and packets of the vertices.

    Raises:
        Unsupported: an energy has no elements.
    """
    parts = decompose_energies(without_barriers(without_vertex_contact(system)))
    vertex_elements = VertexElements.from_system(system)
    unknown = {*parts.unsupported_energies} - {type(energy).__name__ for energy in vertex_elements.energies}
    if unknown:
        raise Unsupported(
            f"{solver}: {', '.join(sorted(unknown))} has no element-wise projective form, which the colouring and the "
            "majorant need; use lbfgs or newton"
        )
    return parts, vertex_elements, VertexBlocks.from_system(system, parts, vertex_elements)


@dataclass(frozen=True, eq=False)
class PreparedVertexBlockDescent(IterativeSolver):
    """Vertex block descent, prepared for a system.

    Attributes:
        spring_form: the springs and quadratic forms.
        vertex_elements: the elements of the other energies.
        colour_packets: packets of the free vertices by colour.
        row_of_vertex: (n,), row of each vertex in the packets.
        anchor_stiffness: stiffness of inertia, penalty pins and forms of each row [N/m].
        hessian_majorant: (n,) [N/m], of all energies except contact.
        residual_solver: computes the residual at p by one local-global iteration; it has no other use.
    """

    system: System
    spring_form: SpringForm
    vertex_elements: VertexElements
    spectral_radius: float
    colour_packets: kernels.ColourPackets
    row_of_vertex: NDArray[np.int64]
    anchor_stiffness: NDArray[np.float64]
    hessian_majorant: NDArray[np.float64]
    residual_solver: ContactFreeSolver
    description: str

    @classmethod
    def from_blocks(
        cls,
        system: System,
        parts: SpringForm,
        vertex_elements: VertexElements,
        made: VertexBlocks,
        spectral_radius: float,
        residual_solver: ContactFreeSolver,
    ) -> Self:
        """Prepare sweeps from the parts of a system, the results of `decompose_system`.

        Args:
            system: the system of the steps; if it has barriers, they limit the sweeps.
            parts: its springs and quadratic forms.
            vertex_elements: the elements of its other energies.
            made: rows and packets of its vertices.
            spectral_radius: rho of the Chebyshev acceleration, in [0, 1); 0 disables it.
            residual_solver: local-global method that computes residuals.
        """
        shares = ObjectiveWeights.from_packets(
            made.spring_packets, made.anchor_stiffness, made.row_of_vertex[system.pins.vertices[system.pins.exact_mask]]
        )
        gauge = residual_solver.description
        return cls(
            system,
            parts.select_packed_edges(),
            vertex_elements.with_rows(made.row_of_vertex, system.num_vertices + 2),
            spectral_radius,
            kernels.ColourPackets(
                made.spring_packets, shares, made.num_free, made.spring_packets.gather_lanes(made.majorant)
            ),
            made.row_of_vertex,
            made.anchor_stiffness,
            made.majorant[made.row_of_vertex],
            residual_solver,
            f"vertices in {made.num_colours} colours" + (f"; for the residual alone {gauge}" if gauge else ""),
        )

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.residual_solver.stats

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve.

        Args:
            problem: the step.
            initial_guess: positions (n, 3) [m], which are not modified.

        Returns:
            The state of sweeps; with barriers, that of sweeps with a contact model.
        """
        sweeps = SweepState(self, problem, initial_guess)
        if not any(map(is_barrier_energy, self.system.energies)):
            return sweeps
        from springbench.solvers.methods.vertex_block.vbd_barrier_contact import (
            BarrierVbdState,  # imported only with barriers
        )
        from springbench.solvers.objective.step_objective import StepObjective

        step, gauge = StepObjective(self._fixed_objective, problem), self.residual_solver.build_residual(problem)
        return BarrierVbdState(sweeps, step, initial_guess, self.hessian_majorant, self.spectral_radius, gauge)

    @cached_property
    def sweep_kernels(self) -> SweepKernels:
        """The kernels of a solve."""
        return SweepKernels(
            TypedKernel(kernels.start_sweeps),
            TypedKernel(self.vertex_elements.iteration_kernel),
            TypedKernel(step_setup.read_positions),
        )

    @cached_property
    def free_memory(self) -> list[SweepMemory]:
        """Work arrays of solves that have ended."""
        return []

    def take_memory(self) -> SweepMemory:
        """Return the work arrays of a solve that has ended, or allocate them."""
        return self.free_memory.pop() if self.free_memory else self.allocate_memory()

    def update_packets(self, memory: SweepMemory, problem: StepProblem) -> SweepMemory:
        """Return the work arrays of a solve with the edges of a step.

        Args:
            memory: work arrays; dashpots in their packets are overwritten.
            problem: the step.
        """
        blocks = memory.colour_packets
        packets = self.spring_form.update_edges(blocks.spring_packets, problem)
        if packets is blocks.spring_packets:
            return memory
        return memory._replace(colour_packets=blocks._replace(spring_packets=packets))

    def allocate_memory(self) -> SweepMemory:
        """Allocate the work arrays of a solve."""
        packets, size = self.colour_packets.spring_packets.with_own_dashpots(), len(self.anchor_stiffness)
        entries = int(np.diff(packets.packet_start).max(initial=0))
        p, previous, older, descent = (allocate_aligned(4 * size) for _ in range(4))
        springs = allocate_aligned((PACKET_SCRATCH_SIZE + SPRING_SCRATCH_SIZE * entries) * LANES)
        sums = allocate_aligned(9 * LANES)
        scratch = kernels.SweepScratch(previous, older, descent, springs, sums, np.zeros(1), np.zeros(1))
        blocks = self.colour_packets._replace(spring_packets=packets)
        return SweepMemory(blocks, p, packets.build_right_hand_side(self.anchor_stiffness), scratch)

    @cached_property
    def vertex_rows(self) -> step_setup.VertexRows:
        """The rows of the vertices, and the constant data of their right-hand side."""
        s, row, none = self.system, self.row_of_vertex, np.empty(0, np.int64)
        offset = self.colour_packets.spring_packets.right_hand_side_offset(len(self.anchor_stiffness))[row]
        pins = np.array(s.pins.weight), np.array(s.pins.vertices)
        return step_setup.VertexRows(row, offset, s.inertia_diagonal, *pins, np.empty(0), none, none)

    @cached_property
    def _fixed_objective(self) -> FixedObjective:
        from springbench.solvers.objective.fixed_objective import FixedObjective

        return FixedObjective(self.system)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual at p, by a local-global iteration if no contact is active.

        Args:
            problem: the step.
            p: positions (n, 3) [m].

        Returns:
            Residual [J^(1/2)]; nan if the residual solver defines none.
        """
        return self.residual_solver.build_residual(problem)(p)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return compute_max_coordinate(problem) * float(self.hessian_majorant[self.system.unpinned_mask].sum()) ** 0.5

    def pack_rows(self, x: Positions) -> NDArray[np.float64]:
        """Pack x (n, 3) into rows of four numbers.

        Two padding rows for the packets follow.
        """
        out = allocate_aligned(4 * (len(x) + 2))
        out.reshape(-1, 4)[self.row_of_vertex, :3] = x
        return out

    def build_half_spaces(self, contacts: list[VertexContactEnergy]) -> HalfSpaces:
        """Build the half-spaces of the contacts."""
        from springbench.solvers.methods.vertex_block.packed_half_spaces import (
            pack_half_spaces,
        )  # imported only with vertex contact

        return pack_half_spaces(
            contacts, self.row_of_vertex, self.colour_packets.spring_packets, self.colour_packets.num_free
        )


class SweepMemory(NamedTuple):
    """Packets and work arrays of a solve: positions in rows, right-hand side and scratch memory."""

    colour_packets: kernels.ColourPackets
    rows: NDArray[np.float64]
    right_hand_side: NDArray[np.float64]
    sweep_scratch: kernels.SweepScratch


class SweepKernels(NamedTuple):
    """The kernels of a solve; `run_iterations` is for steps without active contacts and without elements."""

    start_sweeps: TypedKernel
    run_iterations: TypedKernel
    read_positions: TypedKernel


class SweepState(SolverState):
    """State of a solve: sweeps over all vertices in one step problem."""

    def __init__(self, prepared: PreparedVertexBlockDescent, problem: StepProblem, guess: Positions) -> None:
        self._prepared = prepared
        self._memory = memory = prepared.take_memory()
        contacts = begin_active_contacts(problem)
        self._element_data = prepared.vertex_elements.update_elements(problem)
        self._problem = problem
        self._compute_residual: Callable[[Positions], float] | None = None
        self._half_spaces = prepared.build_half_spaces(contacts) if contacts else None
        self._colour_packets, self._rows, self._right_hand_side, self._sweep_scratch = prepared.update_packets(
            memory, problem
        )
        given = problem.inertial_target, prepared.spring_form.compute_force(problem), problem.pin_targets, guess
        prepared.sweep_kernels.start_sweeps.call(
            prepared.vertex_rows, *map(as_kernel_array, given), self._right_hand_side, self._sweep_scratch, self._rows
        )
        self.positions = guess

    def __del__(self) -> None:
        self._prepared.free_memory.append(self._memory)

    def step_state(self) -> bool:
        """Do one iteration; return True."""
        return self.run_unchecked(1) == 1

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        if self._compute_residual is None:
            self._compute_residual = self._prepared.residual_solver.build_residual(self._problem)
        return self._compute_residual(self.positions)

    def sweep_without_contact(self, p: Positions) -> Positions:
        """Return the positions (n, 3) after a sweep from p without contact planes."""
        if p is not self.positions:
            self._restart_at(p)
        self.run_unchecked(1)
        return self.positions

    def sweep_with_planes(self, p: Positions, planes: ContactPlanes) -> Positions:
        """Return the positions (n, 3) [m] after a sweep with the given contact planes.

        Args:
            p: positions (n, 3) [m] at which the sweep starts, without extrapolation.
            planes: planes of vertices, which act on both sides and replace the active contacts.
        """
        from springbench.solvers.methods.vertex_block.packed_half_spaces import pack_contact_planes

        made = self._prepared
        self._restart_at(p)
        touched = self._half_spaces
        self._half_spaces = pack_contact_planes(
            planes,
            np.ones(len(planes.vertices)),
            made.row_of_vertex,
            made.colour_packets.spring_packets,
            made.colour_packets.num_free,
            is_two_sided=True,
        )
        self.run_unchecked(1)
        self._half_spaces = touched
        return self.positions

    def _restart_at(self, p: Positions) -> None:
        """Restart the sweeps at p."""
        self._rows.reshape(-1, 4)[self._prepared.row_of_vertex, :3] = p
        self._sweep_scratch.omega[0], self._sweep_scratch.objective_value[0] = 0.0, np.nan

    def run_unchecked(self, num_iterations: int) -> int:
        """Run sweeps over all vertices in one call; return their number."""
        made = self._prepared
        is_usual = self._half_spaces is None and self._element_data is None
        iterate = made.sweep_kernels.run_iterations.call if is_usual else made.vertex_elements.iteration_kernel
        iterate(
            self._colour_packets,
            self._half_spaces,
            self._element_data,
            self._right_hand_side,
            made.spectral_radius,
            self._sweep_scratch,
            self._rows,
            num_iterations,
        )
        self._read_positions()
        return num_iterations

    def _read_positions(self) -> None:
        self.positions = np.empty(self.positions.shape)
        self._prepared.sweep_kernels.read_positions.call(self._prepared.vertex_rows, self._rows, self.positions)

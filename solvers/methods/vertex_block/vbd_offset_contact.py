"""Offset geometric contact (OGC) for vertex block descent, by displacement bounds.

A detection finds the contacts, and a ball around each vertex within which it cannot pass through anything
(`springbench.solvers.methods.vertex_block.offset_detection`). Sweeps follow in which no vertex leaves its ball
(`springbench.solvers.methods.vertex_block.vbd_offset_sweeps`). Once a sweep truncates the displacements of more than
`redetection_fraction` of the vertices, contacts are detected again. The first iterate is the prediction of inertia and
forces, truncated likewise. There is neither a line search nor a test of collisions along displacements. Source: Chen et
al. 2025, "Offset geometric contact", ACM TOG 44(4), with its parameters as defaults.

The method takes radius, minimum distance, stiffness and friction from the contact effects of a scene, but not their
barrier: its contacts have the activation of `vbd_offset_sweeps.offset_force`, each counts once, and pairs whose
features are not in each other's offset blocks have none. So it does not minimise the objective of the step, and has no
residual. Friction has the law of all other contact here (`springbench.solvers.contact.potentials.friction_law`); the
paper has that of Li et al. 2020. Both are lagged by neglecting the derivatives of the normal force. While nothing is
near, and in scenes without contact of surfaces, the method is that of
`springbench.solvers.methods.vertex_block.vbd`, whose extrapolation is used there only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.broad_phase.candidate_cache import compute_roundoff_margin
from springbench.solvers.contact.contact_potential import BarrierContact
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.methods.vertex_block import vbd_offset_sweeps as kernels
from springbench.solvers.methods.vertex_block.offset_detection import (
    OffsetCollisions,
    OffsetSurface,
    is_supported_contact,
)
from springbench.solvers.methods.vertex_block.vbd import (
    PreparedVertexBlockDescent,
    SweepState,
    VertexBlockDescent,
    decompose_system,
)
from springbench.solvers.model.barrier_energy import is_barrier_energy, without_barriers
from springbench.solvers.model.step_problem import (
    Positions,
    PreparedSolver,
    ResidualIterate,
    StepProblem,
    System,
    Unsupported,
)
from springbench.solvers.simd.spring_packets import LANES

_REACH_GROWTH, _UNOBSTRUCTED_FRACTION = 4.0, 0.5
"""Factor by which the reach of detections grows, and the fraction of vertices without anything in reach above which it
grows. The reach is limited to what the predicted displacement needs, and to the length of a mean edge, where the mesh
itself is near."""


@dataclass(frozen=True)
class OffsetContactDescent:
    """Vertex block descent with offset geometric contact; uses no tolerance.

    Args:
        bound_fraction: displacement bound of a vertex relative to its smallest gap, in (0, 0.5).
        redetection_fraction: fraction of the vertices, in [0, 1), whose displacements a sweep may truncate without a
            new detection of contacts.
        spectral_radius: as in `VertexBlockDescent`, used while nothing is near.
    """

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "vertex block descent",
        Citation(
            "Chen, Anka He and Hsu, Jerry and Liu, Ziheng and Macklin, Miles and Yang, Yin and Yuksel, Cem",
            2025,
            "Offset geometric contact",
            "10.1145/3731205",
        ),
        formula="VBD sweep, then |pᵢ − cᵢ| ≤ bᵢ",
        cost="1 pass, no factor",
    )

    bound_fraction: float = 0.45
    redetection_fraction: float = 0.01
    spectral_radius: float = 0.999

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        if not 0.0 < self.bound_fraction < 0.5:
            raise ValueError(f"bound_fraction: should be positive and less than 0.5, not {self.bound_fraction}")
        if not 0.0 <= self.redetection_fraction < 1.0:
            raise ValueError(
                f"redetection_fraction: should be at least 0 and less than 1, not {self.redetection_fraction}"
            )
        VertexBlockDescent(self.spectral_radius)

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: for what `VertexBlockDescent` does not support, unpinned vertices without mass, and contact of
                vertices together with contact of surfaces.
        """
        vertex_terms.require_mass(system, vertex_terms.compute_anchor_stiffness(system), "vbd-ogc")
        barriers = [energy for energy in system.energies if is_barrier_energy(energy)]
        if barriers and without_vertex_contact(system) is not system:
            raise Unsupported(
                "vbd-ogc: bounds displacements by distances from surfaces; replace the effect contact by "
                "surface-contact with the same obstacles"
            )
        unknown = [type(energy).__name__ for energy in barriers if not is_supported_contact(energy)]
        if unknown:
            raise Unsupported(f"vbd-ogc: {', '.join(unknown)} has no collision mesh; use surface-contact")
        parts, vertex_elements, blocks = decompose_system(system, "vbd-ogc")
        sweeps = PreparedUncheckedDescent.from_blocks(
            without_barriers(system), parts, vertex_elements, blocks, self.spectral_radius, _NO_RESIDUAL
        )
        if not barriers:
            return sweeps
        made = PreparedOffsetContact(
            system,
            sweeps,
            tuple(OffsetSurface.from_contact(energy) for energy in barriers if isinstance(energy, BarrierContact)),
            self.bound_fraction,
            int(self.redetection_fraction * sweeps.colour_packets.num_free),
        )
        return skip_idle_contact(made, system, lambda: sweeps)


class _NoResidual:
    """The residual of a method that does not minimise."""

    description = ""

    @property
    def stats(self) -> dict[str, float]:
        """Return no counts."""
        return {}

    def build_residual(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return a function that returns nan."""
        return lambda p: float("nan")


_NO_RESIDUAL: Any = _NoResidual()


@dataclass(frozen=True, eq=False)
class PreparedUncheckedDescent(PreparedVertexBlockDescent):
    """Vertex block descent without residuals, which does all iterations."""

    residual_iterate: ClassVar[ResidualIterate] = "none"


@dataclass(frozen=True, eq=False)
class PreparedOffsetContact(IterativeSolver):
    """Vertex block descent with offset geometric contact, prepared for a system.

    Attributes:
        sweeps: the method without contact.
        surfaces: the surfaces of each contact energy, in the order of the energies.
        bound_fraction: displacement bound of a vertex relative to its smallest gap, in (0, 0.5).
        max_truncated: number of vertices whose displacements a sweep may truncate without a new detection.
    """

    residual_iterate: ClassVar[ResidualIterate] = "none"
    has_own_friction: ClassVar[bool] = True

    system: System
    sweeps: PreparedVertexBlockDescent
    surfaces: tuple[OffsetSurface, ...]
    bound_fraction: float
    max_truncated: int
    stats: dict[str, float] = field(default_factory=dict)

    @property
    def description(self) -> str:
        """Description of the sweeps."""
        return self.sweeps.description

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from the truncated displacement to the prediction.

        Args:
            problem: the step.
            initial_guess: positions (n, 3) [m] at which contacts are first detected; the displacement starts there.
        """
        return OffsetContactState(self, problem, initial_guess)


class OffsetContactState(SweepState):
    """State of a solve with offset geometric contact.

    Attributes:
        num_detections: number of detections so far.
    """

    def __init__(self, prepared: PreparedOffsetContact, problem: StepProblem, guess: Positions) -> None:
        super().__init__(prepared.sweeps, problem, guess)
        self._offset = prepared
        self._contacts = [energy for energy in problem.energies if isinstance(energy, BarrierContact)]
        begin, self.num_detections = problem.step_start.positions, 0
        self._step_seconds = problem.step_start.stage_time - problem.step_start.time
        starts, obstacles = (
            [energy.append_obstacle_positions(begin)[len(begin) :] for energy in energies]
            for energies in ([energy.at_fraction(0.0) for energy in self._contacts], self._contacts)
        )
        first = len(begin) + 2 + np.cumsum([0, *map(len, obstacles)])
        self._row_maps = [
            np.append(prepared.sweeps.row_of_vertex, np.arange(a, b)) for a, b in pairwise(first.tolist())
        ]
        self._rows = self._append_rows(self._rows, obstacles)
        self._step_start = self._append_rows(prepared.sweeps.pack_rows(begin), starts)
        ahead = vertex_terms.compute_anchor_positions(problem)
        p = vertex_terms.apply_exact_pins(guess, problem)
        farthest = float(np.sqrt(np.einsum("ij,ij->i", ahead - p, ahead - p)).max(initial=0.0))
        self._max_reaches = [
            max(energy.collision_mesh.dhat, min(farthest / prepared.bound_fraction, surface.mean_edge_length))
            for energy, surface in zip(self._contacts, prepared.surfaces, strict=True)
        ]
        self._reaches = [energy.collision_mesh.dhat for energy in self._contacts]
        self._detect_contacts(p)
        free = prepared.system.free_vertices
        self._rows.reshape(-1, 4)[prepared.sweeps.row_of_vertex[free], :3] = ahead[free]
        truncated = kernels.truncate_displacements(self._packed, prepared.sweeps.colour_packets.num_free, self._rows)
        self._needs_detection = truncated > prepared.max_truncated
        self._read_positions()

    @staticmethod
    def _append_rows(rows: NDArray[np.float64], obstacles: list[Positions]) -> NDArray[np.float64]:
        """Return rows of four numbers with those of obstacles appended."""
        out = allocate_aligned(len(rows) + 4 * sum(map(len, obstacles)))
        out[: len(rows)] = rows
        if obstacles:
            out[len(rows) :].reshape(-1, 4)[:, :3] = np.concatenate(obstacles)
        return out

    def run_unchecked(self, num_iterations: int) -> int:
        """Run sweeps over all vertices, with detections between them; return their number."""
        made, done = self._prepared, 0
        sweep = kernels.build_offset_sweeps(*made.vertex_elements.element_kinds)
        while done < num_iterations:
            if self._needs_detection:
                self._read_positions()
                self._detect_contacts(self.positions)
            count, truncated = sweep(
                self._colour_packets,
                self._element_data,
                self._packed,
                self._right_hand_side,
                self._rows,
                self._sweep_scratch,
                num_iterations - done,
                self._offset.max_truncated,
            )
            done += count
            self._needs_detection = truncated > self._offset.max_truncated
        self._read_positions()
        return done

    def _detect_contacts(self, p: Positions) -> None:
        """Detect contacts at p (n, 3) [m], and pack them by rows."""
        found = [
            surface.detect_contacts(energy, p, reach, self._offset.bound_fraction)
            for surface, energy, reach in zip(self._offset.surfaces, self._contacts, self._reaches, strict=True)
        ]
        for k, one in enumerate(found):
            if np.mean(one.clearance[: len(p)] >= self._reaches[k]) > _UNOBSTRUCTED_FRACTION:
                self._reaches[k] = min(_REACH_GROWTH * self._reaches[k], self._max_reaches[k])
        self._packed, self._needs_detection = self._pack_contacts(found, p), False
        self.num_detections += 1

    def _pack_contacts(self, found: list[OffsetCollisions], p: Positions) -> kernels.OffsetContacts:
        blocks = self._prepared.colour_packets
        rows = np.concatenate([places[one.vertices] for places, one in zip(self._row_maps, found, strict=True)])
        starts = np.zeros(blocks.num_free + 1, np.int64)
        entries = np.empty((2, rows.size), np.int64)
        fill_row_entries(rows, starts, entries)
        touched = np.append(np.diff(starts) > 0, np.zeros(len(p) + 2 - blocks.num_free, bool))
        bound = np.full(len(p) + 2, np.inf)
        own = self._prepared.row_of_vertex
        for one in found:
            bound[own] = np.minimum(bound[own], one.clearance[: len(p)])
        bound = np.maximum(self._offset.bound_fraction * bound - compute_roundoff_margin(p), 0.0)
        counts = [len(one.vertices) for one in found]

        def join_column(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(one, name) for one in found])

        return kernels.OffsetContacts(
            row_starts=starts,
            contact_index=entries[0],
            vertex_slot=entries[1],
            has_contact=np.logical_or.reduce(touched[blocks.spring_packets.row_offset // 4].reshape(-1, LANES), axis=1),
            row_offsets=4 * rows,
            is_edge_pair=join_column("is_edge_pair"),
            min_distance=join_column("min_distance"),
            radius=join_column("radius"),
            stiffness=join_column("stiffness"),
            friction=np.repeat([energy.friction for energy in self._contacts], counts),
            smoothing_length=np.repeat([energy.eps_v * self._step_seconds for energy in self._contacts], counts),
            centre=self._rows.copy(),
            bound=bound,
            step_start=self._step_start,
        )


@jit_inner
def _is_entry(rows, k, slot, num_free):
    """Return whether a vertex of a contact has an entry.

    It has one if it is free and does not repeat the vertex before it.
    """
    return rows[k, slot] < num_free and (slot == 0 or rows[k, slot] != rows[k, slot - 1])


@jit_kernel
def fill_row_entries(rows, starts, entries):
    """Sort contacts by the rows of their vertices.

    Args:
        rows: rows of the vertices of each contact (k, 4).
        starts: output (free rows + 1,), first entry of each row; zero on entry.
        entries: output (2, 4 k), contact and place of each entry.
    """
    num_free = len(starts) - 1
    for k in range(len(rows)):
        for slot in range(4):
            if _is_entry(rows, k, slot, num_free):
                starts[rows[k, slot] + 1] += 1
    for i in range(num_free):
        starts[i + 1] += starts[i]
    total = starts[num_free]
    # Backwards from the ends of the rows, each end becomes the row's first entry.
    for k in range(len(rows) - 1, -1, -1):
        for slot in range(3, -1, -1):
            if _is_entry(rows, k, slot, num_free):
                i = rows[k, slot] + 1
                starts[i] -= 1
                entries[0, starts[i]], entries[1, starts[i]] = k, slot
    for i in range(num_free):
        starts[i] = starts[i + 1]
    starts[num_free] = total

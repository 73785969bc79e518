"""Springs, quadratic forms and dashpots of a step on a device.

Each thread gathers the terms of its vertex:

    E = sum_e k_e/2 (|v_e| - r_e)^2 + sum_e k_e/2 (n_e.v_e - o_e)^2 + sum_i h_i/2 |p_i - c_i|^2 - tr(p'f)

Edges of the second kind, marked by nan in `rest`, are dashpots. Each vertex has one anchor stiffness and one centre,
h c = inertia target + penalty pin, so that distant targets round as positions do. A form is represented by zero-length
springs and anchors (`springbench.solvers.objective.spring_form`). Other energies, such as contact and strain limits,
are not supported; the error names them.

Vertices are in rows: the free ones first, in patches of neighbours (`springbench.solvers.linalg.additive_schwarz`),
then those with exact pins. The entries that the 32 rows of a warp read together are contiguous.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.cuda.cuda_target import DeviceStream
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.step_problem import System, Unsupported
from springbench.solvers.objective.spring_form import SpringForm, decompose_energies

WARP_SIZE = 32
"""Number of rows with interleaved entries: a warp."""

IndexArray = NDArray[np.int64]


class EdgeEntries(NamedTuple):
    """Edges listed at both of their ends.

    Attributes:
        warp_starts: (warps + 1,), first entry of each warp's rows.
        neighbour_rows: row of the other end of each entry; the row itself for padding.
        edge_indices: edge of each entry, ~edge at its second end.
    """

    warp_starts: Any
    neighbour_rows: Any
    edge_indices: Any

    @classmethod
    def from_ends(cls, ends: IndexArray, rows: int) -> EdgeEntries:
        """Build the entries of edges, without self-loops.

        Args:
            ends: rows of both ends of each edge (m, 2).
            rows: number of rows with entries, the first ones; ends in later rows have none.
        """
        proper = np.flatnonzero(ends[:, 0] != ends[:, 1])
        here, there = ends[proper].T.ravel(), ends[proper, ::-1].T.ravel()
        edge = np.concatenate([proper, ~proper])
        order = np.argsort(here, kind="stable")
        order = order[: np.searchsorted(here[order], rows)]
        here, there, edge = here[order], there[order], edge[order]
        nth = np.arange(len(here)) - np.searchsorted(here, here)
        warps = -(-rows // WARP_SIZE)
        count = np.bincount(here, minlength=warps * WARP_SIZE).reshape(warps, WARP_SIZE).max(axis=1, initial=0)
        first = np.concatenate([[0], np.cumsum(WARP_SIZE * count)])
        at = first[here // WARP_SIZE] + WARP_SIZE * nth + here % WARP_SIZE
        lane = np.arange(first[-1]) - np.repeat(first[:-1], np.diff(first))
        other = (np.repeat(WARP_SIZE * np.arange(warps), np.diff(first)) + lane % WARP_SIZE).astype(np.int32)
        edges = np.zeros(first[-1], np.int32)
        other[at], edges[at] = there, edge
        return cls(first.astype(np.int32), other, edges)


class DeviceEdges(NamedTuple):
    """Edges on the device.

    Attributes:
        warp_starts: (warps + 1,), first entry of each warp's rows.
        neighbour_rows: row of the other end of each entry; the row itself for padding.
        edge_indices: edge of each entry, ~edge at its second end.
        entry_stiffness, entry_rest_length: of each entry [N/m, m].
        ends: (m, 2), rows.
        edge_stiffness, edge_rest_length: (m,) [N/m, m].
        edge_direction: (m, 3), axis of a dashpot, or direction of a spring of zero length.
        dashpot_offset: (m,) [m].
    """

    warp_starts: Any
    neighbour_rows: Any
    edge_indices: Any
    entry_stiffness: Any
    entry_rest_length: Any
    ends: Any
    edge_stiffness: Any
    edge_rest_length: Any
    edge_direction: Any
    dashpot_offset: Any


class DeviceStepData(NamedTuple):
    """Data of a step on the device.

    Anchor stiffness h (f,) [N/m], centres c (f, 3) [m] and force (f, 3) [N] of the free rows.
    """

    anchor_stiffness: Any
    anchor_positions: Any
    external_force: Any


@dataclass(frozen=True, eq=False)
class DeviceNetwork:
    """Edges of a system between rows.

    Attributes:
        system: the system.
        spring_form: its energies as springs, anchors and dashpots.
        row_vertices: (n,), vertex of each row.
        num_free: number of rows that move, the first ones.
        ends: (m, 2), rows of both ends of each edge.
        edge_entries: the edges, listed at both ends.
        stiffness, rest_length: (m,) [N/m, m]; the rest length of a dashpot is nan.
        edge_direction: (m, 3), initial axis of a dashpot, or direction of a spring of zero length.
        anchor_stiffness: h of each row (n,) [N/m].
    """

    system: System
    spring_form: SpringForm
    row_vertices: IndexArray
    num_free: int
    ends: IndexArray
    edge_entries: EdgeEntries
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    edge_direction: NDArray[np.float64]
    anchor_stiffness: NDArray[np.float64]

    @classmethod
    def from_system(cls, solver: str, system: System, free_order: IndexArray) -> DeviceNetwork:
        """Build the network of a system.

        Args:
            solver: name of the solver, for messages.
            system: the system.
            free_order: (f,), order of the free vertices, as indices among them.

        Raises:
            Unsupported: for energies other than springs, constant forms and dashpots; the message names them.
        """
        parts = decompose_energies(system)
        require_known_energies(solver, system)
        exact = system.pins.vertices[system.pins.exact_mask]
        free_order = np.concatenate([system.free_vertices[free_order], exact]).astype(np.int64)
        row = np.empty(system.num_vertices, np.int64)
        row[free_order] = np.arange(len(free_order))
        none = np.empty(0)
        dashpots = parts.dashpots
        ends = row[np.concatenate([parts.springs_and_forms.edges, *(e.edges for e in dashpots)])]
        stiffness = np.concatenate([parts.springs_and_forms.stiffness, *(e.stiffness for e in dashpots)])
        damped = np.full(len(ends) - len(parts.springs_and_forms.edges), np.nan)
        rest = np.concatenate([parts.springs_and_forms.rest_length, damped])
        axis = np.concatenate(
            [parts.springs_and_forms.rest_direction, *(e.direction for e in dashpots), none.reshape(0, 3)]
        )
        diagonal = system.inertia_diagonal + parts.vertex_weight
        _, pinned, weight = system.penalty_pins
        diagonal[pinned] += weight
        free = len(system.free_vertices)
        return cls(
            system,
            parts,
            free_order,
            free,
            ends,
            EdgeEntries.from_ends(ends, free),
            stiffness,
            rest,
            axis,
            diagonal[free_order],
        )

    @property
    def device_bytes(self) -> float:
        """The bytes of the network on the device, without vectors."""
        return 24.0 * len(self.edge_entries.neighbour_rows) + 64.0 * len(self.ends)

    def upload_edges(self, stream: DeviceStream) -> DeviceEdges:
        """Copy the edges to the device."""
        first, other, edge = self.edge_entries
        named = np.maximum(edge, ~edge)
        return DeviceEdges(
            stream.upload_array(first),
            stream.upload_array(other),
            stream.upload_array(edge),
            stream.upload_array(self.stiffness[named]),
            stream.upload_array(self.rest_length[named]),
            stream.upload_array(self.ends.astype(np.int32)),
            stream.upload_array(self.stiffness),
            stream.upload_array(self.rest_length),
            stream.upload_array(self.edge_direction),
            stream.upload_array(np.zeros(len(self.rest_length))),
        )


def require_known_energies(solver: str, system: System) -> None:
    """Check that the device kernels support all energies of a system.

    Args:
        solver: name of the solver, for the message.
        system: the system; its barriers and its contact of vertices are among the unsupported energies.

    Raises:
        Unsupported: for other energies; the message names them.
    """
    bare = without_barriers(without_vertex_contact(system))
    there = {type(e).__name__ for e in system.energies if e not in bare.energies}
    parts = decompose_energies(bare)
    unknown = {*there, *parts.unsupported_energies, *(type(e).__name__ for e in parts.strain_limits)}
    if unknown:
        raise Unsupported(
            f"{solver}, device: cuda: its kernels support springs, bending, attachments, linear drag and dashpots; not "
            f"{', '.join(sorted(unknown))}; take device: cpu"
        )

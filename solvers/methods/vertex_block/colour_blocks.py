"""The free vertices by colour, in packets, for methods that move one vertex after another.

No two vertices of a colour share a spring, a pair of a form, or an element. Rows are the free vertices by colour, then
the pinned ones, then two padding rows of the packets.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.kernels.spring_local_step import SpringPackets
from springbench.solvers.methods.vertex_block import colouring
from springbench.solvers.methods.vertex_block.vertex_elements import VertexElements
from springbench.solvers.model.step_problem import System
from springbench.solvers.objective.spring_form import SpringForm
from springbench.solvers.simd.spring_packets import LANES


class VertexBlocks(NamedTuple):
    """The rows, packets and majorants of a system.

    Attributes:
        row_of_vertex: row of each vertex (n,).
        num_free: number of free rows.
        spring_packets: packets of the free rows, by colour.
        first_packet: first packet of each colour (colours + 1,).
        anchor_stiffness: stiffness [N/m] of inertia, pins and forms of each free row (n + 2,), 0 elsewhere.
        majorant: that plus the stiffness of springs and elements (n + 2,) [N/m]; 1 for padding.
    """

    row_of_vertex: NDArray[np.int64]
    num_free: int
    spring_packets: SpringPackets
    first_packet: NDArray[np.int64]
    anchor_stiffness: NDArray[np.float64]
    majorant: NDArray[np.float64]

    @property
    def num_colours(self) -> int:
        """Number of colours."""
        return len(self.first_packet) - 1

    @classmethod
    def from_system(cls, system: System, parts: SpringForm, vertex_elements: VertexElements) -> VertexBlocks:
        """Build the rows of a system from the decomposition of its energies.

        Args:
            system: masses, pins and time step.
            parts: springs, forms and edges of the system's energies.
            vertex_elements: the other energies with elements, whose vertices need different colours.
        """
        n = system.num_vertices
        coloured = colouring.colour_vertices(
            np.concatenate([parts.system_pairs.edges, vertex_elements.list_vertex_pairs()]), n
        )
        colour = np.empty(n, np.int64)
        colour[coloured.item_order] = np.repeat(np.arange(coloured.num_colours), np.diff(coloured.colour_starts))
        pinned = system.pins.vertices[system.pins.exact_mask]
        order = coloured.item_order[~np.isin(coloured.item_order, pinned)]
        row = np.empty(n, np.int64)
        row[order], row[pinned] = np.arange(len(order)), np.arange(len(order), n)
        colour[pinned] = -1
        packed = parts.select_packed_edges()
        packets, first = SpringPackets.from_springs(
            parts.springs_and_forms,
            row,
            colour,
            coloured.num_colours,
            n,
            n + 1,
            packed.attach_edges(parts.springs_and_forms),
        )
        anchor_stiffness, majorant = np.zeros(n + 2), np.ones(n + 2)
        anchor_stiffness[: len(order)] = majorant[: len(order)] = (
            vertex_terms.compute_anchor_stiffness(system) + parts.vertex_weight
        )[order]
        majorant[: len(order)] += vertex_elements.stiffness_diagonal()[order]
        for energy in (*packed.strain_limits, *packed.dashpots):
            majorant[: len(order)] += energy.stiffness_matrix(n).diagonal()[order]
        ends = np.repeat(packets.row_offset.reshape(-1, LANES), np.diff(packets.packet_start), axis=0)
        np.add.at(majorant, ends.ravel() // 4, packets.entry_weights()[1])
        return cls(row, len(order), packets, first, anchor_stiffness, majorant)

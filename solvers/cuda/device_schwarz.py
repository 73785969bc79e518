"""Additive Schwarz preconditioner on a device: `springbench.solvers.linalg.additive_schwarz` of H+.

    z = sum over levels l of P_l diag(B_l^-1) P_l' r
    H+_ii = h_i + sum over its edges of b,   H+_ij = -b,   b = s I + (k - s) n n',   s no less than zero

Node i of a level is part of node i // PATCH of the next level. An edge between two nodes of a level combines all edges
between their parts. b of a coarse edge is a sum over a list of finer edges, in a fixed order, without atomics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.cuda import cuda_device, device_sums
from springbench.solvers.cuda.cuda_target import DeviceStream, cuda
from springbench.solvers.cuda.device_network import DeviceEdges, DeviceNetwork, EdgeEntries
from springbench.solvers.cuda.schwarz_kernels import (
    build_schwarz_kernels,
    packed_length,
    sum_fine_edge_blocks,
    write_edge_blocks,
)
from springbench.solvers.linalg import additive_schwarz
from springbench.solvers.model.system_matrix_assembly import compute_row_starts

THREADS_PER_SUBDOMAIN = 1 if cuda_device.is_simulated() else 96
"""Threads per subdomain; one in the simulator, which starts a Python thread for each."""

_MAX_GRID_BLOCKS = 65_535

RealType = type[np.float32] | type[np.float64]


@dataclass(frozen=True, eq=False)
class SchwarzLevel:
    """A level on the host.

    Attributes:
        num_nodes: number of nodes.
        edge_entries: edges between nodes, or to fixed rows, from both ends.
        anchor_stiffness: (nodes,), sum of h over the parts [N/m].
        num_edges: number of edges.
        fine_edge_starts, fine_edges: (edges + 1,) and list of the finer edges of each edge; empty on the first level.
    """

    num_nodes: int
    edge_entries: EdgeEntries
    anchor_stiffness: NDArray[np.float64]
    num_edges: int
    fine_edge_starts: NDArray[np.int64]
    fine_edges: NDArray[np.int64]

    @property
    def num_subdomains(self) -> int:
        """The number of subdomains."""
        return -(-self.num_nodes // additive_schwarz.SUBDOMAIN_SIZE)


def build_levels(network: DeviceNetwork, anchor_stiffness: NDArray[np.float64]) -> list[SchwarzLevel]:
    """Build the levels of a network, up to one whose nodes fit in one subdomain.

    Args:
        network: edges between rows, whose free rows are the nodes of the first level.
        anchor_stiffness: h of the free rows (f,) [N/m].

    Returns:
        The levels, the finest one first.
    """
    none = np.zeros(1, np.int64)
    found = [SchwarzLevel(network.num_free, network.edge_entries, anchor_stiffness, len(network.ends), none, none)]
    ends = network.ends
    while (n := found[-1].num_nodes) > additive_schwarz.SUBDOMAIN_SIZE:
        nodes = found[-1].num_subdomains
        ends = np.where(ends < n, ends // additive_schwarz.SUBDOMAIN_SIZE, nodes)  # fixed rows are one more node
        across = np.flatnonzero(ends[:, 0] != ends[:, 1])
        low, high = np.sort(ends[across], axis=1).T
        keys, which = np.unique(low * (nodes + 1) + high, return_inverse=True)
        first = compute_row_starts(which, len(keys))
        finer = across[np.argsort(which, kind="stable")]
        ends = np.column_stack(np.divmod(keys, nodes + 1))
        anchor_stiffness = np.add.reduceat(anchor_stiffness, np.arange(0, n, additive_schwarz.SUBDOMAIN_SIZE))
        found.append(SchwarzLevel(nodes, EdgeEntries.from_ends(ends, nodes), anchor_stiffness, len(keys), first, finer))
    return found


def compute_schwarz_bytes(schwarz_levels: list[SchwarzLevel], item_size: int) -> float:
    """Return the bytes of the preconditioner on the device.

    Args:
        schwarz_levels: all levels, of `build_levels`.
        item_size: bytes of a number of the inverses and residuals.
    """
    return sum(
        1.0 * item_size * packed_length(additive_schwarz.SUBDOMAIN_SIZE) * one.num_subdomains
        + 48.0 * one.num_edges
        + 8.0 * (len(one.edge_entries.neighbour_rows) + one.num_edges + len(one.fine_edges) + one.num_nodes)
        + 6.0 * item_size * one.num_nodes
        for one in schwarz_levels
    )


class UploadedLevel(NamedTuple):
    """A level on the device: its entries, h, and lists of finer edges."""

    warp_starts: Any
    neighbour_rows: Any
    edge_indices: Any
    anchor_stiffness: Any
    fine_edge_starts: Any
    fine_edges: Any

    @classmethod
    def from_level(cls, stream: DeviceStream, level: SchwarzLevel) -> UploadedLevel:
        """Copy a level to the device, which does not support empty arrays.

        Args:
            stream: stream of the copies.
            level: the level on the host.
        """
        first, other, edge = level.edge_entries
        some = np.zeros(1, np.int32)
        return cls(
            stream.upload_array(first),
            stream.upload_array(other if len(other) else some),
            stream.upload_array(edge if len(edge) else some),
            stream.upload_array(level.anchor_stiffness),
            stream.upload_array(level.fine_edge_starts, np.int32),
            stream.upload_array(level.fine_edges if len(level.fine_edges) else some, np.int32),
        )


class DeviceAdditiveSchwarz:
    """Packed inverses of the subdomains of all levels for one solve.

    `apply_preconditioner` acts on the attribute `r` (f, 3).
    """

    def __init__(
        self,
        schwarz_levels: list[SchwarzLevel],
        uploaded: list[UploadedLevel],
        stream: DeviceStream,
        rows: int,
        real: RealType,
    ) -> None:
        self._stream, self.r = stream, stream.allocate_zeros((rows, 3), real)
        self._levels, self._uploaded, self._schwarz_kernels = (
            schwarz_levels,
            uploaded,
            build_schwarz_kernels(real, additive_schwarz.SUBDOMAIN_SIZE),
        )
        self._edge_stiffness = [cuda.device_array((6, max(1, one.num_edges)), np.float64) for one in schwarz_levels]
        half = packed_length(additive_schwarz.SUBDOMAIN_SIZE)
        self._inverses = [cuda.device_array((one.num_subdomains, half), real) for one in schwarz_levels]
        self._residuals = [self.r, *(cuda.device_array((one.num_nodes, 3), real) for one in schwarz_levels[1:])]
        self._corrections = [cuda.device_array((one.num_nodes, 3), real) for one in schwarz_levels[1:]]

    def set_linearisation(self, edges: DeviceEdges, p: Any) -> None:
        """Invert the subdomains of H+ at given positions.

        Args:
            edges: edges of the finest level, on the device.
            p: positions in rows (n, 3) [m], on the device.
        """
        write_edge_blocks[self._launch_shape(self._levels[0].num_edges)](edges, p, self._edge_stiffness[0])
        for k, (level, there, stiff) in enumerate(zip(self._levels, self._uploaded, self._edge_stiffness, strict=True)):
            if k:
                sum_fine_edge_blocks[self._launch_shape(level.num_edges)](
                    there, level.num_edges, self._edge_stiffness[k - 1], stiff
                )
            self._schwarz_kernels.invert_subdomains[self._subdomain_launch_shape(level)](
                there, stiff, level.num_nodes, self._inverses[k]
            )

    def apply_preconditioner(self, z: Any, sum_slot: int, partials: Any, cg_status: Any) -> None:
        """Apply the preconditioner to `r`, and store the first stage of the sum r'z.

        Args:
            z: output (f, 3) [m], on the device.
            sum_slot: row of the partial sums that r'z is stored in.
            partials: output, partial sums (k, MAX_BLOCKS) [J].
            cg_status: state of conjugate gradients, on the device; nothing is done if its first number is not 0.
        """
        for level, r, coarse in zip(self._levels[1:], self._residuals, self._residuals[1:], strict=False):
            self._schwarz_kernels.restrict_residual[self._launch_shape(level.num_nodes)](r, coarse, cg_status)
        moved = [z, *self._corrections]
        for k in range(len(self._levels) - 1, -1, -1):
            level = self._levels[k]
            last = k == len(self._levels) - 1
            self._schwarz_kernels.apply_inverses[self._subdomain_launch_shape(level)](
                self._inverses[k], self._residuals[k], moved[k if last else k + 1], not last, moved[k], cg_status
            )
        self._schwarz_kernels.sum_inner_product[self._launch_shape(len(z))](self.r, z, sum_slot, partials, cg_status)

    def _launch_shape(self, items: int) -> tuple[int, int, Any]:
        return device_sums.count_blocks(items), device_sums.THREADS_PER_BLOCK, self._stream.cuda_stream

    def _subdomain_launch_shape(self, level: SchwarzLevel) -> tuple[int, int, Any]:
        return int(max(1, min(level.num_subdomains, _MAX_GRID_BLOCKS))), THREADS_PER_SUBDOMAIN, self._stream.cuda_stream

"""Step data on a device: uploaded step problems, and kernels that convert them to rows.

    centre_i = (c m/dt^2 target + w pin) / (c m/dt^2 + w),     force_i = f_i - h_i centre_i        h: of forms
    n = v/|v| and n'(A origin) of dashpots, v = A p at the step's start

Rows are those of `springbench.solvers.cuda.device_network`; the arrays of a step are by vertices, as on the host.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.cuda import device_sums
from springbench.solvers.cuda.cuda_target import DeviceStream, ReusedUploads, cuda
from springbench.solvers.cuda.device_network import DeviceEdges, DeviceNetwork, DeviceStepData
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH
from springbench.solvers.model.step_problem import Positions, StepProblem, System


class DeviceStep(NamedTuple):
    """A step on the device, by vertices.

    Attributes:
        inertial_target, initial_guess: (n, 3) [m].
        external_force: (n, 3) [N], including that of forms.
        pin_targets: (q, 3) [m]; one row if there are none.
        velocity_origin, lagged_positions: (n, 3) [m], of the stage's velocity and of the dashpots' directions;
            arbitrary without dashpots.
        positions, velocity: (n, 3) [m, m/s] at the start of the step; arbitrary for a minimising method without
            contact.
        start_and_stage_time: [s].
        normal_force_positions: (n, 3) [m], where friction evaluates normal forces; None for the start of the step.
    """

    inertial_target: Any
    external_force: Any
    initial_guess: Any
    pin_targets: Any
    velocity_origin: Any
    lagged_positions: Any
    positions: Any
    velocity: Any
    start_and_stage_time: tuple[float, float]
    normal_force_positions: Any = None


class RowData(NamedTuple):
    """Data of each row (n,) on the device.

    Attributes:
        vertex_indices: the vertex.
        pin_indices: index of its pin, -1 for none.
        inertia_diagonal: c m/dt^2 [N/m].
        pin_weight: weight of a penalty pin [N/m].
        form_weight: h of all forms [N/m].
    """

    vertex_indices: Any
    pin_indices: Any
    inertia_diagonal: Any
    pin_weight: Any
    form_weight: Any


@dataclass(frozen=True, eq=False)
class UploadedNetwork:
    """A network on a device.

    Attributes:
        host_network: the network on the host.
        stream: stream of the copies and kernels.
        device_edges, row_data: edges and rows of the network.
        anchor_stiffness: (f,), sum of all anchors of a row [N/m].
    """

    host_network: DeviceNetwork
    stream: DeviceStream
    device_edges: DeviceEdges
    row_data: RowData
    anchor_stiffness: Any

    @classmethod
    def from_network(cls, network: DeviceNetwork, stream: DeviceStream) -> UploadedNetwork:
        """Copy a network to the device.

        Args:
            network: edges and row order on the host.
            stream: stream of the copies.
        """
        system, order = network.system, network.row_vertices
        pin, weight = number_pins(system), np.zeros(system.num_vertices)
        _, pinned, weights = system.penalty_pins
        weight[pinned] = weights
        places = RowData(
            stream.upload_array(order, np.int32),
            stream.upload_array(pin[order]),
            stream.upload_array(system.inertia_diagonal[order]),
            stream.upload_array(weight[order]),
            stream.upload_array(network.spring_form.vertex_weight[order]),
        )
        hold = stream.upload_array(network.anchor_stiffness[: network.num_free])
        return cls(network, stream, network.upload_edges(stream), places, hold)

    def upload_step(
        self, problem: StepProblem, initial_guess: Positions, uploads: ReusedUploads, *, supports_contact: bool = False
    ) -> DeviceStep:
        """Upload a step problem.

        Args:
            problem: the step on the host.
            initial_guess: positions (n, 3) [m] from which the solve starts.
            uploads: device arrays of the last step, which are overwritten.
            supports_contact: whether to upload also the start of the step, which contact requires.
        """
        force, up = self.host_network.spring_form.compute_force(problem), uploads.upload_array
        target, pins, start = up(problem.inertial_target), upload_pin_targets(problem, uploads), problem.step_start
        lagged = (
            (up(start.velocity_origin), up(start.lagged_positions))
            if self.host_network.spring_form.dashpots
            else (target, target)
        )
        begun = (up(start.positions), up(start.velocity)) if supports_contact else (target, target)
        pressed = (
            up(start.normal_force_positions) if supports_contact and start.normal_force_positions is not None else None
        )
        return DeviceStep(
            target, up(force), up(initial_guess), pins, *lagged, *begun, (start.time, start.stage_time), pressed
        )


def number_pins(system: System) -> NDArray[np.int32]:
    """Return the index of each vertex's pin (n,), -1 for none."""
    numbers = np.full(system.num_vertices, -1, np.int32)
    numbers[system.pins.vertices] = np.arange(len(system.pins.vertices))
    return numbers


def upload_pin_targets(problem: StepProblem, uploads: ReusedUploads) -> Any:
    """Upload the pin targets to the device, which does not support empty arrays.

    Args:
        problem: the step with the targets.
        uploads: device arrays of the last step, which are overwritten.

    Returns:
        Device array (q, 3) [m]; one row of zeros if there are no pins.
    """
    return uploads.upload_array(problem.pin_targets if len(problem.pin_targets) else np.zeros((1, 3)))


class LoadedStep:
    """Data of a solve for its step, in rows.

    Attributes:
        device_edges: the edges, as in this step.
        step_data: anchors of the free rows (f,) and (f, 3).
    """

    def __init__(self, uploaded: UploadedNetwork) -> None:
        stream, network, edges = uploaded.stream, uploaded.host_network, uploaded.device_edges
        self._uploaded_network, rows = uploaded, (network.num_free, 3)
        if network.spring_form.dashpots:
            own = (
                stream.upload_array(network.edge_direction),
                stream.allocate_zeros(len(network.rest_length), np.float64),
            )
            edges = edges._replace(edge_direction=own[0], dashpot_offset=own[1])
        self.device_edges = edges
        self.step_data = DeviceStepData(
            uploaded.anchor_stiffness, stream.allocate_zeros(rows, np.float64), stream.allocate_zeros(rows, np.float64)
        )

    def load_step(self, step: DeviceStep, *rows: Any) -> None:
        """Load a step, and write its initial guess to rows.

        Args:
            step: the step on the device.
            *rows: outputs, device arrays (n, 3) or wider [m]; exactly pinned vertices are set to their targets.
        """
        uploaded, queue = self._uploaded_network, self._uploaded_network.stream.cuda_stream
        network, places = uploaded.host_network, uploaded.row_data
        launch = device_sums.count_blocks(len(network.row_vertices)), device_sums.THREADS_PER_BLOCK, queue
        write_step_data[launch](places, step.inertial_target, step.external_force, step.pin_targets, self.step_data)
        for each in rows:
            write_initial_rows[launch](places, network.num_free, step.initial_guess, step.pin_targets, each)
        first, edges = len(network.spring_form.springs_and_forms.edges), len(network.ends)
        if first < edges:
            over = device_sums.count_blocks(edges - first), device_sums.THREADS_PER_BLOCK, queue
            write_dashpot_edges[over](
                first,
                places.vertex_indices,
                step.velocity_origin,
                step.lagged_positions,
                uploaded.device_edges.edge_direction,
                self.device_edges,
            )


@cuda.jit
def write_step_data(row_data, target, force, pin_targets, step_data):
    """Write the anchors of the free rows, and the other forces on them.

    Args:
        row_data: data of each row.
        target: inertial target by vertices (n, 3) [m].
        force: external force by vertices, with that of forms (n, 3) [N].
        pin_targets: targets of the pins (q, 3) [m].
        step_data: output, centres and forces of the free rows; its anchor stiffness is constant.
    """
    i = cuda.grid(1)
    while i < step_data.anchor_positions.shape[0]:
        v, m, w = row_data.vertex_indices[i], row_data.inertia_diagonal[i], row_data.pin_weight[i]
        for c in range(3):
            centre, whole = target[v, c], m + w
            if w > 0.0:
                centre = (m * centre + w * pin_targets[row_data.pin_indices[i], c]) / whole
            step_data.anchor_positions[i, c] = centre
            step_data.external_force[i, c] = force[v, c] - row_data.form_weight[i] * centre
        i += cuda.gridsize(1)


@cuda.jit
def write_initial_rows(row_data, num_free, initial_guess, pin_targets, rows):
    """Write an initial guess to rows, with exactly pinned vertices on their targets.

    Args:
        row_data: data of each row.
        num_free: number of free rows, the first ones; the others are exactly pinned.
        initial_guess: positions by vertices (n, 3) [m].
        pin_targets: targets of the pins (q, 3) [m].
        rows: output, (n, 3) or wider [m].
    """
    i = cuda.grid(1)
    while i < row_data.vertex_indices.shape[0]:
        for c in range(3):
            rows[i, c] = (
                initial_guess[row_data.vertex_indices[i], c]
                if i < num_free
                else pin_targets[row_data.pin_indices[i], c]
            )
        i += cuda.gridsize(1)


@cuda.jit
def write_dashpot_edges(first_dashpot, row_vertices, velocity_origin, lagged_positions, default_directions, edges):
    """Write the directions and offsets of the dashpots.

    Args:
        first_dashpot: index of the first dashpot; all edges from it on are dashpots.
        row_vertices: vertex of each row (n,).
        velocity_origin: origin of the stage's velocity, by vertices (n, 3) [m].
        lagged_positions: positions that define the directions, by vertices (n, 3) [m].
        default_directions: unit directions at zero length (m, 3).
        edges: output, the `DeviceEdges` whose `edge_direction` and `dashpot_offset` are written.
    """
    e = first_dashpot + cuda.grid(1)
    while e < edges.ends.shape[0]:
        i, j = row_vertices[edges.ends[e, 0]], row_vertices[edges.ends[e, 1]]
        v0, v1, v2 = (
            lagged_positions[i, 0] - lagged_positions[j, 0],
            lagged_positions[i, 1] - lagged_positions[j, 1],
            lagged_positions[i, 2] - lagged_positions[j, 2],
        )
        length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        n0, n1, n2 = default_directions[e, 0], default_directions[e, 1], default_directions[e, 2]
        if length > ZERO_LENGTH:
            n0, n1, n2 = v0 / length, v1 / length, v2 / length
        edges.edge_direction[e, 0], edges.edge_direction[e, 1], edges.edge_direction[e, 2] = n0, n1, n2
        moved = n0 * (velocity_origin[i, 0] - velocity_origin[j, 0]) + n1 * (
            velocity_origin[i, 1] - velocity_origin[j, 1]
        )
        edges.dashpot_offset[e] = moved + n2 * (velocity_origin[i, 2] - velocity_origin[j, 2])
        e += cuda.gridsize(1)

"""Vertex block descent on a device, with one launch per colour.

It computes the iterates of `springbench.solvers.methods.vertex_block.vbd`. Colours, their order, packets and sums are
those of the CPU. Springs, quadratic forms and vertex contact with obstacles are supported; elements of other energies
and barrier contact are not. Every REBASE_INTERVAL iterations the displacement is added to the reference in float64, and
the gradient is computed there. Hence float32 iterates converge to the minimum in float64 as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact
from springbench.solvers.contact.half_space.vertex_contact import is_vertex_contact, without_vertex_contact
from springbench.solvers.cuda import cuda_device, device_springs
from springbench.solvers.cuda.cuda_target import DeviceStream, LaunchGraph
from springbench.solvers.cuda.device_network import DeviceNetwork
from springbench.solvers.cuda.device_solver import DeviceSolverState, MinimisingSolver
from springbench.solvers.cuda.device_springs import DeviceLanes
from springbench.solvers.cuda.device_step import DeviceStep, LoadedStep, UploadedNetwork
from springbench.solvers.iteration.descent_method import ResidualMetric
from springbench.solvers.iteration.iterative_solver import compute_max_coordinate
from springbench.solvers.methods.vertex_block import device_half_spaces
from springbench.solvers.methods.vertex_block.colour_blocks import VertexBlocks
from springbench.solvers.methods.vertex_block.device_vbd_kernels import (
    EXTRAPOLATION,
    IS_REQUESTED,
    NUM_CONTROLS,
    OBJECTIVE,
    VBD_THREADS_PER_BLOCK,
    build_vbd_kernels,
    count_vbd_blocks,
)
from springbench.solvers.model.energies.quadratic_energy import Quadratic
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import StepProblem, System, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.spring_form import SpringForm
from springbench.solvers.simd.spring_packets import LANES

REBASE_INTERVAL = 16
"""Iterations between evaluations of the gradient in float64."""


def prepare_vbd(
    system: System, spring_form: SpringForm, vertex_blocks: VertexBlocks, spectral_radius: float, real: Any
) -> PreparedDeviceVertexBlockDescent:
    """Prepare the method on an available device.

    Args:
        system: the system.
        spring_form: its springs and quadratic forms.
        vertex_blocks: coloured packets.
        spectral_radius: rho of the acceleration.
        real: floating-point type of the kernels.

    Raises:
        Unsupported: for other energies, and if the device memory is too small.
    """
    taken = Springs, Quadratic, HalfSpaceContact
    others = sorted({type(energy).__name__ for energy in system.energies if not isinstance(energy, taken)})
    if others:
        raise Unsupported(
            "vbd: `device: cuda` supports only springs, quadratic forms and contact of vertices with obstacles, not "
            f"{', '.join(others)}; use `device: cpu`"
        )
    order = np.searchsorted(system.free_vertices, np.argsort(vertex_blocks.row_of_vertex)[: vertex_blocks.num_free])
    network = DeviceNetwork.from_system("vbd", without_vertex_contact(system), order)  # in the rows of the colours
    rows, size = system.num_vertices + 2, np.dtype(real).itemsize
    solve = len(vertex_blocks.spring_packets.row_offset) * 6 * size + rows * (4 * 8 + 12 * size + 8 * 18)
    obstacles = sum(len(energy.obstacles) for energy in system.energies if isinstance(energy, HalfSpaceContact))
    solve += 8 * device_half_spaces.FLOATS_PER_ROW * obstacles * vertex_blocks.num_free
    cuda_device.require_memory(
        "vbd", device_springs.compute_spring_bytes(vertex_blocks.spring_packets, real) + network.device_bytes + solve
    )
    with cuda_device.guard_device_errors():
        stream = DeviceStream()
        return PreparedDeviceVertexBlockDescent(
            system,
            spring_form,
            vertex_blocks,
            spectral_radius,
            real,
            cuda_device.describe_device(),
            UploadedNetwork.from_network(network, stream),
            DeviceLanes.from_packets(stream, vertex_blocks.spring_packets, system.num_vertices, real),
            stream.upload_array(vertex_blocks.spring_packets.gather_lanes(vertex_blocks.anchor_stiffness), real),
            stream.upload_array(vertex_blocks.spring_packets.gather_lanes(vertex_blocks.majorant), real),
            ResidualMetric(system),
            FixedObjective(system),
        )


@dataclass(frozen=True, eq=False)
class PreparedDeviceVertexBlockDescent(MinimisingSolver):
    """VBD, prepared on a device.

    The lanes, and the anchor stiffness and majorant of each lane [N/m], are on the device.
    """

    system: System
    spring_form: SpringForm
    vertex_blocks: VertexBlocks
    spectral_radius: float
    real_dtype: Any
    device_columns: dict[str, Any]
    uploaded_network: UploadedNetwork
    device_lanes: DeviceLanes
    anchor_stiffness: Any
    hessian_majorant: Any
    metric: ResidualMetric
    objective: FixedObjective
    supports_contact: ClassVar[bool] = True

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.metric.stats

    @property
    def description(self) -> str:
        """Description of the prepared solver."""
        return (
            f"vertices in {self.vertex_blocks.num_colours} colours; kernels in "
            f"{np.dtype(self.real_dtype)}, the gradient in float64; for "
            f"the residual alone {self.metric.description}"
        )

    def allocate_state(self) -> DeviceSolverState:
        """Allocate the memory of a solve."""
        return DeviceSweepState(self)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        stiffness = self.vertex_blocks.majorant[self.vertex_blocks.row_of_vertex][self.system.unpinned_mask]
        return compute_max_coordinate(problem) * float(stiffness.sum()) ** 0.5


class DeviceSweepState(DeviceSolverState):
    """State of a VBD solve on the device.

    Attributes:
        _reference: (n + 2, 4), the reference in float64 [m].
        _displacement: (n + 2, 4), displacement from the reference [m].
        _previous_iterate, _sweep_start: (n + 2, 4), displacements of the previous iterate and of the start of the
            sweep [m].
        _force: (3, lanes), negative gradient at the reference [N].
        _rows: (n, 3), the current positions, written on demand.
    """

    def __init__(self, made: PreparedDeviceVertexBlockDescent) -> None:
        super().__init__(made.uploaded_network.stream, made.uploaded_network.host_network.row_vertices)
        self._prepared, self._kernels, self._springs = (
            made,
            build_vbd_kernels(made.real_dtype),
            device_springs.build_spring_kernels(made.real_dtype),
        )
        stream, lanes, n = self.stream, len(made.vertex_blocks.spring_packets.row_offset), made.system.num_vertices
        self._reference = stream.allocate_array((n + 2, 4), np.float64)
        self._displacement, self._previous_iterate, self._sweep_start = (
            stream.allocate_array((n + 2, 4), made.real_dtype) for _ in range(3)
        )
        self._force = stream.allocate_array((3, max(1, lanes)), made.real_dtype)
        self._rows = stream.allocate_array((n, 3), np.float64)
        self._iteration = LaunchGraph(stream)
        self._half_spaces = None
        if any(map(is_vertex_contact, made.system.energies)):
            of, self._half_space_kernels = (
                made.uploaded_network,
                device_half_spaces.build_half_space_kernels(made.real_dtype),
            )
            self._half_spaces = device_half_spaces.DeviceHalfSpaces(
                stream,
                made.system,
                of.host_network.row_vertices,
                of.row_data.vertex_indices,
                made.vertex_blocks.num_free,
            )
        more = self._half_spaces.launch_shape[0] if self._half_spaces else 0
        self._sums = [stream.allocate_zeros(count_vbd_blocks(lanes) + more, np.float64) for _ in range(2)]
        self.loaded_step, self._control = (
            LoadedStep(made.uploaded_network),
            stream.allocate_zeros(NUM_CONTROLS, np.float64),
        )
        fresh = np.zeros(NUM_CONTROLS)
        fresh[[OBJECTIVE, EXTRAPOLATION]] = np.nan, 1.0
        self._initial_control = stream.upload_array(fresh)
        self._launch_kernel(
            self._springs.clear_rows,
            len(self._reference),
            self._reference,
            self._displacement,
            self._previous_iterate,
            self._sweep_start,
        )

    def load_step(self, step: DeviceStep) -> None:
        """Load a step that is on the device, and start to solve it."""
        self._launch_kernel(
            self._springs.clear_rows,
            len(self._reference),
            self._reference,
            self._displacement,
            self._previous_iterate,
            self._sweep_start,
        )
        self.stream.copy_array(self._initial_control, self._control)
        self.loaded_step.load_step(step, self._reference)
        if self._half_spaces:
            self._half_spaces.load_step(step)

    def position_rows(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""
        self._launch_kernel(
            self._springs.write_positions, len(self._rows), self._reference, self._displacement, self._rows
        )
        return self._rows

    def launch_iterations(self, num_iterations: int) -> int:
        """Launch iterations; return their number."""
        for number in range(self._num_iterations, self._num_iterations + num_iterations):
            if number % REBASE_INTERVAL == 0:
                self._rebase_reference(moved=number > 0)
            self._iteration.launch_together(self._launch_iteration)
        return num_iterations

    def _rebase_reference(self, *, moved: bool) -> None:
        made = self._prepared
        lanes = made.device_lanes
        if moved:
            self._launch_kernel(
                self._kernels.rebase_reference,
                len(self._reference),
                self._reference,
                self._displacement,
                self._previous_iterate,
                self._control,
            )
        self._launch_kernel(
            self._springs.linearise_springs, len(lanes.lane_row), *lanes.float64_arguments, lanes.padding_row,
            lanes.padding_end_row, self.loaded_step.step_data, self._reference, self._force,
        )  # fmt: skip

    def _launch_iteration(self) -> None:
        made, run = self._prepared, self._kernels
        rows = len(self._reference)
        accelerated = made.spectral_radius > 0.0
        if accelerated:
            self._sum_objective(self._displacement, IS_REQUESTED, self._sums[0])
        self._launch_sweep()
        if accelerated:
            self._launch_kernel(
                run.extrapolate_iterate, rows, self._displacement, self._previous_iterate, self._control
            )
            self._sum_objective(self._previous_iterate, EXTRAPOLATION, self._sums[1])
            self._launch_kernel(
                run.decide_extrapolation, VBD_THREADS_PER_BLOCK, made.spectral_radius, *self._sums, self._control
            )
            self._launch_kernel(
                run.finish_extrapolation,
                rows,
                self._displacement,
                self._sweep_start,
                self._previous_iterate,
                self._control,
            )

    def _launch_sweep(self) -> None:
        """Sweep all colours; vertices with half-spaces are then recomputed from their previous positions."""
        made = self._prepared
        lanes, first = made.device_lanes, made.vertex_blocks.first_packet
        for begin, end in zip(LANES * first[:-1], LANES * first[1:], strict=True):
            colour = (
                begin, end, *lanes.single_type_arguments, lanes.padding_row, lanes.padding_end_row,
                made.anchor_stiffness, made.hessian_majorant, self._force, self._displacement, self._sweep_start,
            )  # fmt: skip
            self._launch_kernel(self._kernels.sweep_colour, end - begin, *colour)
            if self._half_spaces:
                self._launch_kernel(
                    self._half_space_kernels.push_with_model,
                    end - begin,
                    *colour,
                    self._reference,
                    self._half_spaces.half_spaces,
                )

    def _sum_objective(self, u: Any, condition: int, sums: Any) -> None:
        made = self._prepared
        lanes = made.device_lanes
        self._launch_kernel(
            self._kernels.sum_objective, len(lanes.lane_row), *lanes.single_type_arguments, lanes.padding_row,
            lanes.padding_end_row, made.vertex_blocks.num_free, made.anchor_stiffness,
            self._force, u, condition, self._control, sums,
        )  # fmt: skip
        if self._half_spaces:
            press, over = self._half_space_kernels.evaluate_penalty, self._half_spaces.launch_shape
            press[over](
                self._half_spaces.half_spaces,
                self._reference,
                u,
                condition,
                self._control,
                count_vbd_blocks(len(lanes.lane_row)),
                sums,
            )

    def _launch_kernel(self, kernel: Any, threads: int, *arguments: Any) -> None:
        kernel[count_vbd_blocks(threads), VBD_THREADS_PER_BLOCK, self.stream.cuda_stream](*arguments)

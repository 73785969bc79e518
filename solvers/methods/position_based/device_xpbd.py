"""XPBD on a device: the iterates of `springbench.solvers.methods.position_based.xpbd`, with one launch per colour.

Each thread processes one spring. No two springs of a colour share a vertex, so no thread writes what another reads.
`springbench.solvers.methods.position_based.device_xpbd_kernels` documents the precision of each quantity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.cuda import cuda_device, device_sums
from springbench.solvers.cuda.cuda_target import DeviceStream, LaunchGraph, ReusedUploads, cuda
from springbench.solvers.cuda.device_solver import DeviceSolver, DeviceSolverState
from springbench.solvers.cuda.device_step import DeviceStep, number_pins, upload_pin_targets
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.methods.position_based.device_xpbd_kernels import (
    build_xpbd_kernels,
    finish_substep,
    predict_step,
    write_device_positions,
)
from springbench.solvers.methods.position_based.xpbd_projection import SpringConstraints
from springbench.solvers.model.step_problem import Positions, ResidualIterate, StepProblem, System

RealType = type[np.float32] | type[np.float64]


def prepare_xpbd(
    system: System,
    coloured_constraints: SpringConstraints,
    colour_starts: NDArray[np.int64],
    real_dtype: RealType,
    description: str,
    *,
    small_steps: bool,
) -> PreparedDeviceXpbd:
    """Prepare the method on an available device.

    Args:
        system: the system.
        coloured_constraints: the springs by colour.
        colour_starts: (colours + 1,), the first spring of each colour.
        real_dtype: floating-point type of the kernels.
        description: description of the solver.
        small_steps: whether to prepare the variant with small steps.

    Raises:
        Unsupported: if the device memory is too small.
    """
    m, n, size = len(coloured_constraints.stiffness), system.num_vertices, np.dtype(real_dtype).itemsize
    solve = m * 5.0 * size + n * (5 * 24 + 8 + 5.0 * size)
    cuda_device.require_memory("xpbd", m * (8 + 8 + 24.0 + size) + n * (6 * 24 + 32) + solve)
    with cuda_device.guard_device_errors():
        stream = DeviceStream()
        there = (
            DeviceConstraints.from_constraints(stream, coloured_constraints, real_dtype),
            VertexData.from_system(stream, system),
        )
        words = f"{description}; kernels in {np.dtype(real_dtype)}, from a reference in float64"
        made = PreparedDeviceXpbdSmallSteps if small_steps else PreparedDeviceXpbd
        return made(system, stream, *there, colour_starts, real_dtype, cuda_device.describe_device(), words)


class DeviceConstraints(NamedTuple):
    """Springs on the device.

    Attributes:
        ends: (m, 2).
        stiffness: (m,) [N/m].
        rest_length: r (m,) [m].
        rest_direction: (m, 3), used at zero length.
        reference_vectors: (4, m), D and |D| - r [m] of a solve.
        spring_tensions: (m,) [N] of a solve.
    """

    ends: Any
    stiffness: Any
    rest_length: Any
    rest_direction: Any
    reference_vectors: Any = None
    spring_tensions: Any = None

    @classmethod
    def from_constraints(
        cls, stream: DeviceStream, constraints: SpringConstraints, real: RealType
    ) -> DeviceConstraints:
        """Copy the constraints to the device, which does not support empty arrays.

        Args:
            stream: stream of the copies.
            constraints: springs by colour, on the host.
            real: type of the stiffnesses; lengths and directions remain float64.
        """
        m = max(1, len(constraints.stiffness))
        ends, direction = np.zeros((m, 2), np.int32), np.zeros((m, 3))
        stiffness, rest = np.zeros(m), np.zeros(m)
        for there, given in zip((ends, stiffness, rest, direction), constraints, strict=True):
            there[: len(given)] = given
        return cls(
            stream.upload_array(ends),
            stream.upload_array(stiffness, real),
            stream.upload_array(rest),
            stream.upload_array(direction),
        )

    def allocate_solve(self, real: RealType) -> DeviceConstraints:
        """Allocate the arrays of a solve."""
        m = len(self.stiffness)
        return self._replace(
            reference_vectors=cuda.device_array((4, m), real), spring_tensions=cuda.device_array(m, real)
        )


class VertexData(NamedTuple):
    """Data of each vertex (n,) on the device.

    Attributes:
        pin_indices: index of its pin, -1 for none.
        pin_weight: weight of the pin, 0 for none.
        anchor_stiffness: c m/dt^2 + weight [N/m].
        mass: [kg].
    """

    pin_indices: Any
    pin_weight: Any
    anchor_stiffness: Any
    mass: Any

    @classmethod
    def from_system(cls, stream: DeviceStream, system: System) -> VertexData:
        """Build the vertex data of a system.

        Args:
            stream: stream of the copies to the device.
            system: masses, pins and time step.
        """
        n, pins = system.num_vertices, system.pins
        weight = np.zeros(n)
        weight[pins.vertices] = pins.weight
        arrays = number_pins(system), weight, vertex_terms.compute_anchor_stiffness(system), system.mass
        return cls(*map(stream.upload_array, arrays))


@dataclass(frozen=True, eq=False)
class PreparedDeviceXpbd(DeviceSolver):
    """XPBD, prepared on a device.

    `colour_starts` (colours + 1,) has the first spring of each colour.
    """

    residual_iterate: ClassVar[ResidualIterate] = "none"

    system: System
    stream: DeviceStream
    device_constraints: DeviceConstraints
    vertex_data: VertexData
    colour_starts: NDArray[np.int64]
    real_dtype: RealType
    device_columns: dict[str, Any]
    description: str

    stats: dict[str, float] = field(default_factory=dict[str, float])
    is_substepping: ClassVar[bool] = False

    def upload_problem(self, problem: StepProblem, initial_guess: Positions, uploads: ReusedUploads) -> DeviceStep:
        """Upload a step problem.

        Args:
            problem: the step.
            initial_guess: not used.
            uploads: device arrays of the previous step, overwritten.
        """
        up, start = uploads.upload_array, problem.step_start
        target, force, pins = (
            up(problem.inertial_target),
            up(problem.external_force),
            upload_pin_targets(problem, uploads),
        )
        here = (up(start.positions), up(start.velocity)) if self.is_substepping else (target, target)
        return DeviceStep(target, force, target, pins, target, target, *here, (start.time, start.stage_time))

    def allocate_state(self) -> DeviceSolverState:
        """Allocate the memory of a solve."""
        return DeviceXpbdState(self)


class PreparedDeviceXpbdSmallSteps(PreparedDeviceXpbd):
    """XPBD with small steps, prepared on a device."""

    is_substepping: ClassVar[bool] = True

    def allocate_state(self) -> DeviceSolverState:
        """Allocate the memory of a solve."""
        return DeviceXpbdSmallStepsState(self)


class _DeviceXpbdState(DeviceSolverState):
    """State of an XPBD solve on the device.

    Reference x (n, 3) [m], displacement u (n, 4) [m], vertex compliance (n,) [m/N].
    """

    def __init__(self, made: PreparedDeviceXpbd) -> None:
        n, stream = made.system.num_vertices, made.stream
        super().__init__(stream, np.arange(n))
        self.prepared, self.xpbd_kernels, self.device_constraints = (
            made,
            build_xpbd_kernels(made.real_dtype),
            made.device_constraints.allocate_solve(made.real_dtype),
        )
        self.projection = LaunchGraph(stream)
        self.reference, self.position_output = (stream.allocate_array((n, 3), np.float64) for _ in range(2))
        self.displacement, self.vertex_compliance = (
            stream.allocate_array((n, 4), made.real_dtype),
            stream.allocate_array(n, made.real_dtype),
        )

    def position_rows(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""
        self.launch_kernel(
            write_device_positions, len(self.reference), self.reference, self.displacement, self.position_output
        )
        return self.position_output

    def launch_kernel(self, kernel: Any, num_items: int, *arguments: Any) -> None:
        """Launch a kernel whose threads loop over `num_items` items."""
        kernel[device_sums.count_blocks(num_items), device_sums.THREADS_PER_BLOCK, self.stream.cuda_stream](*arguments)

    def linearise_constraints(self) -> None:
        """Initialise the springs at the reference, with zero tensions."""
        count = int(self.prepared.colour_starts[-1])
        self.launch_kernel(
            self.xpbd_kernels.linearise_constraints, count, self.reference, count, self.device_constraints
        )

    def project_constraints(self) -> None:
        """Project all springs once."""
        for begin, end in zip(
            self.prepared.colour_starts[:-1].tolist(), self.prepared.colour_starts[1:].tolist(), strict=True
        ):
            self.launch_kernel(
                self.xpbd_kernels.project_colour,
                end - begin,
                begin,
                end,
                self.device_constraints,
                self.vertex_compliance,
                self.displacement,
            )


class DeviceXpbdState(_DeviceXpbdState):
    """State of an XPBD solve, which starts at the positions without springs."""

    def load_step(self, step: DeviceStep) -> None:
        """Load a step that is on the device, and start to solve it."""
        n, places = len(self.reference), self.prepared.vertex_data
        self.launch_kernel(
            self.xpbd_kernels.write_anchors,
            n,
            places,
            step.inertial_target,
            step.external_force,
            step.pin_targets,
            self.reference,
            self.displacement,
            self.vertex_compliance,
        )
        self.linearise_constraints()

    def launch_iterations(self, num_iterations: int) -> int:
        """Launch iterations; return their number."""
        for _ in range(num_iterations):
            self.projection.launch_together(self.project_constraints)
        return num_iterations


class DeviceXpbdSmallStepsState(_DeviceXpbdState):
    """State of a small-steps solve on the device.

    Each solve restarts at the start of the step, with one substep per iteration so far.
    """

    def __init__(self, made: PreparedDeviceXpbd) -> None:
        super().__init__(made)
        shape, empty = self.reference.shape, self.stream.allocate_array
        self._substep_start, self._v = (empty(shape, np.float64) for _ in range(2))
        self._float64_compliance, self._num_substeps = empty(shape[0], np.float64), 0
        self._step: DeviceStep

    def load_step(self, step: DeviceStep) -> None:
        """Load a step that is on the device, and start to solve it."""
        self._num_substeps, self._step = 0, step

    def position_rows(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""
        return super().position_rows() if self._num_substeps else self._step.positions

    def velocity_rows(self) -> Any:
        """Return the final velocity in rows (n, 3) [m/s], on the device."""
        return self._v if self._num_substeps else self._step.velocity

    def launch_iterations(self, num_iterations: int) -> int:
        """Launch iterations; return their number."""
        step, n, places = self._step, len(self.reference), self.prepared.vertex_data
        self._num_substeps += num_iterations
        if not self._num_substeps:
            return num_iterations
        h = self.prepared.system.time_step / self._num_substeps
        self.stream.copy_array(step.positions, self.reference)
        self.stream.copy_array(step.velocity, self._v)
        self.launch_kernel(
            self.xpbd_kernels.write_compliance,
            n,
            places,
            h,
            self.displacement,
            self.vertex_compliance,
            self._float64_compliance,
        )
        for left in range(self._num_substeps - 1, -1, -1):
            part = left / self._num_substeps
            self.launch_kernel(
                predict_step, n, h, part, places, step.positions, step.pin_targets,
                self._float64_compliance, step.external_force, self._v, self._substep_start,
                self.reference, self.displacement,
            )  # fmt: skip
            self.projection.launch_together(self._project_from_reference)
            self.launch_kernel(finish_substep, n, h, self._substep_start, self.reference, self.displacement, self._v)
        return num_iterations

    def _project_from_reference(self) -> None:
        self.linearise_constraints()
        self.project_constraints()

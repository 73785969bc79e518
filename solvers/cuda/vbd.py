"""Vertex block descent on a device: the iterates of `solvers.methods.vbd`, one launch per colour.

Colours, their order, packets and sums are those of the CPU. Springs, quadratic forms and vertex contact with obstacles
are supported; elements of other energies and barrier contact are not. Every REBASE iterations the displacement
is added to the reference in float64, and the gradient is computed there. Hence float32 iterates converge to the minimum
in float64 as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from solvers.contact.energy import Contact
from solvers.contact.touching import is_contact, without_contact
from solvers.core.descent import Metric
from solvers.core.driver import largest
from solvers.core.fixed_objective import Objective
from solvers.core.parts import Parts
from solvers.core.vertex_blocks import VertexBlocks
from solvers.cuda import device, half_spaces, springs
from solvers.cuda.network import Network
from solvers.cuda.run import DeviceIterating, Minimising
from solvers.cuda.springs import Lanes
from solvers.cuda.steps import Begun, Step, Uploaded
from solvers.cuda.target import THREADS, Stream, blocks
from solvers.cuda.vbd_kernels import ASKED, CONTROLS, KNOWN, WEIGHT, kernels
from solvers.energies.quadratic import Quadratic
from solvers.energies.springs import Springs
from solvers.problem import StepProblem, System, Unsupported
from solvers.vectors.springs import LANES

REBASE = 16
"""Iterations between evaluations of the gradient in float64."""


def prepare(system: System, parts: Parts, made: VertexBlocks, radius: float, real: Any) -> PreparedVertexBlockDescent:
    """Prepare the method on an available device.

    Args:
        system: the system.
        parts: its springs and quadratic forms.
        made: coloured packets.
        radius: rho of the acceleration.
        real: floating-point type of the kernels.

    Raises:
        Unsupported: for other energies, and if the device memory is too small.
    """
    taken = Springs, Quadratic, Contact
    others = sorted({type(energy).__name__ for energy in system.energies if not isinstance(energy, taken)})
    if others:
        raise Unsupported(
            "vbd: on a device it takes springs, quadratic forms and contact of vertices with obstacles alone, not "
            f"{', '.join(others)}; without `device: cuda` it takes these too"
        )
    order = np.searchsorted(system.free, np.argsort(made.row)[: made.free])
    network = Network.of("vbd", without_contact(system), order)  # in the rows of the colours
    rows, size = system.vertices + 2, np.dtype(real).itemsize
    solve = len(made.bundles.own) * 6 * size + rows * (4 * 8 + 12 * size + 8 * 18)
    obstacles = sum(len(energy.obstacles) for energy in system.energies if isinstance(energy, Contact))
    solve += 8 * half_spaces.NUMBERS * obstacles * made.free
    device.require_memory("vbd", springs.needed(made.bundles, real) + network.bytes + solve)
    with device.guarded():
        stream = Stream()
        return PreparedVertexBlockDescent(
            system,
            parts,
            made,
            radius,
            real,
            device.told(),
            Uploaded.of(network, stream),
            Lanes.of(stream, made.bundles, system.vertices, real),
            stream.upload(made.bundles.in_lanes(made.held), real),
            stream.upload(made.bundles.in_lanes(made.majorant), real),
            Metric(system),
            Objective(system),
        )


@dataclass(frozen=True, eq=False)
class PreparedVertexBlockDescent(Minimising):
    """VBD, prepared on a device, with lanes, anchor stiffness and majorant of each lane [N/m] there."""

    system: System
    parts: Parts
    made: VertexBlocks
    radius: float
    real: Any
    columns: dict[str, Any]
    uploaded: Uploaded
    lanes: Lanes
    held: Any
    majorant: Any
    metric: Metric
    objective: Objective
    touches: ClassVar[bool] = True

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.metric.facts

    @property
    def choice(self) -> str:
        """Description of the prepared solver."""
        return (
            f"vertices in {self.made.colours} colours; kernels in {np.dtype(self.real)}, the gradient in float64; for "
            f"the residual alone {self.metric.choice}"
        )

    def iterating(self) -> DeviceIterating:
        """Allocate the memory of a solve."""
        return Sweeps(self)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] scale, below a small part of which round-off is checked."""
        stiffness = self.made.majorant[self.made.row][self.system.unpinned]
        return largest(problem) * float(stiffness.sum()) ** 0.5


class Sweeps(DeviceIterating):
    """State of a VBD solve on the device.

    Attributes:
        x: (n + 2, 4), the reference in float64 [m].
        u: the displacement from the reference [m].
        older, before: displacements of the previous iterate and of the start of the sweep [m].
        force: (3, lanes), negative gradient at the reference [N].
        rows: (n, 3), the current positions, written on demand.
    """

    def __init__(self, made: PreparedVertexBlockDescent) -> None:
        super().__init__(made.uploaded.stream, made.uploaded.network.order)
        self._made, self._kernels, self._springs = made, kernels(made.real), springs.kernels(made.real)
        stream, lanes, n = self.stream, len(made.made.bundles.own), made.system.vertices
        self._x = stream.empty((n + 2, 4), np.float64)
        self._u, self._older, self._before = (stream.empty((n + 2, 4), made.real) for _ in range(3))
        self._force = stream.empty((3, max(1, lanes)), made.real)
        self._rows = stream.empty((n, 3), np.float64)
        self._spaces = None
        if any(map(is_contact, made.system.energies)):
            of, self._pushing = made.uploaded, half_spaces.kernels(made.real)
            self._spaces = half_spaces.Spaces(stream, made.system, of.network.order, of.places.vertex, made.made.free)
        more = self._spaces.over[0] if self._spaces else 0
        self._sums = [stream.zeros(blocks(lanes) + more, np.float64) for _ in range(2)]
        self.loaded, self._control = Begun(made.uploaded), stream.zeros(CONTROLS, np.float64)
        fresh = np.zeros(CONTROLS)
        fresh[[KNOWN, WEIGHT]] = np.nan, 1.0
        self._fresh = stream.upload(fresh)
        self._launch(self._springs.clear, len(self._x), self._x, self._u, self._older, self._before)

    def take(self, step: Step) -> None:
        """Load a step that is on the device, and start to solve it."""
        self._launch(self._springs.clear, len(self._x), self._x, self._u, self._older, self._before)
        self.stream.copy(self._fresh, self._control)
        self.loaded.take(step, self._x)
        if self._spaces:
            self._spaces.take(step)

    def settled(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""
        self._launch(self._springs.settle, len(self._rows), self._x, self._u, self._rows)
        return self._rows

    def sweep(self, count: int) -> int:
        """Launch iterations; return how many of them moved something."""
        for number in range(self._done, self._done + count):
            if number % REBASE == 0:
                self._rebase(moved=number > 0)
            self._once()
        return count

    def _rebase(self, *, moved: bool) -> None:
        made = self._made
        lanes = made.lanes
        if moved:
            self._launch(self._kernels.rebase, len(self._x), self._x, self._u, self._older, self._control)
        self._launch(
            self._springs.linearise, len(lanes.own), *lanes.written, lanes.nobody, lanes.far, self.loaded.given,
            self._x, self._force,
        )  # fmt: skip

    def _once(self) -> None:
        made, run = self._made, self._kernels
        rows = len(self._x)
        accelerated = made.radius > 0.0
        if accelerated:
            self._level(self._u, ASKED, self._sums[0])
        self._colours()
        if accelerated:
            self._launch(run.extrapolate, rows, self._u, self._older, self._control)
            self._level(self._older, WEIGHT, self._sums[1])
            self._launch(run.decide, THREADS, made.radius, *self._sums, self._control)
            self._launch(run.finish, rows, self._u, self._before, self._older, self._control)

    def _colours(self) -> None:
        """Sweep all colours; vertices with half-spaces are then recomputed from their previous positions."""
        made = self._made
        lanes, first = made.lanes, made.made.first
        for begin, end in zip(LANES * first[:-1], LANES * first[1:], strict=True):
            colour = (
                begin, end, *lanes.read, lanes.nobody, lanes.far, made.held, made.majorant, self._force, self._u,
                self._before,
            )  # fmt: skip
            self._launch(self._kernels.sweep, end - begin, *colour)
            if self._spaces:
                self._launch(self._pushing.push, end - begin, *colour, self._x, self._spaces.given)

    def _level(self, u: Any, asked: int, sums: Any) -> None:
        made = self._made
        lanes = made.lanes
        self._launch(
            self._kernels.level, len(lanes.own), *lanes.read, lanes.nobody, lanes.far, made.made.free, made.held,
            self._force, u, asked, self._control, sums,
        )  # fmt: skip
        if self._spaces:
            press, over = self._pushing.press, self._spaces.over
            press[over](self._spaces.given, self._x, u, asked, self._control, blocks(len(lanes.own)), sums)

    def _launch(self, kernel: Any, threads: int, *arguments: Any) -> None:
        kernel[blocks(threads), THREADS, self.stream.queue](*arguments)

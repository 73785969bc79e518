"""Vertex block descent on a device: the iterates of `solvers.methods.vbd`, a colour a launch.

Colours, their order, bundles and sums are the processor's. Springs and quadratic forms are taken; elements of other
energies and contact are refused. Every REBASE iterations the displacement is added to the reference in float64, and the
gradient computed there: in float32 too iterates tend to the minimum in float64.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from solvers.core.driver import largest
from solvers.core.parts import Parts
from solvers.core.vertex_blocks import VertexBlocks
from solvers.cuda import device, objective_kernels, residual, springs, sums
from solvers.cuda.network import Network
from solvers.cuda.resident import AT_ONCE, Minimising, MinimisingIterating, ResidentIterating
from solvers.cuda.run import THREADS, Stream, blocks
from solvers.cuda.springs import Lanes
from solvers.cuda.steps import Begun, Step, Uploaded
from solvers.cuda.vbd_kernels import ASKED, CONTROLS, KNOWN, WEIGHT, kernels
from solvers.energies.quadratic import Quadratic
from solvers.energies.springs import Springs
from solvers.problem import StepProblem, System, Unsupported
from solvers.vectors.springs import LANES

REBASE = 16
"""Iterations from one gradient in float64 to the next."""


def prepare(system: System, parts: Parts, made: VertexBlocks, radius: float, real: Any) -> PreparedVertexBlockDescent:
    """The method on the device, which is `ready`. radius: rho of the acceleration; real: what kernels compute in.
    Raises Unsupported."""
    taken = Springs, Quadratic
    others = sorted({type(energy).__name__ for energy in system.energies if not isinstance(energy, taken)})
    if others:
        raise Unsupported(
            f"vbd: on a device it takes springs and quadratic forms alone, not {', '.join(others)}; "
            "without `device: cuda` it takes these too"
        )
    order = np.searchsorted(system.free, np.argsort(made.row)[: made.free])
    network = Network.of("vbd", system, order)  # in the rows of the colours
    rows, size = system.vertices + 2, np.dtype(real).itemsize
    solves = len(made.bundles.own) * 6 * size + rows * (4 * 8 + 12 * size + 8 * (18 + residual.NUMBERS))
    device.require_memory("vbd", springs.needed(made.bundles, real) + network.bytes + AT_ONCE * solves)
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
        )


@dataclass(frozen=True, eq=False)
class PreparedVertexBlockDescent(Minimising):
    """parts, made: as on the processor; the rest is on the device: lanes; held, majorant, of each lane [N/m]."""

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
    facts: dict[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        self.facts["sweep_bytes"] = _sweep_bytes(self.made, np.dtype(self.real).itemsize, self.radius > 0.0)

    @property
    def choice(self) -> str:
        """What it chose."""
        return f"vertices in {self.made.colours} colours; kernels in {np.dtype(self.real)}, the gradient in float64"

    def iterating(self) -> ResidentIterating:
        """See Resident."""
        return _Iterating(self)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        stiffness = self.made.majorant[self.made.row][self.system.unpinned]
        return largest(problem) * float(stiffness.sum()) ** 0.5


class _Iterating(MinimisingIterating):
    """x (n + 2, 4), the reference in float64; u, the displacement from it; older, the iterate before, and before, the
    one where the sweep began, from it too [m]. force (3, lanes): minus the gradient at it [N]; rows (n, 3): where it
    is, and gradient (f, 3) there, both where somebody asks for them."""

    def __init__(self, made: PreparedVertexBlockDescent) -> None:
        super().__init__(made.uploaded)
        self._made, self._kernels, self._springs = made, kernels(made.real), springs.kernels(made.real)
        stream, lanes, n = self.stream, len(made.made.bundles.own), made.system.vertices
        self._x = stream.empty((n + 2, 4), np.float64)
        self._u, self._older, self._before = (stream.empty((n + 2, 4), made.real) for _ in range(3))
        self._force = stream.empty((3, max(1, lanes)), made.real)
        self._rows, self._gradient = stream.empty((n, 3), np.float64), stream.empty((n, 3), np.float64)
        self._sums = [stream.zeros(blocks(lanes), np.float64) for _ in range(2)]
        self._begun, self._control = Begun(made.uploaded), stream.zeros(CONTROLS, np.float64)
        fresh = np.zeros(CONTROLS)
        fresh[[KNOWN, WEIGHT]] = np.nan, 1.0
        self._fresh = stream.upload(fresh)

    def take(self, step: Step) -> None:
        """See ResidentIterating."""
        self._launch(self._springs.clear, len(self._x), self._x, self._u, self._older, self._before)
        self.stream.copy(self._fresh, self._control)
        self._begun.take(step, self._x)

    def settled(self) -> Any:
        """See ResidentIterating."""
        self._launch(self._springs.settle, len(self._rows), self._x, self._u, self._rows)
        return self._rows

    def residual(self) -> float:
        """See Iterating; on the device."""
        with device.guarded():
            made, free = self._made.uploaded, self._made.made.free
            launch = sums.blocks(free), sums.THREADS, self.stream.queue
            g = self._gradient[:free]
            objective_kernels.gradient[launch](self._begun.edges, self._begun.given, self.settled(), g)
            return made.residuals.of(g)

    def sweep(self, count: int) -> None:
        """See DeviceIterating."""
        for number in range(self._done, self._done + count):
            if number % REBASE == 0:
                self._rebase(moved=number > 0)
            self._once()

    def _rebase(self, *, moved: bool) -> None:
        made = self._made
        lanes = made.lanes
        if moved:
            self._launch(self._kernels.rebase, len(self._x), self._x, self._u, self._older, self._control)
        self._launch(
            self._springs.linearise, len(lanes.own), *lanes.written, lanes.nobody, lanes.far, self._begun.given,
            self._x, self._force,
        )  # fmt: skip

    def _once(self) -> None:
        made, run = self._made, self._kernels
        lanes, rows, first = made.lanes, len(self._x), made.made.first
        accelerated = made.radius > 0.0
        if accelerated:
            self._level(self._u, ASKED, self._sums[0])
        for begin, end in zip(LANES * first[:-1], LANES * first[1:], strict=True):
            self._launch(
                run.sweep, end - begin, begin, end, *lanes.read, lanes.nobody, lanes.far, made.held, made.majorant,
                self._force, self._u, self._before,
            )  # fmt: skip
        if accelerated:
            self._launch(run.extrapolate, rows, self._u, self._older, self._control)
            self._level(self._older, WEIGHT, self._sums[1])
            self._launch(run.decide, THREADS, made.radius, *self._sums, self._control)
            self._launch(run.finish, rows, self._u, self._before, self._older, self._control)

    def _level(self, u: Any, asked: int, sums: Any) -> None:
        made = self._made
        lanes = made.lanes
        self._launch(
            self._kernels.level, len(lanes.own), *lanes.read, lanes.nobody, lanes.far, made.made.free, made.held,
            self._force, u, asked, self._control, sums,
        )  # fmt: skip

    def _launch(self, kernel: Any, threads: int, *arguments: Any) -> None:
        kernel[blocks(threads), THREADS, self.stream.queue](*arguments)


def _sweep_bytes(made: VertexBlocks, size: int, accelerated: bool) -> int:
    """Bytes that an iteration must move with numbers of so many bytes: of each colour's launch each array once, and
    each row of positions that it reads once. Weights, of which there are few, are left out."""
    lanes, entries, row = len(made.bundles.own), len(made.bundles.neighbour), 4 * size
    read, streamed = (
        0,
        lanes * (4 + 5 * size) + entries * (4 + 4 + 3 * size),
    )  # a vertex, a neighbour, a spring's number
    for begin, end in zip(made.bundles.start[made.first[:-1]], made.bundles.start[made.first[1:]], strict=True):
        read += len(np.unique(made.bundles.neighbour[LANES * begin : LANES * end]))
    total = streamed + row * (read + 3 * made.free)  # its row is read, and written twice
    if accelerated:
        total += streamed + row * made.free  # the objective
        total += row * 3 * len(made.held) + row * 4 * len(made.held)  # the extrapolation, and taking it
    return int(total)

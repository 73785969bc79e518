"""Vertex block descent on a device: the iterates of `solvers.methods.vbd`, a colour a launch.

Colours, their order, bundles and sums are the processor's. Springs and quadratic forms are taken; elements of other
energies and contact are refused. Every REBASE iterations the displacement is added to the reference in float64, and the
gradient computed there: in float32 too iterates tend to the minimum in float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from solvers.core import vertex_terms
from solvers.core.driver import largest
from solvers.core.parts import Parts
from solvers.core.vertex_blocks import VertexBlocks
from solvers.cuda import device, springs
from solvers.cuda.run import THREADS, DeviceIterating, DeviceIterative, Stream, blocks
from solvers.cuda.springs import Lanes
from solvers.cuda.target import cuda
from solvers.cuda.vbd_kernels import ASKED, CONTROLS, KNOWN, WEIGHT, kernels
from solvers.energies.quadratic import Quadratic
from solvers.energies.springs import Springs
from solvers.problem import Positions, StepProblem, System, Unsupported
from solvers.vectors.springs import LANES

if TYPE_CHECKING:
    from solvers.contact.local_global import Idle

REBASE = 16
"""Iterations from one gradient in float64 to the next."""


def prepare(
    system: System, parts: Parts, made: VertexBlocks, radius: float, real: Any, measure: Callable[[], Idle]
) -> PreparedVertexBlockDescent:
    """The method on the device, which is `ready`. radius: rho of the acceleration; real: what kernels compute in;
    measure: makes what tells residuals on the processor. Raises Unsupported."""
    taken = Springs, Quadratic
    others = sorted({type(energy).__name__ for energy in system.energies if not isinstance(energy, taken)})
    if others:
        raise Unsupported(
            f"vbd: on a device it takes springs and quadratic forms alone, not {', '.join(others)}; "
            "without `device: cuda` it takes these too"
        )
    rows, size = system.vertices + 2, np.dtype(real).itemsize
    per_lane = 4 * 8 + 3 * size  # the right-hand side, the gradient
    needed = springs.needed(made.bundles, real) + len(made.bundles.own) * per_lane + rows * (4 * 8 + 12 * size + 64)
    device.require_memory("vbd", needed)
    with device.guarded():
        stream = Stream()
        return PreparedVertexBlockDescent(
            system,
            parts,
            made,
            radius,
            real,
            measure,
            device.told(),
            stream,
            Lanes.of(stream, made.bundles, system.vertices, real),
            stream.upload(made.bundles.in_lanes(made.held), real),
            stream.upload(made.bundles.in_lanes(made.majorant), real),
            stream.upload(made.row, np.int32),
        )


@dataclass(frozen=True, eq=False)
class PreparedVertexBlockDescent(DeviceIterative):
    """parts, made: as on the processor; the rest is on the device: lanes; held, majorant, of each lane [N/m]; row (n,):
    where each vertex is."""

    system: System
    parts: Parts
    made: VertexBlocks
    radius: float
    real: Any
    residuals: Callable[[], Idle]
    columns: dict[str, Any]
    stream: Stream
    lanes: Lanes
    held: Any
    majorant: Any
    row: Any
    facts: dict[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        self.facts["sweep_bytes"] = _sweep_bytes(self.made, np.dtype(self.real).itemsize, self.radius > 0.0)

    @property
    def choice(self) -> str:
        """What it chose."""
        return f"vertices in {self.made.colours} colours; kernels in {np.dtype(self.real)}, the gradient in float64"

    @cached_property
    def measure(self) -> Idle:
        """What tells residuals, made where one is asked for: it may factorise."""
        return self.residuals()

    def begin(self, problem: StepProblem, guess: Positions) -> DeviceIterating:
        """See Iterative."""
        return _Iterating(self, problem, guess)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """See Iterative; on the processor, by an iteration of local-global."""
        return self.measure.gauge(problem)(p)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        stiffness = self.made.majorant[self.made.row][self.system.unpinned]
        return largest(problem) * float(stiffness.sum()) ** 0.5


class _Iterating(DeviceIterating):
    """x (n + 2, 4), the reference in float64; u, the displacement from it; older, the iterate before, and before, the
    one where the sweep began, from it too [m]. force (3, lanes): minus the gradient at it [N]."""

    def __init__(self, made: PreparedVertexBlockDescent, problem: StepProblem, guess: Positions) -> None:
        stream, rows, lanes = made.stream, problem.system.vertices + 2, len(made.made.bundles.own)
        super().__init__(stream)
        self._made, self._problem, self._kernels = made, problem, kernels(made.real)
        self._springs = springs.kernels(made.real)
        y = np.zeros((rows, 4))
        y[made.made.row, :3] = vertex_terms.pull(replace(problem, force=made.parts.force(problem)))
        right = stream.upload(made.made.bundles.right(made.made.held, y))
        p = stream.upload(vertex_terms.placed(guess, problem), np.float64)
        self._x = cuda.device_array((rows, 4), np.float64, stream=stream.queue)
        self._u, self._older, self._before = (
            cuda.device_array((rows, 4), made.real, stream=stream.queue) for _ in range(3)
        )
        self._force = cuda.device_array((3, max(1, lanes)), made.real, stream=stream.queue)
        self._right, self._out = right, p
        self._sums = [stream.zeros(blocks(lanes), np.float64) for _ in range(2)]
        control = np.zeros(CONTROLS)
        control[[KNOWN, WEIGHT]] = np.nan, 1.0
        self._control = stream.upload(control)
        self.uploaded()
        self._launch(self._springs.clear, rows, self._x, self._u, self._older, self._before)
        self._launch(self._springs.bring, problem.system.vertices, p, made.row, self._x)

    def gauge(self, p: Positions) -> float:
        """See DeviceIterating."""
        return self._made.residual_at(self._problem, p)

    def fetch(self) -> Positions:
        """See DeviceIterating."""
        self._launch(self._springs.fetch, len(self._made.row), self._x, self._u, self._made.row, self._out)
        return self.stream.download(self._out)

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
            self._springs.linearise, len(lanes.own), *lanes.written, lanes.nobody, lanes.far, self._right, self._x,
            self._force,
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

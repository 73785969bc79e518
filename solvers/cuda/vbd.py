"""Vertex block descent on a device: the iterates of `solvers.methods.vbd`, a colour a launch.

Colours, their order, bundles and sums are the processor's. Springs, quadratic forms and contact are taken;
elements of other energies are refused. Every REBASE iterations the displacement is added to the
reference in float64, and the gradient computed there: in float32 too iterates tend to the minimum in float64.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from solvers.contact.energy import Contact
from solvers.contact.self_contact import ObstacleContact
from solvers.contact.touching import is_contact, without_contact
from solvers.core.bounds import is_bounded, without_bounded
from solvers.core.driver import largest
from solvers.core.parts import Parts
from solvers.core.vertex_blocks import VertexBlocks
from solvers.cuda import (
    device,
    half_space_kernels,
    half_spaces,
    objective_kernels,
    pairs,
    residual,
    springs,
    sums,
    vbd_pair_kernels,
)
from solvers.cuda.network import Network
from solvers.cuda.resident import AT_ONCE, Minimising, MinimisingIterating, ResidentIterating
from solvers.cuda.run import THREADS, Stream, blocks
from solvers.cuda.springs import Lanes
from solvers.cuda.stepping import Stepping
from solvers.cuda.steps import Begun, Step, Uploaded
from solvers.cuda.vbd_kernels import ASKED, CONTROLS, KNOWN, WEIGHT, kernels
from solvers.cuda.vbd_pairs import Guarded
from solvers.device import Course
from solvers.energies.quadratic import Quadratic
from solvers.energies.springs import Springs
from solvers.problem import StepProblem, System, Unsupported
from solvers.vectors.springs import LANES

REBASE = 16
"""Iterations from one gradient in float64 to the next."""


def prepare(system: System, parts: Parts, made: VertexBlocks, radius: float, real: Any) -> PreparedVertexBlockDescent:
    """The method on the device, which is `ready`. radius: rho of the acceleration; real: what kernels compute in.
    Raises Unsupported."""
    taken = Springs, Quadratic, Contact, *pairs.Known
    others = sorted({type(energy).__name__ for energy in system.energies if not isinstance(energy, taken)})
    if others:
        raise Unsupported(
            f"vbd: on a device it takes springs, quadratic forms and contact alone, not {', '.join(others)}; "
            "without `device: cuda` it takes these too"
        )
    if any(map(is_contact, system.energies)) and any(map(is_bounded, system.energies)):
        raise Unsupported(
            "vbd: on a device contact of single vertices (Contact) is no part of the sweeps beside barriers of pairs; "
            "state surface-contact"
        )
    order = np.searchsorted(system.free, np.argsort(made.row)[: made.free])
    network = Network.of("vbd", without_bounded(without_contact(system)), order)  # in the rows of the colours
    rows, size = system.vertices + 2, np.dtype(real).itemsize
    solves = len(made.bundles.own) * 6 * size + rows * (4 * 8 + 12 * size + 8 * (18 + residual.NUMBERS))
    obstacles = sum(len(energy.obstacles) for energy in system.energies if isinstance(energy, Contact))
    solves += 8 * half_spaces.NUMBERS * obstacles * made.free
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
    touches: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self.facts["sweep_bytes"] = _sweep_bytes(self.made, np.dtype(self.real).itemsize, self.radius > 0.0)

    @property
    def choice(self) -> str:
        """What it chose."""
        return f"vertices in {self.made.colours} colours; kernels in {np.dtype(self.real)}, the gradient in float64"

    def iterating(self) -> ResidentIterating:
        """See Resident."""
        sweeps = Sweeps(self)
        return Guarded(self, sweeps) if any(map(is_bounded, self.system.energies)) else sweeps

    def stepping(self, course: Course) -> Stepping:
        """See Resident."""
        if any(isinstance(e, ObstacleContact) and e.place(0.0) is not e.place(1.0) for e in self.system.energies):
            raise Unsupported("the host makes way for obstacles' surfaces that move, before each step")
        return super().stepping(course)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        stiffness = self.made.majorant[self.made.row][self.system.unpinned]
        return largest(problem) * float(stiffness.sum()) ** 0.5


class Sweeps(MinimisingIterating):
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
        self._spaces = None
        if any(map(is_contact, made.system.energies)):
            of, self._pushing = made.uploaded, half_space_kernels.kernels(made.real)
            self._spaces = half_spaces.Spaces(stream, made.system, of.network.order, of.places.vertex, made.made.free)
        more = self._spaces.over[0] if self._spaces else 0
        self._sums = [stream.zeros(blocks(lanes) + more, np.float64) for _ in range(2)]
        self.loaded, self._control = Begun(made.uploaded), stream.zeros(CONTROLS, np.float64)
        fresh = np.zeros(CONTROLS)
        fresh[[KNOWN, WEIGHT]] = np.nan, 1.0
        self._fresh = stream.upload(fresh)
        self._since = 0
        self._launch(self._springs.clear, len(self._x), self._x, self._u, self._older, self._before)

    def take(self, step: Step) -> None:
        """See ResidentIterating."""
        self._launch(self._springs.clear, len(self._x), self._x, self._u, self._older, self._before)
        self.stream.copy(self._fresh, self._control)
        self.loaded.take(step, self._x)
        if self._spaces:
            self._spaces.take(step)

    def settled(self) -> Any:
        """See ResidentIterating."""
        self._settle(self._rows)
        return self._rows

    def _settle(self, out: Any) -> None:
        """Write where it is, in rows of the mesh (n, 3)."""
        self._launch(self._springs.settle, len(out), self._x, self._u, out)

    def residual(self) -> float:
        """See Iterating; on the device."""
        with device.guarded():
            made, free = self._made.uploaded, self._made.made.free
            launch = sums.blocks(free), sums.THREADS, self.stream.queue
            g = self._gradient[:free]
            rows = self.settled()
            objective_kernels.gradient[launch](self.loaded.edges, self.loaded.given, rows, g)
            if self._spaces:
                self._spaces.add_gradient(rows, g)
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

    def _colours(self, push: Any = None, *others: Any) -> None:
        """A sweep; push: moves the vertices of a colour anew that touch something, with what else it takes."""
        made = self._made
        lanes, first = made.lanes, made.made.first
        if self._spaces:
            push, others = self._pushing.push, (self._x, self._spaces.given)
        for begin, end in zip(LANES * first[:-1], LANES * first[1:], strict=True):
            colour = (
                begin, end, *lanes.read, lanes.nobody, lanes.far, made.held, made.majorant, self._force, self._u,
                self._before,
            )  # fmt: skip
            self._launch(self._kernels.sweep, end - begin, *colour)
            if push:
                self._launch(push, end - begin, *colour, *others)

    def alone(self, p: Any, q: Any, *, fresh: bool) -> None:
        """Write where a sweep leads from rows p to q, with what is extrapolated from sweeps before; fresh: whether
        these are forgotten."""
        if fresh:
            self._begin_at(p)
        if self._since % REBASE == 0:
            self._rebase(moved=self._since > 0)
        self._once()
        self._since += 1
        self._settle(q[: len(self._rows)])

    def pushed(self, p: Any, q: Any, push: Any, *others: Any) -> None:
        """Write where a sweep leads from rows p to q, with what pushes, extrapolated by nothing."""
        self._begin_at(p)
        self._rebase(moved=False)
        self._colours(push, *others)
        self._settle(q[: len(self._rows)])

    def _begin_at(self, p: Any) -> None:
        self._launch(vbd_pair_kernels.begin, len(self._x), p, self._x, self._u, self._older, self._before)
        self.stream.copy(self._fresh, self._control)
        self._since = 0

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

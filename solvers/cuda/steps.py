"""Step data on a device: upload of a host's step problem, and kernels that convert it to rows.

    centre_i = (c m/dt^2 target + w pin) / (c m/dt^2 + w),     force_i = f_i - h_i centre_i        h: of forms
    n = v/|v| and n'(A origin) of dashpots, v = A p at the step's start

Rows are those of `solvers.cuda.network`; the arrays of a step are by vertices, as on the host.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.cuda import sums
from solvers.cuda.network import Edges, Given, Network
from solvers.cuda.target import Stream, cuda
from solvers.energies.edges import TINY
from solvers.problem import Positions, StepProblem, System


class Step(NamedTuple):
    """A step on the device, by vertices.

    Attributes:
        target, guess: (n, 3) [m].
        force: (n, 3) [N], including that of forms.
        pins: (q, 3) [m]; one row if there are none.
        origin, lagged: (n, 3) [m], of the stage's velocity and of the dashpots' directions;
            arbitrary without dashpots.
        positions, velocity: (n, 3) [m, m/s] at the start of the step; arbitrary for a minimising method without
            contact.
        times: [s].
        pressed: (n, 3) [m], where friction evaluates normal forces; None for the start of the step.
    """

    target: Any
    force: Any
    guess: Any
    pins: Any
    origin: Any
    lagged: Any
    positions: Any
    velocity: Any
    times: tuple[float, float]
    pressed: Any = None


class Places(NamedTuple):
    """Data of each row (n,) on the device.

    Attributes:
        vertex: the vertex.
        pin: index of its pin, -1 for none.
        inertia: c m/dt^2 [N/m].
        weight: weight of a penalty pin [N/m].
        form: h of all forms [N/m].
    """

    vertex: Any
    pin: Any
    inertia: Any
    weight: Any
    form: Any


@dataclass(frozen=True, eq=False)
class Uploaded:
    """A network on a device.

    Attributes:
        edges, places: of the network.
        hold: (f,), sum of all anchors of a row [N/m].
        axis: (m, 3), of the edges as prepared.
    """

    network: Network
    stream: Stream
    edges: Edges
    places: Places
    hold: Any

    @classmethod
    def of(cls, network: Network, stream: Stream) -> Uploaded:
        """Copy a network to the device."""
        system, order = network.system, network.order
        pin, weight = pin_numbers(system), np.zeros(system.vertices)
        _, pinned, weights = system.penalty
        weight[pinned] = weights
        places = Places(
            stream.upload(order, np.int32),
            stream.upload(pin[order]),
            stream.upload(system.inertia[order]),
            stream.upload(weight[order]),
            stream.upload(network.parts.held[order]),
        )
        hold = stream.upload(network.hold[: network.free])
        return cls(network, stream, network.upload(stream), places, hold)

    def step(self, problem: StepProblem, guess: Positions, *, touches: bool = False) -> Step:
        """Upload a step problem with an initial guess (n, 3) [m].

        For methods with contact, also upload the start of the step.
        """
        force, up = self.network.parts.force(problem), self.stream.upload
        target, pins, start = up(problem.target), pins_of(problem, self.stream), problem.start
        lagged = (up(start.origin), up(start.expected)) if self.network.parts.dashpots else (target, target)
        begun = (up(start.positions), up(start.velocity)) if touches else (target, target)
        pressed = up(start.pressed) if touches and start.pressed is not None else None
        return Step(target, up(force), up(guess), pins, *lagged, *begun, (start.time, start.until), pressed)


def pin_numbers(system: System) -> NDArray[np.int32]:
    """Return the index of each vertex's pin (n,), -1 for none."""
    numbers = np.full(system.vertices, -1, np.int32)
    numbers[system.pins.vertices] = np.arange(len(system.pins.vertices))
    return numbers


def pins_of(problem: StepProblem, stream: Stream) -> Any:
    """Upload the pin targets to the device, which does not support empty arrays."""
    return stream.upload(problem.pin_targets if len(problem.pin_targets) else np.zeros((1, 3)))


class Begun:
    """Data of a solve for its step, in rows.

    Attributes:
        edges: the edges, as in this step.
        given: anchors of the free rows (f,) and (f, 3).
    """

    def __init__(self, uploaded: Uploaded) -> None:
        stream, network, edges = uploaded.stream, uploaded.network, uploaded.edges
        self._uploaded, rows = uploaded, (network.free, 3)
        if network.parts.dashpots:
            own = stream.upload(network.axis), stream.zeros(len(network.rest), np.float64)
            edges = edges._replace(axis=own[0], offset=own[1])
        self.edges = edges
        self.given = Given(uploaded.hold, stream.zeros(rows, np.float64), stream.zeros(rows, np.float64))

    def take(self, step: Step, *rows: Any) -> None:
        """Load the step, and write its initial guess to the given rows of at least three numbers.

        Exactly pinned vertices are set to their targets.
        """
        uploaded, queue = self._uploaded, self._uploaded.stream.queue
        network, places = uploaded.network, uploaded.places
        launch = sums.blocks(len(network.order)), sums.THREADS, queue
        give[launch](places, step.target, step.force, step.pins, self.given)
        for each in rows:
            place[launch](places, network.free, step.guess, step.pins, each)
        first, edges = len(network.parts.whole.edges), len(network.ends)
        if first < edges:
            over = sums.blocks(edges - first), sums.THREADS, queue
            lag[over](first, places.vertex, step.origin, step.lagged, uploaded.edges.axis, self.edges)


@cuda.jit
def give(places, target, force, pins, given):
    """Write the anchors of the free rows, and the other forces on them."""
    i = cuda.grid(1)
    while i < given.centre.shape[0]:
        v, m, w = places.vertex[i], places.inertia[i], places.weight[i]
        for c in range(3):
            centre, whole = target[v, c], m + w
            if w > 0.0:
                centre = (m * centre + w * pins[places.pin[i], c]) / whole
            given.centre[i, c] = centre
            given.force[i, c] = force[v, c] - places.form[i] * centre
        i += cuda.gridsize(1)


@cuda.jit
def place(places, free, guess, pins, rows):
    """Write an initial guess (n, 3) to rows.

    Rows from `free` on are set to their pins' targets.
    """
    i = cuda.grid(1)
    while i < places.vertex.shape[0]:
        for c in range(3):
            rows[i, c] = guess[places.vertex[i], c] if i < free else pins[places.pin[i], c]
        i += cuda.gridsize(1)


@cuda.jit
def lag(first, vertex, origin, lagged, made, edges):
    """Write directions and offsets of the dashpots, the edges from `first` on.

    `made` are used at zero length.
    """
    e = first + cuda.grid(1)
    while e < edges.ends.shape[0]:
        i, j = vertex[edges.ends[e, 0]], vertex[edges.ends[e, 1]]
        v0, v1, v2 = lagged[i, 0] - lagged[j, 0], lagged[i, 1] - lagged[j, 1], lagged[i, 2] - lagged[j, 2]
        length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        n0, n1, n2 = made[e, 0], made[e, 1], made[e, 2]
        if length > TINY:
            n0, n1, n2 = v0 / length, v1 / length, v2 / length
        edges.axis[e, 0], edges.axis[e, 1], edges.axis[e, 2] = n0, n1, n2
        moved = n0 * (origin[i, 0] - origin[j, 0]) + n1 * (origin[i, 1] - origin[j, 1])
        edges.offset[e] = moved + n2 * (origin[i, 2] - origin[j, 2])
        e += cuda.gridsize(1)

"""What others offer for the same question: SciPy's integrators on the equations of motion, at the error that was asked.

Forces are compiled, as ours are; once, as whoever calls SciPy first would have them, in NumPy. Radau and BDF know which
entries of the Jacobian are zero. A peer's tolerance is moved until its error, told by the same closer motion as ours,
is the one asked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from math import inf
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.sparse import block_array, csr_array, eye_array, kron

from harness.experiments.asked.search import AIM, Answer
from harness.experiments.asked.ways import Asked
from harness.reference.motion import Field, State
from harness.scenes.bind import Scene
from harness.simulation.controlled import TooSlow
from solvers.problem import LaggedEnergy, Start

PEERS: dict[str, tuple[str, int, bool]] = {
    "scipy-dop853": ("DOP853", 8, True),
    "scipy-dop853-numpy": ("DOP853", 8, False),
    "scipy-rk45": ("RK45", 5, True),
    "scipy-lsoda": ("LSODA", 5, True),
    "scipy-bdf": ("BDF", 3, True),
    "scipy-radau": ("Radau", 5, True),
}
"""SciPy's name, about the order, and whether forces are compiled."""

MOST = 5.0
"""Seconds of processor time that a peer may take for one motion."""
_TRIES, _NEAR = 5, 0.2
"""Tolerances tried for a peer, and the part of the error asked that is near enough to it."""


@dataclass(frozen=True, slots=True)
class Peer:
    """A peer's name, its estimated relative error, its wall seconds, how many times as much processor time it took as
    the answer, preparing included; and why there is nothing to tell."""

    name: str
    estimated: float
    seconds: float
    ratio: float
    reason: str = ""
    processor: float = inf
    """Seconds of processor time."""


def peers(asked: Asked, error: float, answer: Answer, names: Iterable[str] = PEERS) -> Iterator[Peer]:
    """These one after the other; what one cannot do is told by its reason. Raises Unintegrable where the scene has no
    equations of motion."""
    scene = asked.bound(asked.frame, "newmark")
    fields = {compiled: Field(scene, compiled=compiled) for compiled in (True, False)}
    fields[True].witness()  # compiles
    began = thread_time()
    answer.best.again()
    beside = _Beside(asked, error, answer, scene, fields, thread_time() - began)
    yield from map(beside.peer, names)


@dataclass(frozen=True, eq=False)
class _Beside:
    """ours: processor seconds of the answer."""

    asked: Asked
    error: float
    answer: Answer
    scene: Scene
    fields: dict[bool, Field]
    ours: float

    def peer(self, name: str) -> Peer:
        """The first tolerance that keeps to the error and is not far more exact, or the cheapest of those tried."""
        order, tolerance = PEERS[name][1], 0.2 * self.answer.tolerance
        found = Peer(name, inf, inf, inf, "its error does not come down to the one asked")
        for _ in range(_TRIES):
            one = self._tried(name, tolerance)
            if one.reason:
                return one if found.reason else found
            if one.estimated <= self.error and one.ratio < found.ratio:
                found = one
            if found.reason == "" and one.estimated >= _NEAR * self.error:
                return found
            aim = AIM * self.error / max(one.estimated, 1e-15)
            tolerance *= min(1e3, max(1e-3, aim ** ((order + 1.0) / order)))
        return found

    def _tried(self, name: str, tolerance: float) -> Peer:
        """With one tolerance [m]."""
        (method, _, compiled), free = PEERS[name], self.scene.system.free
        field, size = self.fields[compiled], self.scene.mesh.size or 1.0
        more: dict[str, Any] = {"jac_sparsity": pattern(self.scene)} if method in ("Radau", "BDF") else {}
        more |= {"rtol": max(tolerance / size, 1e-13), "atol": tolerance}
        solve: Any = solve_ivp  # its stubs say little of what it answers
        began, cpu = perf_counter(), thread_time()
        try:
            solved = solve(_limited(field, cpu + MOST), (0.0, self.asked.horizon), field.start, method, **more)
        except TooSlow:
            return Peer(name, inf, inf, inf, f"takes more than {MOST:g} s")
        seconds, processor = perf_counter() - began, thread_time() - cpu
        if not solved.success:
            return Peer(name, inf, inf, inf, str(solved.message))
        p, _ = field.motion(self.asked.horizon, solved.y[:, -1])
        return Peer(name, self.answer.error(p, free), seconds, processor / self.ours, processor=processor)


def _limited(field: Field, until: float) -> Callable[[float, State], State]:
    """The field, which raises TooSlow from a time of the processor's clock on."""

    def rate(t: float, y: State) -> State:
        if thread_time() > until:
            raise TooSlow
        return field(t, y)

    return rate


def pattern(scene: Scene) -> csr_array:
    """Which entries of F's Jacobian may differ from zero, (6 f, 6 f): 1 where they may."""
    system, p = scene.system, scene.mesh.rest
    begun = Start(p, np.zeros_like(p), 0.0, p, system.rate, 0.0)
    n = 3 * system.vertices
    begins = (energy.begin_step(begun) if isinstance(energy, LaggedEnergy) else energy for energy in system.energies)
    all_of_them = sum((abs(energy.hessian(p)) for energy in begins), csr_array((n, n)))
    whole = kron(eye_array(system.vertices), np.ones((1, 3)))  # a vertex couples with all of its coordinates
    vertices = csr_array(csr_array(whole @ all_of_them @ whole.T)[system.free])[:, system.free]
    coupled = csr_array(kron(vertices + eye_array(len(system.free)), np.ones((3, 3))))
    coupled.data[:] = 1.0
    return csr_array(block_array([[None, eye_array(coupled.shape[0])], [coupled, coupled]]))

"""What others offer for the same question: other libraries' integrators on the equations of motion, at the error asked.

Forces are compiled, as ours are; once, as whoever calls SciPy first would have them, in NumPy. A peer's tolerance is
moved until its error, told by the same closer motion as ours, is the one asked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from math import inf
from time import perf_counter, thread_time

from harness.base.errors import RunFailed
from harness.experiments.asked.libraries import LIBRARIES, InitialValueProblem
from harness.experiments.asked.search import AIM, Answer
from harness.experiments.asked.ways import Asked
from harness.reference.motion import Field, State
from harness.scenes.bind import Scene
from harness.simulation.controlled import TooSlow

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


def peers(asked: Asked, error: float, answer: Answer, names: Iterable[str] = LIBRARIES) -> Iterator[Peer]:
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
        order, tolerance = LIBRARIES[name].order, 0.2 * self.answer.tolerance
        if missing := LIBRARIES[name].missing:
            return Peer(name, inf, inf, inf, missing)
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
        library, free, size = LIBRARIES[name], self.scene.system.free, self.scene.mesh.size or 1.0
        field = self.fields[library.compiled]
        began, cpu = perf_counter(), thread_time()
        limited = _limited(field, cpu + MOST)
        motion = InitialValueProblem(
            limited, field.start, self.scene, self.asked.horizon, max(tolerance / size, 1e-13), tolerance
        )
        try:
            end = library.end(motion)
        except TooSlow:
            return Peer(name, inf, inf, inf, f"takes more than {MOST:g} s")
        except RunFailed as failed:
            return Peer(name, inf, inf, inf, str(failed))
        seconds, processor = perf_counter() - began, thread_time() - cpu
        p, _ = field.motion(self.asked.horizon, end)
        return Peer(name, self.answer.error(p, free), seconds, processor / self.ours, processor=processor)


def _limited(field: Field, until: float) -> Callable[[float, State], State]:
    """The field, which raises TooSlow from a time of the processor's clock on."""

    def rate(t: float, y: State) -> State:
        if thread_time() > until:
            raise TooSlow
        return field(t, y)

    return rate

"""Compare with third-party integrators on the equations of motion, at the same error.

Forces are compiled, as for the methods of this package. One SciPy integrator runs with NumPy forces too, which is
typical of a first implementation. The tolerance of each integrator is changed until its error matches the target. The
errors are estimated from the same reference trial.
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
"""CPU time limit of an integrator for one motion [s]."""
_TRIES, _NEAR = 5, 0.2
"""Largest number of tolerances per integrator; fraction of the target error that ends the adjustment."""


@dataclass(frozen=True, slots=True)
class Peer:
    """Result of a third-party integrator.

    Attributes:
        name: name of the integrator.
        estimated: estimated relative error.
        seconds: wall time [s].
        ratio: CPU time divided by that of the search result, both including preparation.
        reason: why there is no result; empty if there is one.
        processor: CPU time [s].
    """

    name: str
    estimated: float
    seconds: float
    ratio: float
    reason: str = ""
    processor: float = inf
    """CPU time [s]."""


def peers(asked: Asked, error: float, answer: Answer, names: Iterable[str] = LIBRARIES) -> Iterator[Peer]:
    """Measure third-party integrators one after the other; a failure is reported as `reason`.

    Args:
        asked: the scene and its end time.
        error: relative error to reach.
        answer: result to compare with.
        names: integrators in LIBRARIES.

    Raises:
        Unintegrable: the scene has no equations of motion.
    """
    scene = asked.bound(asked.frame, "newmark")
    fields = {compiled: Field(scene, compiled=compiled) for compiled in (True, False)}
    fields[True].witness()  # compiles
    began = thread_time()
    answer.best.again()
    beside = _Beside(asked, error, answer, scene, fields, thread_time() - began)
    yield from map(beside.peer, names)


@dataclass(frozen=True, eq=False)
class _Beside:
    """Comparison of one search result; `ours` is the CPU time of its best trial."""

    asked: Asked
    error: float
    answer: Answer
    scene: Scene
    fields: dict[bool, Field]
    ours: float

    def peer(self, name: str) -> Peer:
        """Measure one integrator.

        Its tolerance is adjusted until the error is below the target, but not far below.

        Where no tolerance does both, the cheapest one that meets the error counts.
        """
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
        """Integrate at one tolerance [m]."""
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
    """Return the vector field with a deadline on the CPU clock [s].

    It raises TooSlow afterwards.
    """

    def rate(t: float, y: State) -> State:
        if thread_time() > until:
            raise TooSlow
        return field(t, y)

    return rate

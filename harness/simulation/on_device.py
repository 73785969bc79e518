"""Steps of a solver on a device. They stay there, where the device knows all that happens between them; else a host
states each, and the rows say why.

A timed step does the iterations that the same step took in an untimed pass, and copies nothing back but, where a host
states it, its end. The passes are the same to the last bit: residuals, by which the untimed ones end, change nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from harness.scenes.bind import Scene
from harness.simulation.clock import Clock
from harness.simulation.passing import Passing
from harness.simulation.step import Step, Turns, start
from solvers.device import Course, Marks, Remote, Rule, Steps
from solvers.integrators import IMPLICIT_EULER, Integrator
from solvers.problem import Positions, Prepared, Solution, StepProblem, StopRule, Unsupported

TRIADS = 6
"""Of which the first compiles, and warms up."""


class OnDevice(Passing):
    """A prepared solver on a device, and how many iterations each of its solves took."""

    through_host: str | None = None
    """Why a host states each step; None where steps stay on the device."""

    def __init__(self, prepared: Prepared, usual: Remote) -> None:
        """usual: the solver of the scene's own system, of two."""
        super().__init__(prepared)
        self.usual = usual
        self._counts = list[int]()

    def keep(self, step: Step) -> None:
        """Take note of what a step took; steps come in their order."""
        self._counts += step.counts


class Staying(OnDevice):
    """Its steps follow each other on the device."""

    def __init__(self, prepared: Prepared, usual: Remote, steps: Steps) -> None:
        super().__init__(prepared, usual)
        self._steps = steps

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The step that follows the last one; the first of all where the problem is at the scene's start."""
        if problem.start.time == 0.0:
            self._steps.restart()
        return self._steps.solve(problem, stop)

    def upload(self) -> None:
        """Bring the start to the device."""
        self._steps.restart()

    def timed(self, clock: Clock) -> Iterator[dict[str, float | None]]:
        """All steps anew, each within the clock; yields the columns of each by events."""
        for count in self._counts:
            with clock:
                marks = self._steps.step(count)
            yield {**seconds(marks)}

    def download(self) -> Positions:
        """Where the last step ended, (n, 3) [m]."""
        return self._steps.positions()


class Replayed(OnDevice):
    """Its steps are stated by a host, and what each brings and leaves is copied."""

    def __init__(self, prepared: Prepared, usual: Remote, why: str) -> None:
        super().__init__(prepared, usual)
        self.through_host: str | None = why
        self._left: Iterator[int] | None = None
        self._told = dict[str, float]()

    def again(self) -> Replayed:
        """The same from the first step on."""
        self._left = iter(list(self._counts))
        return self

    def told(self) -> dict[str, float | None]:
        """Columns of what was solved since this was last asked: seconds by events on the device."""
        found, self._told = self._told, {}
        return {**found}

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The solver's answer in the first pass; then the same iterations again."""
        if self._left is None:
            return self._prepared.solve(problem, stop)
        one: Any = self._prepared.of(problem) if isinstance(self._prepared, Turns) else self._prepared
        found, marks = one.replay(problem, next(self._left))
        for name, value in seconds(marks).items():
            self._told[name] = self._told.get(name, 0.0) + value
        return found


def on_device(scene: Scene, prepared: Prepared, first_guess: str) -> Staying | Replayed | None:
    """How a prepared solver's steps are done on its device; None of one that computes on the processor."""
    usual = prepared.usual if isinstance(prepared, Turns) else prepared
    if not isinstance(usual, Remote):
        return None
    try:
        return Staying(prepared, usual, usual.stepping(_course(scene, prepared, first_guess)))
    except Unsupported as error:
        return Replayed(prepared, usual, str(error))


def _course(scene: Scene, prepared: Prepared, first_guess: str) -> Course:
    """What steps of a scene follow from. Raises Unsupported with what a host has to do before each."""
    usual = scene.integrator
    if not isinstance(usual, Integrator):
        raise Unsupported("the host states the unknowns of integrators that have several a step")
    if scene.alternate:
        raise Unsupported("the host states steps of two lengths")
    if scene.forces:
        where = sorted({getattr(force, "__module__", type(force).__module__) for force in scene.forces})
        named = ", ".join(name.rpartition(".")[2] for name in where)
        raise Unsupported(f"the host computes a force before each step, by a function in Python ({named})")
    dt, first, begun = scene.system.time_step, None, start(scene).now
    if isinstance(prepared, Turns):  # of an integrator that needs the motion one step before
        assert isinstance(prepared.other, Remote)
        first = prepared.other, _rule(IMPLICIT_EULER, dt)
    return Course(
        scene.system, _rule(usual, dt), first, *begun, scene.load, scene.filters, first_guess, scene.pins_at,
        pins_move=bool(scene.moving),
    )  # fmt: skip


def _rule(method: Integrator, dt: float) -> Rule:
    return Rule(*method.weights(dt), method.ahead * dt, method.when)


def seconds(marks: Marks | None) -> dict[str, float]:
    """Columns of a step by events on the stream: of kernels, and of transfers; none of a device without a clock."""
    if marks is None:
        return {}
    copies = marks.began.elapsed_time(marks.up) + marks.done.elapsed_time(marks.down)  # in milliseconds
    return {"kernel_seconds": 1e-3 * marks.up.elapsed_time(marks.done), "transfer_seconds": 1e-3 * copies}


def columns(prepared: Prepared) -> dict[str, Any]:
    """What rows tell of a prepared solver's device, its bandwidth measured now; nothing of one on the processor."""
    if not isinstance(prepared, OnDevice):
        return {}
    return {
        **prepared.usual.columns,
        "through_host": prepared.through_host,
        "device_bandwidth": bandwidth(prepared.usual),
    }


def bandwidth(remote: Remote) -> float | None:
    """Bytes a second that a device reads and writes, the best of a few triads; None where it has no clock or room."""
    found = [tried for tried in (remote.triad() for _ in range(TRIADS)) if tried]
    return max((moved / (1e-3 * began.elapsed_time(ended)) for moved, began, ended in found), default=None)

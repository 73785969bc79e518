"""A process that holds one revision's work and times it when asked: a script, run with the revision's tree on the path.

It speaks JSON, a line a request and a line an answer, by standard input and output; whatever the work prints goes to
standard error. It imports from the tree alone: what is timed is all the revision's own.

    {"do": "runs", "config": "...", "asked": {...}}           -> {"runs": ["cloth 32 numba", ...]}
    {"do": "run", "config": "...", "asked": {...}, "index": i, "frames": n, "extra": 0.0, "positions": "..."}
    {"do": "gates"}                                           -> {"gates": ["numba-against-sparse-64", ...]}
    {"do": "gate", "name": "...", "positions": "..."}         -> {"facts": {...}, "clock": "cpu"}
    {"do": "time", "calls": n, "clock": "cpu"}                -> {"seconds": s}, all calls together
    {"do": "renew"}                                           -> {}, the same work, made anew elsewhere in memory
    {"do": "instructions"}                                    -> {"instructions": n}, null where they are hidden
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

CLOCKS = {"cpu": time.process_time, "wall": time.perf_counter}

ROOM = 2**20
"""Bytes, at most, that move what is made anew."""


class Worker:
    """What is held between two requests."""

    def __init__(self) -> None:
        self._make: Callable[[], Callable[[], Any]] | None = None
        self._work: Callable[[], Any] | None = None
        self._room = bytearray()
        self._threads = ExitStack()

    def runs(self, config: str, asked: dict[str, Any]) -> dict[str, Any]:
        """The runs of a scene or a sweep, in words."""
        return {"runs": [_title(run) for run in _sweep(config, asked)]}

    def run(
        self, config: str, asked: dict[str, Any], index: int, frames: int, extra: float, positions: str
    ) -> dict[str, Any]:
        """Hold the first steps of a run; its facts, and its last positions [m] in a file.

        extra: so much more work than the run asks for, as a part of its iterations: a planted slowdown.
        """
        run = _sweep(config, asked)[index]
        threads = 1 if run.threads == "auto" else run.threads  # idle cores now are not idle cores later
        self._pin(threads)
        frames = min(frames, run.frames)
        steps = self._held(lambda: _Steps(run, frames, extra), positions)
        return {"facts": steps.facts(), "clock": "cpu" if threads == 1 else "wall", "frames": frames}

    def gates(self) -> dict[str, Any]:
        """The names of the tree's own gates."""
        return {"gates": sorted(_gates())}

    def gate(self, name: str, positions: str) -> dict[str, Any]:
        """Hold the candidate of one of the tree's own gates."""
        self._pin(1)
        gate = _gates()[name]
        self._held(gate.candidate, positions)
        return {"facts": {}, "clock": gate.clock}

    def renew(self) -> dict[str, Any]:
        """Make the work anew, while the old still takes its place, behind so much room as chance will have it."""
        assert self._make is not None
        self._room = bytearray(random.randrange(ROOM))
        self._work = self._make()
        return {}

    def time(self, calls: int, clock: str) -> dict[str, Any]:
        """The seconds of so many calls."""
        now, work = CLOCKS[clock], self._work
        assert work is not None
        began = now()
        for _ in range(calls):
            work()
        return {"seconds": now() - began}

    def instructions(self) -> dict[str, Any]:
        """The instructions of one call; the counter is the one beside this script, whatever the tree has."""
        assert self._work is not None
        place = spec_from_file_location("springbench_instructions", Path(__file__).with_name("instructions.py"))
        assert place is not None
        assert place.loader is not None
        counter = module_from_spec(place)
        place.loader.exec_module(counter)
        return {"instructions": counter.count(self._work)}

    def _held(self, make: Callable[[], Any], positions: str) -> Any:
        """The work, done once; its answer is in a file."""
        import numpy as np

        work = make()
        self._make, self._work = make, work
        np.save(positions, np.asarray(work(), float))
        return work

    def _pin(self, threads: int) -> None:
        from harness.base import machine

        self._threads.close()
        self._threads.enter_context(machine.pinned_threads(threads))


class _Steps:
    """The first steps of a run, as often as it is called."""

    def __init__(self, run: Any, frames: int, extra: float) -> None:
        from harness.scenes.bind import build
        from harness.simulation.step import prepare
        from solvers.registry import SOLVERS, load

        self._run, self._frames, self._extra, self._iterations = run, frames, extra, 0
        self._scene = build(run.scene, run.size, run.integrator)
        self._prepared = prepare(self._scene, load(SOLVERS[run.solver.name])(**run.solver.parameters))
        self._stop = _stop(run)

    def __call__(self) -> Any:
        from harness.simulation.step import simulate
        from solvers.problem import StopRule

        self._iterations, step, first_guess = 0, None, self._run.first_guess
        for step in simulate(self._scene, self._prepared, self._stop, first_guess=first_guess, frames=self._frames):
            self._iterations += _iterations(step)
        assert step is not None
        if self._extra:
            self._prepared.solve(step.problem, StopRule(max(1, round(self._extra * self._iterations))))
        return step.positions

    def facts(self) -> dict[str, int]:
        """What the solver counts, and what the last call did."""
        counts = {name: int(value) for name, value in self._prepared.facts.items()}
        return counts | {"iterations": self._iterations, "steps": self._frames}


def _stop(run: Any) -> Any:
    from solvers.problem import StopRule

    if isinstance(run.tolerance, str):  # `auto`, which older revisions do not know
        from harness.simulation.algebraic import stop_rule

        return stop_rule(run.iterations, run.tolerance)
    return StopRule(run.iterations, run.tolerance)


def _sweep(config: str, asked: dict[str, Any]) -> list[Any]:
    from harness.config.load import load_any

    return load_any(Path(config), **asked).runs()


def _iterations(step: Any) -> int:
    """Of a step; older revisions know those of its one unknown."""
    return step.iterations if hasattr(step, "iterations") else step.solution.iterations


def _title(run: Any) -> str:
    """A run in words, the same in both trees."""
    given = [run.solver.name, f"{run.iterations} iterations", run.integrator, f"dt {run.scene.time_step:.4g}"]
    size = [f"size {run.size}"] if run.size else []
    threads = [f"{run.threads} threads"] if run.threads not in (1, "auto") else []
    return ", ".join([run.scene_name, *size, *given, *threads])


def _gates() -> dict[str, Any]:
    import tests.bench.test_gates as listed

    groups: list[tuple[Any, ...]] = [value for value in vars(listed).values() if isinstance(value, tuple)]
    return {gate.name: gate for group in groups for gate in group if hasattr(gate, "candidate")}


def main() -> None:
    """Answer requests until there are no more."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what the work prints must not look like an answer
    worker = Worker()
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            answer = getattr(worker, asked.pop("do"))(**asked)
        except Exception as error:  # it is told, whatever it is: the other side says it in one message
            traceback.print_exc()
            ours = any(base.__name__ == "SpringbenchError" for base in type(error).__mro__)
            answer = {"error": str(error) if ours else f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()

"""Worker script of one revision: prepares its work and times it on request.

It runs with the revision's worktree on the path. It exchanges JSON by standard input and output, one line per request
and per answer. The work prints to standard error. All imports come from the worktree, so that only the revision's own
code is timed.

    {"do": "runs", "config": "...", "asked": {...}}           -> {"runs": ["cloth 32 numba", ...]}
    {"do": "run", "config": "...", "asked": {...}, "index": i, "frames": n, "extra": 0.0, "positions": "..."}
    {"do": "gates"}                                           -> {"gates": ["numba-against-sparse-64", ...]}
    {"do": "gate", "name": "...", "positions": "..."}         -> {"facts": {...}, "clock": "cpu"}
    {"do": "time", "calls": n, "clock": "cpu"}                -> {"seconds": s}, all calls together
    {"do": "renew"}                                           -> {}, the same work, rebuilt at other addresses
    {"do": "instructions"}                                    -> {"instructions": n}, null if they are hidden
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
"""Maximum number of bytes by which rebuilt work is shifted in memory."""


class Worker:
    """Handler of the requests, with the prepared work as its state."""

    def __init__(self) -> None:
        self._make: Callable[[], Callable[[], Any]] | None = None
        self._work: Callable[[], Any] | None = None
        self._room = bytearray()
        self._threads = ExitStack()

    def runs(self, config: str, asked: dict[str, Any]) -> dict[str, Any]:
        """List the runs of a scene or a sweep by their titles."""
        return {"runs": [_title(run) for run in _sweep(config, asked)]}

    def run(
        self, config: str, asked: dict[str, Any], index: int, frames: int, extra: float, positions: str
    ) -> dict[str, Any]:
        """Prepare the first steps of a run, and store its last positions [m].

        Args:
            config: file of the scene or sweep.
            asked: options of the runs.
            index: index of the run.
            frames: maximum number of steps.
            extra: extra work, as a fraction of the run's iterations.
            positions: path of the file.
        Returns: deterministic counts, suitable clock and number of steps.
        """
        run = _sweep(config, asked)[index]
        threads = 1 if run.threads == "auto" else run.threads  # idle cores now are not idle cores later
        self._pin(threads)
        frames = min(frames, run.frames)
        steps = self._held(lambda: _Steps(run, frames, extra), positions)
        return {"facts": steps.facts(), "clock": "cpu" if threads == 1 else "wall", "frames": frames}

    def gates(self) -> dict[str, Any]:
        """List the names of the worktree's own performance tests."""
        return {"gates": sorted(_gates())}

    def gate(self, name: str, positions: str) -> dict[str, Any]:
        """Prepare the candidate of one of the worktree's own performance tests.

        Args:
            name: name of the test.
            positions: path of the file that receives the answer.
        """
        self._pin(1)
        gate = _gates()[name]
        self._held(gate.candidate, positions)
        return {"facts": {}, "clock": gate.clock}

    def renew(self) -> dict[str, Any]:
        """Rebuild the work behind a random offset, while the old work still occupies its memory."""
        assert self._make is not None
        self._room = bytearray(random.randrange(ROOM))
        self._work = self._make()
        return {}

    def time(self, calls: int, clock: str) -> dict[str, Any]:
        """Time a number of calls together.

        Args:
            calls: number of calls.
            clock: cpu or wall.
        """
        now, work = CLOCKS[clock], self._work
        assert work is not None
        began = now()
        for _ in range(calls):
            work()
        return {"seconds": now() - began}

    def instructions(self) -> dict[str, Any]:
        """Count the instructions of one call.

        The counter is the module next to this script, not the worktree's.
        """
        assert self._work is not None
        place = spec_from_file_location("springbench_instructions", Path(__file__).with_name("instructions.py"))
        assert place is not None
        assert place.loader is not None
        counter = module_from_spec(place)
        place.loader.exec_module(counter)
        return {"instructions": counter.count(self._work)}

    def _held(self, make: Callable[[], Any], positions: str) -> Any:
        """Build the work, run it once, and write its answer to a file."""
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
    """The first steps of a run, simulated again by each call."""

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
        """Collect the solver's counts, and those of the last call."""
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
    """Count the iterations of a step; older revisions report them only in the solution."""
    return step.iterations if hasattr(step, "iterations") else step.solution.iterations


def _title(run: Any) -> str:
    """Format the description of a run, which is the same in both worktrees."""
    given = [run.solver.name, f"{run.iterations} iterations", run.integrator, f"dt {run.scene.time_step:.4g}"]
    size = [f"size {run.size}"] if run.size else []
    threads = [f"{run.threads} threads"] if run.threads not in (1, "auto") else []
    return ", ".join([run.scene_name, *size, *given, *threads])


def _gates() -> dict[str, Any]:
    import tests.bench.test_gates as listed

    groups: list[tuple[Any, ...]] = [value for value in vars(listed).values() if isinstance(value, tuple)]
    return {gate.name: gate for group in groups for gate in group if hasattr(gate, "candidate")}


def main() -> None:
    """Answer requests until standard input ends."""
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

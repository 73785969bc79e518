"""Worker script of one revision: prepares its work and times it on request.

It runs with the revision's worktree on the path. It exchanges JSON by standard input and output, one line per request
and per answer. The work prints to standard error. All imports come from the worktree, so that only the revision's own
code is timed.

    {"command": "list_runs", "config": "...", "run_options": {...}}     -> {"runs": ["cloth 32 numba", ...]}
    {"command": "prepare_run", "config": "...", "run_options": {...}, "index": i, "num_frames": n,
     "injected_slowdown": 0.0, "positions": "..."}            -> {"stats": {...}, "clock": "cpu", "num_frames": n}
    {"command": "list_gates"}                                 -> {"gates": ["numba-against-sparse-64", ...]}
    {"command": "prepare_gate", "name": "...", "positions": "..."}      -> {"stats": {...}, "clock": "cpu"},
                                                                           or {"skipped": reason}
    {"command": "time_calls", "num_calls": n, "clock": "cpu"} -> {"seconds": s}, all calls together
    {"command": "rebuild_work"}                               -> {}, the same work, rebuilt at other addresses
    {"command": "count_instructions"}                         -> {"instructions": n}, null if they are hidden
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

CLOCK_FUNCTIONS = {"cpu": time.process_time, "wall": time.perf_counter}

MAX_OFFSET_BYTES = 2**20
"""Maximum number of bytes by which rebuilt work is shifted in memory."""


class RevisionWorker:
    """Handler of the requests, with the prepared work as its state."""

    def __init__(self) -> None:
        self._build_work: Callable[[], Callable[[], Any]] | None = None
        self._work: Callable[[], Any] | None = None
        self._offset_buffer = bytearray()
        self._threads = ExitStack()

    def list_runs(self, config: str, run_options: dict[str, Any]) -> dict[str, Any]:
        """List the runs of a scene or a sweep by their titles.

        Args:
            config: file of the scene or sweep.
            run_options: options of the runs, keyword arguments of `load_config`.

        Returns:
            {"runs": titles}.
        """
        return {"runs": [_format_title(run) for run in _load_runs(config, run_options)]}

    def prepare_run(
        self,
        config: str,
        run_options: dict[str, Any],
        index: int,
        num_frames: int,
        injected_slowdown: float,
        positions: str,
    ) -> dict[str, Any]:
        """Prepare the first steps of a run, and store its last positions [m].

        Args:
            config: file of the scene or sweep.
            run_options: options of the runs.
            index: index of the run.
            num_frames: maximum number of steps.
            injected_slowdown: extra work, as a fraction of the run's iterations.
            positions: path of the file that receives the positions.

        Returns:
            Deterministic counts, suitable clock and number of steps.
        """
        run = _load_runs(config, run_options)[index]
        threads = 1 if run.threads == "auto" else run.threads  # the number of idle cores varies
        self._pin_threads(threads)
        num_frames = min(num_frames, run.frames)
        steps = self._prepare_work(lambda: _RevisionSteps(run, num_frames, injected_slowdown), positions)
        return {"stats": steps.collect_stats(), "clock": "cpu" if threads == 1 else "wall", "num_frames": num_frames}

    def list_gates(self) -> dict[str, Any]:
        """List the names of the worktree's own gates."""
        return {"gates": sorted(_load_gates())}

    def prepare_gate(self, name: str, positions: str) -> dict[str, Any]:
        """Prepare the candidate of one of the worktree's own gates.

        Args:
            name: name of the gate.
            positions: path of the file that receives the answer.
        """
        self._pin_threads(1)
        gate = _load_gates()[name]
        self._prepare_work(gate.candidate, positions)
        return {"stats": {}, "clock": gate.clock}

    def rebuild_work(self) -> dict[str, Any]:
        """Rebuild the work behind a random offset, while the old work still occupies its memory."""
        assert self._build_work is not None
        self._offset_buffer = bytearray(random.randrange(MAX_OFFSET_BYTES))
        self._work = self._build_work()
        return {}

    def time_calls(self, num_calls: int, clock: str) -> dict[str, Any]:
        """Time a number of calls together.

        Args:
            num_calls: number of calls.
            clock: cpu or wall.
        """
        now, work = CLOCK_FUNCTIONS[clock], self._work
        assert work is not None
        start = now()
        for _ in range(num_calls):
            work()
        return {"seconds": now() - start}

    def count_instructions(self) -> dict[str, Any]:
        """Count the instructions of one call.

        The counter is the module next to this script, not the worktree's.
        """
        assert self._work is not None
        spec = spec_from_file_location(
            "springbench_hardware_counters", Path(__file__).with_name("hardware_counters.py")
        )
        assert spec is not None
        assert spec.loader is not None
        counters = module_from_spec(spec)
        spec.loader.exec_module(counters)
        return {"instructions": counters.count_events(self._work)}

    def _prepare_work(self, build_work: Callable[[], Any], positions: str) -> Any:
        """Build the work, run it once, and write its answer to a file."""
        import numpy as np

        work = build_work()
        self._build_work, self._work = build_work, work
        np.save(positions, np.asarray(work(), float))
        return work

    def _pin_threads(self, threads: int) -> None:
        from springbench.harness.execution import machine_info

        self._threads.close()
        self._threads.enter_context(machine_info.limit_threads(threads))


class _RevisionSteps:
    """The first steps of a run, simulated again by each call."""

    def __init__(self, run: Any, frames: int, injected_slowdown: float) -> None:
        from springbench.harness.scenes.scene_builder import build_scene
        from springbench.harness.simulation.auto_tolerance import build_stop_rule
        from springbench.harness.simulation.time_loop import prepare
        from springbench.solvers.registry import SOLVER_TABLE, load_target

        self._run, self._num_frames, self._injected_slowdown, self._iterations = run, frames, injected_slowdown, 0
        self._scene = build_scene(run.scene, run.size, run.integrator)
        self._prepared = prepare(self._scene, load_target(SOLVER_TABLE[run.solver.name])(**run.solver.parameters))
        self._stop = build_stop_rule(run.max_iterations, run.rtol)

    def __call__(self) -> Any:
        from springbench.harness.simulation.time_loop import simulate_scene
        from springbench.solvers.model.step_problem import StopRule

        self._iterations, step = 0, None
        for step in simulate_scene(
            self._scene, self._prepared, self._stop, initial_guess=self._run.initial_guess, frames=self._num_frames
        ):
            self._iterations += step.num_iterations
        assert step is not None
        if self._injected_slowdown:
            self._prepared.solve(step.problem, StopRule(max(1, round(self._injected_slowdown * self._iterations))))
        return step.positions

    def collect_stats(self) -> dict[str, int]:
        """Collect the solver's counts, and those of the last call."""
        counts = {name: int(value) for name, value in self._prepared.stats.items()}
        return counts | {"iterations": self._iterations, "steps": self._num_frames}


def _load_runs(config: str, run_options: dict[str, Any]) -> list[Any]:
    from springbench.harness.config.config_loader import load_config

    return load_config(Path(config), **run_options).list_runs()


def _format_title(run: Any) -> str:
    """Format the description of a run, which is the same in both worktrees."""
    given = [run.solver.name, f"{run.max_iterations} iterations", run.integrator, f"dt {run.scene.time_step:.4g}"]
    size = [f"size {run.size}"] if run.size else []
    threads = [f"{run.threads} threads"] if run.threads not in (1, "auto") else []
    return ", ".join([run.scene_name, *size, *given, *threads])


def _load_gates() -> dict[str, Any]:
    from tests.bench import test_gates

    groups: list[tuple[Any, ...]] = [value for value in vars(test_gates).values() if isinstance(value, tuple)]
    return {gate.name: gate for group in groups for gate in group if hasattr(gate, "candidate")}


def _describe_error(error: Exception) -> str:
    """Describe an error of the worktree's code.

    It may be a name that this script expects and the worktree lacks.
    """
    if any(base.__name__ == "SpringbenchError" for base in type(error).__mro__):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and (error.name or "").startswith("tests"):
        return "there is no tests/bench/test_gates.py, which lists the gates of a checkout"
    frames = [one for one in traceback.extract_tb(error.__traceback__) if one.name != "__getattr__"]
    if frames[-1].filename == __file__ and isinstance(error, AttributeError | ImportError | TypeError):
        return f"it lacks a name that a comparison needs ({error}); choose a revision with the names of this checkout"
    return f"{type(error).__name__}: {error}"


def main() -> None:
    """Answer requests until standard input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what the work prints goes to standard error
    worker = RevisionWorker()
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = getattr(worker, request.pop("command"))(**request)
        except Exception as error:  # of any class: the parent process reports it
            traceback.print_exc()
            answer = {"error": _describe_error(error)}
        except BaseException as outcome:
            if type(outcome).__name__ != "Skipped":  # by `pytest.skip`, where a gate lacks its input
                raise
            answer = {"skipped": str(outcome)}
        answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()

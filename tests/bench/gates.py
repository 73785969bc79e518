"""The gates: what must stay how fast against what. A new gate is one entry of `GATES`.

All work runs with one thread of Numba and one of BLAS, so that CPU times of the process are its durations, and
another program on the machine hardly moves them. Recordings are written by a thread of their own next to the solver's:
what counts there is how long one waits, the wall time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from springbench.harness.experiments.regression.abba_benchmark import ClockName
from springbench.harness.experiments.regression.confidence_sequence import DEFAULT_ALPHA
from springbench.harness.recording.recorder_interface import RecordingInfo
from springbench.harness.recording.rerun_recorder import RerunRecorder
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.instrumentation_pass import RunObservers, observe_run
from springbench.harness.simulation.time_loop import SimulationStep, simulate_scene
from springbench.harness.simulation.timing_pass import SteppingSettings
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solution, StopRule
from springbench.solvers.registry import SOLVERS, load_target

THREADS = 1
STOP = StopRule(max_iterations=50)
Work = Callable[[], Positions]


@dataclass(frozen=True, slots=True)
class Gate:
    """Two makers of work that must come to the same positions, and how their times may compare.

    limit: of time of the candidate / time of the baseline, which must hold on every machine; what becomes slower
    below it `springbench regress --baseline` finds; why: where the limit comes from; guards: the exact gates, tests of
    `test_exact.py`, that see on any machine what would make the candidate slow; clock: what time is, cpu or wall;
    goal: what the ratio is to become where it is not yet: the limit then preserves what has been reached; tolerance:
    the largest difference of the two answers, in their size, None where each maker makes sure of its own; budget:
    seconds until the gate is undecided, --paired-benchmark-budget where it has none; error: the probability of a wrong
    answer; short: whether every run of the CI takes it.
    """

    name: str
    candidate: Callable[[], Work]
    baseline: Callable[[], Work]
    limit: float
    why: str
    guards: tuple[str, ...]
    clock: ClockName = "cpu"
    tolerance: float | None = 0.0
    goal: float | None = None
    budget: float | None = None
    error: float = DEFAULT_ALPHA
    short: bool = False


def sheet(size: int) -> Scene:
    """A cloth with sides and both diagonals, lying flat, that falls about two pinned corners."""
    effects = (SpringsEffect(stretch=1000.0), GravityEffect(), PinsEffect(parts=("top_corners",)))
    spec = SceneSpec(mesh=GridMesh(), mass=1.0, time_step=1 / 30, frames=1, effects=effects, path=Path("sheet.yaml"))
    return build_scene(spec, size)


def prepare(solver: str, scene: Scene, **parameters: str) -> PreparedLocalGlobal:
    """A solver by name, prepared for the scene."""
    return load_target(SOLVERS[solver])(**parameters).prepare(scene.system)


def steps(scene: Scene, prepared: PreparedSolver, frames: int) -> list[SimulationStep]:
    """The scene's first steps."""
    return list(simulate_scene(scene, prepared, STOP, initial_guess="previous", frames=frames))


def build_simulation(solver: str, size: int, frames: int) -> Work:
    """Whole steps through the harness; the last positions [m]."""
    scene = sheet(size)
    prepared = prepare(solver, scene)
    return lambda: last(
        step.solution for step in simulate_scene(scene, prepared, STOP, initial_guess="previous", frames=frames)
    )


def build_solve(solver: str, size: int, frames: int) -> Work:
    """The solver alone, on the problems that the harness states in the same steps; the last positions [m]."""
    scene = sheet(size)
    prepared = prepare(solver, scene)
    problems = [step.problem for step in steps(scene, prepared, frames)]
    return lambda: last(prepared.solve(problem, STOP) for problem in problems)


def last(solutions: Iterable[Solution]) -> Positions:
    """The last solution's positions; the others are let go at once, for new pages of memory take time too."""
    (solution,) = deque(solutions, maxlen=1)
    return solution.positions


def build_projection(solver: str, size: int, repeats: int, **parameters: str) -> Work:
    """The local step alone, at stretched positions; A'K d [N]."""
    scene = sheet(size)
    prepared = prepare(solver, scene, **parameters)
    p = 1.1 * scene.mesh.rest_positions
    nothing, out = np.zeros_like(p), np.empty_like(p)

    def work() -> Positions:
        for _ in range(repeats):
            prepared.local_step(p, nothing, out)
        return out

    return work


def build_recording(solver: str, size: int, frames: int) -> Work:
    """Whole steps, each recorded, to a finished recording; the last positions [m]."""
    scene = sheet(size)
    prepared = prepare(solver, scene)

    folder, numbers = TemporaryDirectory(), count()

    def work() -> Positions:  # to a file of its own: to remove one takes time too, and goes as long as the work
        return record(scene, prepared, frames, Path(folder.name) / f"{next(numbers)}.rrd")

    return work


def record(scene: Scene, prepared: PreparedSolver, frames: int, path: Path) -> Positions:
    """The second pass of a run over the scene's first steps; the last positions [m]."""
    info = RecordingInfo(
        title="sheet",
        run_id="sheet",
        mesh=scene.mesh,
        springs=scene.all_springs.edges,
        rest_lengths=scene.all_springs.rest_length,
        pinned_vertices=scene.system.pins.vertices,
        time_step=scene.system.time_step,
        strain_range=0.1,
        has_self_contact=scene.has_self_contact,
        properties={"scene": "sheet"},
    )
    recorder = RerunRecorder(path, info)
    stored = np.empty((frames, *scene.mesh.rest_positions.shape))
    settings = SteppingSettings(STOP, "previous", frames, 1)
    observe_run(scene, prepared, settings, RunObservers(recorder, positions_out=stored), lambda name: None)
    recorder.finish_recording({})
    return stored[-1]


# Tolerances: the backends add the same numbers in another order.
GATES = (
    Gate(
        short=True,
        name="numba-against-sparse-64",
        candidate=lambda: build_simulation("numba", 64, frames=4),
        baseline=lambda: build_simulation("sparse", 64, frames=4),
        tolerance=1e-9,
        limit=0.3,
        guards=("test_matrices_have_as_many_entries_as_stored", "test_a_tolerance_takes_as_many_iterations_as_stored"),
        why="measured 0.09; its parts, the local step and the solve, take up to 0.26 on other processors",
    ),
    Gate(
        name="sparse-against-dense-24",
        candidate=lambda: build_simulation("sparse", 24, frames=1),
        baseline=lambda: build_simulation("dense", 24, frames=1),
        tolerance=1e-9,
        limit=0.1,
        guards=("test_matrices_have_as_many_entries_as_stored", "test_a_tolerance_takes_as_many_iterations_as_stored"),
        why="measured 0.066 since the dense product takes half as long; half as much again for faster BLAS",
    ),
    Gate(
        short=True,
        name="compiled-local-step-against-numpy-64",
        candidate=lambda: build_projection(
            "numba", 64, repeats=50, linear_solver="cholespy"
        ),  # whose local step can be called
        baseline=lambda: build_projection("sparse", 64, repeats=50),
        tolerance=1e-9,
        limit=0.2,
        guards=("test_a_step_allocates_as_many_arrays_as_stored",),
        why="measured 0.12 with vectors of 512 bits; two thirds as much again without",
    ),
    Gate(
        short=True,
        name="harness-against-bare-solver-64",
        candidate=lambda: build_simulation("numba", 64, frames=20),
        baseline=lambda: build_solve("numba", 64, frames=20),
        limit=1.1,
        goal=1.02,
        guards=("test_a_step_allocates_as_many_arrays_as_stored",),
        why="a promise: stating the problem of a step costs at most 2 % of solving it; measured 1.008 once, and 1.03 "
        "to 1.04 since integrators may have several unknowns",
    ),
    Gate(
        name="recording-against-simulating-alone-64",
        candidate=lambda: build_recording("numba", 64, frames=90),
        baseline=lambda: build_simulation("numba", 64, frames=90),
        limit=1.25,
        goal=1.10,
        guards=("test_a_recording_takes_at_most_20_bytes_a_vertex_and_frame",),
        why="a pass that records was to take at most 10 % more than one that simulates, and did with steps of 4 ms; "
        "today they take 2.9, and to open and close a file takes as long as five; measured 1.17",
        clock="wall",
    ),
)

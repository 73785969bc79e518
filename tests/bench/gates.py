"""Define the gates, which compare the time of a candidate with that of a baseline; a new gate is one entry of `GATES`.

    pytest tests/bench --benchmark-only

All work runs with one thread of Numba and one of BLAS, so that CPU time measures its duration and other programs on the
machine have little effect. Recordings are written by a separate thread, next to that of the solver: wall time measures
their duration.
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
    """Two builders of work that computes the same positions, and the limit of the ratio of their times.

    limit: largest ratio of the candidate's time to the baseline's on every machine; `springbench regress --baseline`
    detects smaller slowdowns; why: reason of the limit; guards: exact gates, tests of `test_exact.py`, that detect on
    any machine what would slow down the candidate; clock: cpu or wall; goal: target of the ratio where it is not
    reached: the limit then preserves the present ratio; tolerance: largest relative difference of the two results, None
    if each builder checks its own; budget: seconds until the verdict is inconclusive, --paired-benchmark-budget if
    None; error: probability of a wrong verdict; short: whether it belongs to the short set, which the CI runs.
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


def build_sheet(size: int) -> Scene:
    """Build a flat cloth of springs along sides and both diagonals, which swings down from two pinned corners."""
    effects = (SpringsEffect(stretch=1000.0), GravityEffect(), PinsEffect(parts=("top_corners",)))
    spec = SceneSpec(mesh=GridMesh(), mass=1.0, time_step=1 / 30, frames=1, effects=effects, path=Path("sheet.yaml"))
    return build_scene(spec, size)


def prepare_solver(solver: str, scene: Scene, **parameters: str) -> PreparedLocalGlobal:
    """Prepare a solver by name for a scene."""
    return load_target(SOLVERS[solver])(**parameters).prepare(scene.system)


def simulate_steps(scene: Scene, prepared: PreparedSolver, frames: int) -> list[SimulationStep]:
    """Simulate the first steps of a scene."""
    return list(simulate_scene(scene, prepared, STOP, initial_guess="previous", frames=frames))


def build_simulation(solver: str, size: int, frames: int) -> Work:
    """Build work that computes steps through the harness, and returns the last positions (n, 3) [m]."""
    scene = build_sheet(size)
    prepared = prepare_solver(solver, scene)
    return lambda: get_last_positions(
        step.solution for step in simulate_scene(scene, prepared, STOP, initial_guess="previous", frames=frames)
    )


def build_solve(solver: str, size: int, frames: int) -> Work:
    """Build work that solves the problems of the same steps without the harness; last positions (n, 3) [m]."""
    scene = build_sheet(size)
    prepared = prepare_solver(solver, scene)
    problems = [step.problem for step in simulate_steps(scene, prepared, frames)]
    return lambda: get_last_positions(prepared.solve(problem, STOP) for problem in problems)


def get_last_positions(solutions: Iterable[Solution]) -> Positions:
    """Return the positions of the last solution; the others are freed at once, since new memory pages take time."""
    (solution,) = deque(solutions, maxlen=1)
    return solution.positions


def build_projection(solver: str, size: int, repeats: int, **parameters: str) -> Work:
    """Build work that computes the local step alone, at stretched positions, and returns A'K d (n, 3) [N]."""
    scene = build_sheet(size)
    prepared = prepare_solver(solver, scene, **parameters)
    p = 1.1 * scene.mesh.rest_positions
    zero_load, out = np.zeros_like(p), np.empty_like(p)

    def work() -> Positions:
        for _ in range(repeats):
            prepared.local_step(p, zero_load, out)
        return out

    return work


def build_recording(solver: str, size: int, frames: int) -> Work:
    """Build work that computes steps and writes a recording of them, and returns the last positions (n, 3) [m]."""
    scene = build_sheet(size)
    prepared = prepare_solver(solver, scene)

    folder, numbers = TemporaryDirectory(), count()

    def work() -> Positions:  # each call writes a new file, since to delete one takes time as well
        return record_steps(scene, prepared, frames, Path(folder.name) / f"{next(numbers)}.rrd")

    return work


def record_steps(scene: Scene, prepared: PreparedSolver, frames: int, path: Path) -> Positions:
    """Run the instrumentation pass over the first steps of a scene, and return the last positions (n, 3) [m]."""
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


# The tolerances allow for sums in a different order by the backends.
GATES = (
    Gate(
        short=True,
        name="numba-against-sparse-64",
        candidate=lambda: build_simulation("numba", 64, frames=4),
        baseline=lambda: build_simulation("sparse", 64, frames=4),
        tolerance=1e-9,
        limit=0.3,
        guards=("test_matrices_have_as_many_entries_as_stored", "test_a_tolerance_takes_as_many_iterations_as_stored"),
        why="measured 0.09; its parts, the local step and the solve, have ratios of up to 0.26 on other processors",
    ),
    Gate(
        name="sparse-against-dense-24",
        candidate=lambda: build_simulation("sparse", 24, frames=1),
        baseline=lambda: build_simulation("dense", 24, frames=1),
        tolerance=1e-9,
        limit=0.1,
        guards=("test_matrices_have_as_many_entries_as_stored", "test_a_tolerance_takes_as_many_iterations_as_stored"),
        why="measured 0.066 with the present dense product; half of that is a margin for a faster BLAS",
    ),
    Gate(
        short=True,
        name="compiled-local-step-against-numpy-64",
        candidate=lambda: build_projection(
            "numba", 64, repeats=50, linear_solver="cholespy"
        ),  # with this linear solver the local step is callable
        baseline=lambda: build_projection("sparse", 64, repeats=50),
        tolerance=1e-9,
        limit=0.2,
        guards=("test_a_step_allocates_as_many_arrays_as_stored",),
        why="measured 0.12 with vectors of 512 bits; two thirds of that is a margin for processors without",
    ),
    Gate(
        short=True,
        name="harness-against-bare-solver-64",
        candidate=lambda: build_simulation("numba", 64, frames=20),
        baseline=lambda: build_solve("numba", 64, frames=20),
        limit=1.1,
        goal=1.02,
        guards=("test_a_step_allocates_as_many_arrays_as_stored",),
        why="a target: to build the problem of a step takes at most 2 % of the time to solve it; measured 1.03 to 1.04 "
        "with support for integrators of several stages, 1.008 without",
    ),
    Gate(
        name="recording-against-simulating-alone-64",
        candidate=lambda: build_recording("numba", 64, frames=90),
        baseline=lambda: build_simulation("numba", 64, frames=90),
        limit=1.25,
        goal=1.10,
        guards=("test_a_recording_takes_at_most_20_bytes_a_vertex_and_frame",),
        why="a target: a pass that records takes at most 10 % longer than one that simulates; measured 1.17 with steps "
        "of 2.9 ms, where opening and closing the file takes the time of five steps",
        clock="wall",
    ),
)

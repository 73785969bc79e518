"""Exact gates on deterministic counts: entries of matrices, iterations, flops, bytes, allocations and instructions.

They belong to every test run, and each timed gate names those that guard it. If a new library or a better method
changes a number, the commit that changes it stores the new one here.
"""

import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.regression import hardware_counters
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, simulate_scene
from springbench.solvers.iteration.descent_method import PreparedDescent
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.contact import FAR, build_fall
from tests.bench.gates import STOP, THREADS, build_sheet, build_simulation, prepare_solver, record_steps, simulate_steps
from tests.bench.solves import build_system_matrix
from tests.scene_builders import SCENE_BUILDERS


@pytest.mark.parametrize(
    ("solver", "size", "system", "factor"),
    [
        ("dense", 16, 2_116, 32_896),  # the triangle of a dense factor: 256 * 257 / 2
        ("sparse", 16, 2_116, 3_309),
        ("sparse", 32, 8_836, 19_816),
        ("sparse", 64, 36_100, 111_253),
        ("numba", 64, 36_100, 103_273),
    ],
)
def test_matrices_have_as_many_entries_as_stored(solver: str, size: int, system: int, factor: int):
    scene = build_sheet(size)
    stats = prepare_solver(solver, scene).stats
    # Q has an entry for each vertex and two for each spring; the number of the factor depends on the ordering.
    assert system == len(scene.mesh.rest_positions) + 2 * len(scene.mesh.springs)
    assert (stats["nnz_system"], stats["nnz_factor"]) == (system, factor)


@pytest.mark.parametrize(
    ("scene", "nonzeros", "factor_bytes", "flops"),
    [
        (build_sheet(32), 19_161, 303_104, 367_392),
        (build_sheet(64), 103_273, 1_426_432, 1_802_400),
        (build_sheet(128), 527_787, 6_629_888, 8_609_952),
        (SCENE_BUILDERS["block"](1e10), 6_157, 73_728, 94_752),
        (SCENE_BUILDERS["skirt"](1e10), 5_150, 84_992, 101_568),
    ],
    ids=["sheet 32", "sheet 64", "sheet 128", "block", "skirt"],
)
def test_a_supernodal_factor_is_as_large_as_stored(scene: Scene, nonzeros: int, factor_bytes: int, flops: int):
    factor = SupernodalCholesky(build_system_matrix(scene))
    assert (factor.nonzeros, factor.factor_bytes, factor.flops) == (nonzeros, factor_bytes, flops)
    # Half of the precision takes half of the bytes, and the same number of operations.
    single = SupernodalCholesky(build_system_matrix(scene), precision="float32")
    assert (single.factor_bytes, single.flops) == (factor_bytes // 2, flops)


@pytest.mark.parametrize("solver", ["dense", "sparse", "numba"])
@pytest.mark.parametrize(("size", "iterations"), [(8, [542, 504]), (16, [506, 613])])
def test_a_tolerance_takes_as_many_iterations_as_stored(solver: str, size: int, iterations: list[int]):
    scene = build_sheet(size)
    stop = StopRule(max_iterations=1000, rtol=1e-3)
    with limit_threads(THREADS):  # a second thread slows down dense products of this size
        steps = list(simulate_scene(scene, prepare_solver(solver, scene), stop, initial_guess="previous", frames=2))
    # An iteration changes the residual by 0.1 to 1 %, and round-off by 1e-9: all machines need the same number.
    assert [step.solution.num_iterations for step in steps] == iterations
    assert {step.solution.termination_reason for step in steps} == {"converged"}


def test_a_recording_takes_at_most_20_bytes_a_vertex_and_frame(tmp_path: Path):
    scene, frames = build_sheet(64), (20, 60)
    prepared = prepare_solver("numba", scene)
    sizes = []
    for count in frames:
        path = tmp_path / f"{count}.rrd"
        record_steps(scene, prepared, count, path)
        sizes.append(path.stat().st_size)
    # The difference excludes data that is written once. Every 40th frame has springs, so 40 frames are a cycle.
    per_vertex = (sizes[1] - sizes[0]) / (frames[1] - frames[0]) / len(scene.mesh.rest_positions)
    assert per_vertex <= 20.0
    # The compressed size depends slightly on round-off in the positions and on the version of the library.
    assert per_vertex == pytest.approx(16.3, rel=0.03)


@pytest.mark.parametrize(
    ("solver", "size", "iterations", "factorisations"),
    [
        ("newton", 16, [6, 5, 5], 19.0),
        ("newton", 32, [8, 21, 11], 51.6),
        ("hybrid", 16, [38, 34, 40], 3.0),
        ("hybrid", 32, [27], 2.0),
    ],
)
def test_an_accuracy_takes_as_many_iterations_as_stored(
    solver: str, size: int, iterations: list[int], factorisations: float
):
    scene, stop = build_sheet(size), StopRule(max_iterations=1000, rtol=1e-6)
    with limit_threads(THREADS):
        prepared = load_target(SOLVERS[solver])().prepare(scene.system)
        found = list(simulate_scene(scene, prepared, stop, initial_guess="previous", frames=len(iterations)))
    assert {step.solution.termination_reason for step in found} == {"converged"}
    # Newton's method converges quadratically, so that round-off does not change the counts. The hybrid begins with
    # L-BFGS, in float32 unless the mesh is small. On another processor each phase of L-BFGS may end an iteration
    # earlier or later, and after a first step in float32 the next ones may take another path. A Newton step that this
    # adds needs a factorisation, or several if the Hessian is indefinite.
    margin, more = (0, 1e-9) if solver == "newton" else (2, 6.0)
    assert [step.solution.num_iterations for step in found] == pytest.approx(iterations, abs=margin)
    assert isinstance(prepared, PreparedDescent)
    counted = prepared.fixed_objective.hessian_matrix.factor.num_factorisations  # one that fails counts as a part
    assert counted == pytest.approx(factorisations, abs=more)


def measure_peak_bytes(work: Callable[[], object]) -> int:
    """Return the peak of allocated bytes in a call by Python's allocators, after a warm-up call."""
    work()
    gc.collect()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        work()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


def count_arrays(work: Callable[[], object], size: int) -> int:
    """Return the peak of allocated memory in arrays of the sheet's positions; Python itself uses less than a half."""
    return round(measure_peak_bytes(work) / (24 * size**2))


@pytest.mark.parametrize(("solver", "in_problem", "in_solve", "in_step"), [("sparse", 3, 15, 18), ("numba", 3, 2, 6)])
def test_a_step_allocates_as_many_arrays_as_stored(solver: str, in_problem: int, in_solve: int, in_step: int):
    scene = build_sheet(64)
    prepared = prepare_solver(solver, scene)
    problem = build_problem(scene, build_initial_state(scene), "previous")
    assert count_arrays(lambda: build_problem(scene, build_initial_state(scene), "previous"), 64) == in_problem
    assert count_arrays(lambda: prepared.solve(problem, STOP), 64) == in_solve
    assert count_arrays(lambda: simulate_steps(scene, prepared, 1), 64) == in_step


def test_idle_contact_allocates_no_array_more():
    assert count_arrays(build_fall(FAR, size=64, frames=3), 64) == count_arrays(build_fall(size=64, frames=3), 64)


@pytest.mark.parametrize(("solver", "frames"), [("numba", 4), ("sparse", 2)])
def test_the_same_work_retires_the_same_instructions(solver: str, frames: int):
    work = build_simulation(solver, 16, frames)
    with limit_threads(THREADS):
        work()
        first, second = hardware_counters.count_events(work), hardware_counters.count_events(work)
    if first is None or second is None:
        # A virtual machine may hide the counter, or the kernel may deny access to it.
        assert hardware_counters.explain_unavailable()
    else:
        # The interpreter adds occasional work, such as garbage collection.
        assert second == pytest.approx(first, rel=1e-3)

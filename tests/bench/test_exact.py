"""Gates on counts, which no noise can move: entries of matrices, iterations, bytes. They run in every test run.

A number that changes with a new library or a better method is stored anew here, in the commit that changes it.
"""

from pathlib import Path

import pytest

from harness.base.machine import pinned_threads
from harness.scenes.bind import Scene
from harness.simulation.step import simulate
from solvers.linear.supernodal import Supernodal
from solvers.problem import StopRule
from tests.bench.gates import THREADS, prepare, record, sheet
from tests.bench.solves import system_matrix
from tests.scenes import SCENES


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
    scene = sheet(size)
    facts = prepare(solver, scene).facts
    # Q has an entry for each vertex and two for each spring; the factor's number is that of the ordering.
    assert system == len(scene.mesh.rest) + 2 * len(scene.mesh.springs)
    assert (facts["nnz_system"], facts["nnz_factor"]) == (system, factor)


@pytest.mark.parametrize(
    ("scene", "nonzeros", "panel_bytes", "flops"),
    [
        (sheet(32), 19_161, 303_104, 367_392),
        (sheet(64), 103_273, 1_426_432, 1_802_400),
        (sheet(128), 527_787, 6_629_888, 8_609_952),
        (SCENES["block"](1e10), 6_157, 73_728, 94_752),
        (SCENES["skirt"](1e10), 5_150, 84_992, 101_568),
    ],
    ids=["sheet 32", "sheet 64", "sheet 128", "block", "skirt"],
)
def test_a_supernodal_factor_is_as_large_as_stored(scene: Scene, nonzeros: int, panel_bytes: int, flops: int):
    factor = Supernodal(system_matrix(scene))
    assert (factor.nonzeros, factor.panel_bytes, factor.flops) == (nonzeros, panel_bytes, flops)
    # Half of the bytes for half of the precision; the work is the same.
    single = Supernodal(system_matrix(scene), precision="float32")
    assert (single.panel_bytes, single.flops) == (panel_bytes // 2, flops)


@pytest.mark.parametrize("solver", ["dense", "sparse", "numba"])
@pytest.mark.parametrize(("size", "iterations"), [(8, [542, 504]), (16, [506, 613])])
def test_a_tolerance_takes_as_many_iterations_as_stored(solver: str, size: int, iterations: list[int]):
    scene = sheet(size)
    stop = StopRule(iterations=1000, tolerance=1e-3)
    with pinned_threads(THREADS):  # dense products of this size lose more by a second thread than they gain
        steps = list(simulate(scene, prepare(solver, scene), stop, first_guess="current", frames=2))
    # Here an iteration changes the residual by 0.1 to 1 %, round-off by 1e-9: the number is the same everywhere.
    assert [step.solution.iterations for step in steps] == iterations
    assert {step.solution.stopped for step in steps} == {"tolerance"}


def test_a_recording_takes_at_most_20_bytes_a_vertex_and_frame(tmp_path: Path):
    scene, frames = sheet(64), (20, 60)
    prepared = prepare("numba", scene)
    sizes = []
    for count in frames:
        path = tmp_path / f"{count}.rrd"
        record(scene, prepared, count, path)
        sizes.append(path.stat().st_size)
    # The difference leaves out what is written once. Springs are in every 40th frame, so 40 frames are a cycle.
    per_vertex = (sizes[1] - sizes[0]) / (frames[1] - frames[0]) / len(scene.mesh.rest)
    assert per_vertex <= 20.0
    # The compressed size depends a little on the last bits of the positions and on the library's version.
    assert per_vertex == pytest.approx(15.6, rel=0.03)

"""What would not fit in memory is refused with its size before it is begun: meshes, dense matrices, factors."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.cli.main import app
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh, NetMesh
from springbench.harness.scenes.mesh.mesh_generator import MeshGenerator
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh, TowerMesh
from springbench.harness.scenes.mesh.star_mesh import StarMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh, SkirtMesh
from springbench.solvers.linalg import memory
from springbench.solvers.linalg.solver_selection import build_linear_solver
from springbench.solvers.methods.local_global.reference_local_global import DenseLocalGlobal
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Solver, Unsupported
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix
from typer.testing import CliRunner

from tests.network_matrices import grid_matrix
from tests.scene_builders import build_test_scene

GIB = 2.0**30
SCENE = """
mesh: {{kind: {kind}}}
mass: 1
time_step: 1/30
frames: 1
default_size: {size}
effects: [{{kind: springs, stretch: 10}}, {{kind: gravity}}]
"""
LARGE = {
    ("grid", 20_000): ("400,000,000 vertices", "414 GiB"),
    ("grid", 2_237): ("5,004,169 vertices", "5.17 GiB"),
    ("net", 1_582): ("5,002,285 vertices", "2.94 GiB"),
    ("block", 10_000): ("250,100,010,000 vertices", "705,759 GiB"),
    ("block", 271): ("5,012,416 vertices", "14.1 GiB"),
}
"""Sizes and what they would give, and take; the least of them are just beyond what any machine may do."""


@pytest.fixture
def none_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    def generate(self: MeshGenerator, size: int) -> None:
        raise AssertionError("the mesh is built")

    for kind in (GridMesh, NetMesh, BlockMesh):
        monkeypatch.setattr(kind, "generate_mesh", generate)


def refusal(config: Path, command: str) -> str:
    answer = CliRunner().invoke(app, [command, str(config), "--results", str(config.parent / "results")])
    assert answer.exit_code == 2, (answer.output, answer.exception)
    assert not (config.parent / "results").exists()
    return answer.output


@pytest.mark.usefixtures("none_is_built")
@pytest.mark.parametrize("command", ["run", "list", "ablate"])
@pytest.mark.parametrize(("kind", "size"), LARGE)
def test_a_mesh_too_large_is_refused_with_what_it_would_take(tmp_path: Path, kind: str, size: int, command: str):
    config = tmp_path / "large.yaml"
    config.write_text(SCENE.format(kind=kind, size=size))
    said = refusal(config, command)
    for needle in (str(config), "size", str(size), *LARGE[kind, size]):
        assert needle in said


@pytest.mark.usefixtures("none_is_built")
def test_a_size_within_the_limit_is_refused_by_a_machine_that_is_too_small_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """4,999,696 vertices, just below the largest number of all."""
    config = tmp_path / "large.yaml"
    config.write_text(SCENE.format(kind="grid", size=2_236))
    monkeypatch.setattr(memory, "compute_memory_limit", lambda: 4.0 * GIB)
    said = refusal(config, "list")
    for needle in ("4,999,696 vertices of at most 3,869,339", "5.17 GiB", "4 GiB may be taken"):
        assert needle in said
    monkeypatch.setattr(memory, "compute_memory_limit", lambda: 6.0 * GIB)
    GridMesh().check_size(2_236)
    with pytest.raises(InputError, match="allowed for grid: 2 to 2236 "):
        GridMesh().check_size(2_237)


@pytest.mark.parametrize(
    ("mesh", "size"),
    [
        (ChainMesh(), 5_000),
        (StarMesh(), 5_000),
        (NetMesh(), 50),
        (GridMesh(), 70),
        (SkirtMesh(), 110),
        (BalloonMesh(), 20),
        (TowerMesh(), 300),
        (BlockMesh(), 16),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_mesh_takes_what_was_estimated(mesh: MeshGenerator, size: int):
    """With its springs and Q, counted as they are made. Small meshes have fewer springs a vertex than large ones."""
    estimate = mesh.count_vertices(size) * mesh._vertex_bytes
    tracemalloc.start()
    try:
        made = build_test_scene(
            mesh,
            SpringsEffect(stretch=10.0, shear=0.0 if mesh.SPRINGS_PER_VERTEX < 3 else 5.0),
            GravityEffect(),
            size=size,
        )
        assemble_system_matrix(made.system, [made.all_springs])
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.5 * estimate <= peak <= 1.1 * estimate


@pytest.mark.parametrize("solver", [DenseLocalGlobal()], ids=repr)
def test_dense_matrices_are_refused_at_200_vertices_a_side(solver: Solver, monkeypatch: pytest.MonkeyPatch):
    system = build_test_scene(GridMesh(), SpringsEffect(stretch=10.0, shear=2.0), size=200).system
    monkeypatch.setattr(memory, "compute_memory_limit", lambda: 64.0 * GIB)
    with pytest.raises(Unsupported, match=r"40,000 vertices and 158,802 springs take 178 GiB .* 64 GiB may be taken"):
        solver.prepare(system)


@pytest.mark.parametrize("solver", [NewtonSolver(), HybridNewton()], ids=repr)
def test_a_hessians_factor_that_does_not_fit_is_refused(solver: Solver, monkeypatch: pytest.MonkeyPatch):
    """Nine times the entries of Q's, which fits."""
    system = build_test_scene(GridMesh(), SpringsEffect(stretch=10.0, shear=2.0), size=40).system
    monkeypatch.setattr(memory, "compute_memory_limit", lambda: 4.0 * 2**20)
    with pytest.raises(Unsupported, match=r"factor of the Hessian has [\d,]+ entries and takes [\d.]+ MiB .* 4 MiB"):
        solver.prepare(system)


def test_a_matrix_too_large_for_every_linear_solver_is_refused_with_the_memory_that_each_needs():
    with pytest.raises(
        Unsupported, match=r"does not fit in 100 KiB of memory: supernodal needs [\d.]+ MiB .* cg needs"
    ):
        build_linear_solver(grid_matrix(40, 40), memory_limit=100.0 * 2**10)


def test_bytes_are_printed_in_words():
    assert [memory.format_bytes(n) for n in (0, 1023, 1024, 3.5 * 2**20, 2.0**30, 3.0 * 2**50)] == [
        "0 bytes",
        "1,023 bytes",
        "1 KiB",
        "3.5 MiB",
        "1 GiB",
        "3,145,728 GiB",
    ]
    assert np.isfinite(memory.compute_memory_limit())

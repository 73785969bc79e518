"""Outside engines: the same network, their own steps; refusals by name, and scripts that repeat a point without us."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from springbench.harness.cli.commands.export_script import write_engine_script
from springbench.harness.cli.main import app
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.experiments.provenance import build_provenance_columns
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import build_initial_state, build_problem
from springbench.solvers.external import external_engine
from springbench.solvers.external.external_engine import ExternalEngine, PreparedEngine
from springbench.solvers.external.mujoco_engine import build_mjcf
from springbench.solvers.methods.position_based.xpbd import XpbdSmallSteps
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule, System, Unsupported
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, find_solver_info, is_minimiser, load_target
from typer.testing import CliRunner

from tests.scene_builders import build_random_problem

ENGINES = [
    name for name, target in OPTIONAL_SOLVERS.items() if find_solver_info(load_target(target), name).package_name
]
engines = pytest.mark.parametrize("name", ENGINES)

CONFIG = """
scenes: [net.yaml]
solvers: [newton, {engine}]
work: [{{size: 3, t_end: 0.1, integrator: substepping, max_iterations: 20}}]
"""
NET = """
mesh: {kind: net, width: 2.0, height: 2.0}
mass: 2.0
time_step: 1/30
frames: 3
effects: [{kind: springs, stretch: 300}, {kind: gravity}, {kind: pins, parts: [corners]}]
"""


def build_engine_scene(
    *effects: Any, mesh: Any = None, size: int = 4, integrator: str = "substepping", **given: Any
) -> Scene:
    path = Path("scene.yaml")
    spec = SceneSpec(mesh=mesh or GridMesh(), mass=1.0, time_step=1 / 30, frames=1, effects=effects, path=path, **given)
    return build_scene(spec, size, integrator)


HANGING = (
    SpringsEffect(stretch=300.0, shear=60.0),
    GravityEffect(),
    PinsEffect.model_validate({"parts": ["top_corners"]}),
)


def ready(name: str, system: System, **parameters: Any) -> PreparedEngine:
    """The engine; where it is not installed it says which command does so, and there is nothing to try."""
    engine: ExternalEngine = load_target(OPTIONAL_SOLVERS[name])(**parameters)
    try:
        engine.engine_package.import_library(name)
    except Unsupported as error:
        pytest.skip(str(error))
    return engine.prepare(system)


def falling(problem: StepProblem) -> StepProblem:
    """The same with the weight of gravity for a load, and at rest."""
    s = problem.system
    begun = replace(
        problem.step_start, positions=problem.current_positions, velocity=np.zeros_like(problem.current_positions)
    )
    return replace(problem, external_force=s.mass[:, None] * np.array([0.0, -9.81, 0.0]), step_start=begun)


@engines
def test_an_engine_that_is_not_installed_gives_the_command_to_install_it_as_reason(
    name: str, monkeypatch: pytest.MonkeyPatch
):
    def none(module: str) -> None:
        raise ModuleNotFoundError(f"No module named {module!r}")

    monkeypatch.setattr(external_engine, "import_module", none)
    engine = load_target(OPTIONAL_SOLVERS[name])()
    expected = rf"^{name}: .*pip install -e '\.\[{engine.engine_package.extra_name}\]'` in the checkout"
    with pytest.raises(Unsupported, match=expected):
        engine.prepare(build_engine_scene(*HANGING).system)


@engines
def test_an_engine_refuses_unsupported_effects_by_name(name: str):
    engine = load_target(OPTIONAL_SOLVERS[name])()
    assert not is_minimiser(engine)
    with pytest.raises(Unsupported, match=rf"^{name}: expresses springs.* the scene has \w*Bending\w* as well"):
        engine.prepare(build_engine_scene(*HANGING, BendingEffect(stiffness=1e-3)).system)
    with pytest.raises(Unsupported, match=f"{name}: divides the step itself"):
        engine.prepare(build_engine_scene(*HANGING, integrator="bdf2").system)


def test_drag_that_an_engine_does_not_have_is_refused():
    with pytest.raises(Unsupported, match="pypbd: expresses springs; the scene has EtherDrag as well"):
        load_target(OPTIONAL_SOLVERS["pypbd"])().prepare(
            build_engine_scene(*HANGING, EtherDragEffect(decay_rate=1.0)).system
        )


def semi_implicit(scene: Scene, stated: StepProblem, substeps: int, damping: float) -> tuple[Positions, Positions]:
    """v <- v + h M^-1 (f - grad E) on what is not pinned, p <- p + h v."""
    s, h = scene.system, scene.system.time_step / substeps
    p, v = stated.step_start.positions.copy(), np.where(s.unpinned_mask[:, None], stated.step_start.velocity, 0.0)
    for _ in range(substeps):
        force = stated.external_force.copy()
        for edge, r, k in zip(
            scene.all_springs.edges, scene.all_springs.rest_length, scene.all_springs.stiffness, strict=True
        ):
            i, j = edge
            away = p[i] - p[j]
            length = float(np.linalg.norm(away))
            n = away / length
            pull = (k * (length - r) + damping * n @ (v[i] - v[j])) * n
            force[i] -= pull
            force[j] += pull
        v[s.unpinned_mask] += h * force[s.unpinned_mask] / s.mass[s.unpinned_mask, None]
        p[s.unpinned_mask] += h * v[s.unpinned_mask]
    return p, v


@pytest.mark.parametrize(("integrator", "damping"), [("Euler", 0.5), ("implicitfast", 0.0), ("implicit", 0.0)])
def test_mujoco_steps_a_network_as_documented(integrator: str, damping: float):
    parts = (
        SpringsEffect(scaling_rule="fixed", stretch=300.0),
        DashpotsEffect(scaling_rule="fixed", stretch=damping),
        GravityEffect(),
        HANGING[2],
    )
    scene = build_engine_scene(*parts, size=3, velocity=(0.3, 0.0, -0.2))
    stated = build_problem(scene, build_initial_state(scene), "previous")
    wind = replace(
        stated, external_force=stated.external_force + np.random.default_rng(0).normal(size=stated.external_force.shape)
    )
    prepared = ready("mujoco", scene.system, mujoco_integrator=integrator)
    for one in stated, wind:
        found = prepared.solve(one, StopRule(20))
        p, v = semi_implicit(scene, one, 20, damping)
        free = scene.system.unpinned_mask
        # Two ways to add the same terms, twenty times.
        np.testing.assert_allclose(found.positions[free], p[free], rtol=0, atol=1e-12)
        assert found.velocity is not None
        np.testing.assert_allclose(found.velocity[free], v[free], rtol=0, atol=1e-10)


def test_the_drag_that_mujoco_takes_is_that_of_the_scene():
    scene = build_engine_scene(
        GravityEffect(), EtherDragEffect(decay_rate=2.0), HANGING[2], size=3, velocity=(1.0, 0.0, 0.0)
    )
    found = ready("mujoco", scene.system).solve(
        build_problem(scene, build_initial_state(scene), "previous"), StopRule(400)
    )
    free = scene.system.unpinned_mask
    assert found.velocity is not None
    # v' = g - c v; steps of 1/400 of a frame are of order 1.
    np.testing.assert_allclose(found.velocity[free, 0], np.exp(-2.0 / 30), rtol=1e-4)


@pytest.mark.parametrize("substeps", [1, 7])
def test_pypbd_moves_one_spring_as_xpbd_in_small_steps_does(substeps: int):
    pins = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
    scene = build_engine_scene(SpringsEffect(stretch=500.0), GravityEffect(), pins, mesh=ChainMesh(), size=2)
    stated = build_problem(scene, build_initial_state(scene), "previous")
    found = ready("pypbd", scene.system).solve(stated, StopRule(substeps))
    expected = XpbdSmallSteps().prepare(scene.system).solve(stated, StopRule(substeps))
    # It may compute in single precision.
    np.testing.assert_allclose(found.positions, expected.positions, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("parameters", "substeps", "expected"),
    [
        ({"newton_solver": "vbd", "iterations_per_substep": 300}, 1, "converged"),
        ({"newton_solver": "semi-implicit"}, 20, "semi-implicit"),
        ({"newton_solver": "xpbd", "iterations_per_substep": 1}, 7, "xpbd"),
    ],
)
def test_newton_physics_steps_springs_by_the_formulas_of_its_methods(
    parameters: dict[str, Any], substeps: int, expected: str
):
    pins = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
    size, velocity = (2 if expected == "xpbd" else 4), (0.3, 0.1, -0.2)  # its XPBD moves along all springs at once
    effects = SpringsEffect(stretch=500.0), GravityEffect(), pins
    scene = build_engine_scene(*effects, mesh=ChainMesh(), size=size, velocity=velocity)
    stated = build_problem(scene, build_initial_state(scene), "previous")
    found = ready("newton-physics", scene.system, **parameters).solve(stated, StopRule(substeps)).positions
    if expected == "semi-implicit":
        should = semi_implicit(scene, stated, substeps, damping=0.0)[0]
    elif expected == "xpbd":
        should = XpbdSmallSteps().prepare(scene.system).solve(stated, StopRule(substeps)).positions
    else:
        same = build_engine_scene(*effects, mesh=ChainMesh(), size=size, velocity=velocity, integrator="implicit-euler")
        step = build_problem(same, build_initial_state(same), "previous")
        should = load_target(SOLVERS["newton"])().prepare(same.system).solve(step, StopRule(100, 1e-12)).positions
    assert np.abs(found - stated.current_positions).max() > 100 * 2e-6
    np.testing.assert_allclose(found, should, rtol=0, atol=2e-6)  # float32


def test_the_program_in_taichi_minimises_the_step_and_one_iteration_is_the_linearised_step():
    effects = HANGING[:2], PinsEffect.model_validate({"parts": ["top_corners"], "weight": "exact"})
    scene = build_engine_scene(*effects[0], effects[1], velocity=(0.3, 0.1, -0.2))
    stated = build_problem(scene, build_initial_state(scene), "previous")
    found = ready("taichi", scene.system, iterations_per_substep=30, cg_rtol=1e-9).solve(stated, StopRule(1)).positions
    same = build_engine_scene(*effects[0], effects[1], velocity=(0.3, 0.1, -0.2), integrator="implicit-euler")
    should = (
        load_target(SOLVERS["newton"])()
        .prepare(same.system)
        .solve(build_problem(same, build_initial_state(same), "previous"), StopRule(100, 1e-12))
    )
    np.testing.assert_allclose(found, should.positions, rtol=0, atol=1e-9)
    once = ready("taichi", scene.system, iterations_per_substep=1).solve(stated, StopRule(1)).positions
    assert (
        1e-6 < np.abs(once - should.positions).max() < 0.3 * np.abs(should.positions - stated.current_positions).max()
    )


def test_all_of_a_net_is_one_colour_to_newton_physics_which_sees_no_springs():
    ready("newton-physics", build_engine_scene(*HANGING).system)
    for colours, message in (("newton", "1 colours"), ("springs", "4 colours")):
        prepared = ready("newton-physics", build_engine_scene(*HANGING).system, colouring_source=colours)
        assert message in prepared.description


def test_newton_physics_reports_a_missing_device():
    warp = pytest.importorskip("warp", reason="the extra `newton` is not installed")
    if not warp.is_cuda_available():
        with pytest.raises(Unsupported, match="Warp finds no CUDA device"):
            ready("newton-physics", build_engine_scene(*HANGING).system, device="cuda")


@engines
@pytest.mark.parametrize("weight", [1e10, "exact"])
def test_a_solve_depends_on_the_problem_alone_and_ends_at_the_iterate_of_its_number(name: str, weight: float | str):
    pins = PinsEffect.model_validate({"parts": ["top_corners"], "weight": weight})
    scene = build_engine_scene(*HANGING[:2], pins)
    stated = build_problem(scene, build_initial_state(scene), "previous")
    prepared = ready(name, scene.system)
    original = stated.step_start.positions.copy()
    other = falling(build_random_problem(0))
    elsewhere = ready(name, other.system)
    alone = prepared.solve(stated, StopRule(5))
    together = zip(prepared.iterates(stated), elsewhere.iterates(other), strict=False)
    iterates = [p.copy() for p, _ in islice(together, 5)]
    np.testing.assert_array_equal(alone.positions, iterates[-1])
    np.testing.assert_array_equal(stated.step_start.positions, original)
    assert (alone.residual_iterate, alone.termination_reason, alone.num_iterations) == ("none", "max-iter", 5)
    assert np.isnan([alone.residual, alone.initial_residual, prepared.residual_at(stated, original)]).all()
    # Pins that move are at their ends, whatever was before.
    moved = replace(stated, pin_targets=stated.pin_targets + 0.01)
    found = prepared.solve(moved, StopRule(4))
    np.testing.assert_array_equal(found.positions[scene.system.pins.vertices], moved.pin_targets)
    np.testing.assert_array_equal(prepared.solve(stated, StopRule(5)).positions, alone.positions)


@engines
def test_rows_state_the_version_of_the_engine(name: str):
    prepared = ready(name, build_engine_scene(*HANGING).system)
    package = load_target(OPTIONAL_SOLVERS[name]).solver_info.package_name
    version = json.loads(build_provenance_columns(SolverSpec(name, {}))["versions"])[package]
    assert f"{package} {version}," in prepared.description
    assert package not in json.loads(build_provenance_columns(SolverSpec("newton", {}))["versions"])


@engines
def test_the_script_that_is_printed_ends_where_the_run_did(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    ready(name, build_engine_scene(*HANGING).system)
    (tmp_path / "net.yaml").write_text(NET)
    config = tmp_path / "config.yaml"
    config.write_text(CONFIG.format(engine=name))
    listed = CliRunner().invoke(app, ["export-script", str(config)])
    (line,) = [line for line in listed.stdout.splitlines() if f"net-3-work-{name}" in line]
    point = line.split()[0]
    result = CliRunner().invoke(app, ["export-script", str(config), point[-6:], "-o", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert (tmp_path / f"{point}.py").read_text() in result.stdout
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    runpy.run_path(f"{point}.py")
    away = float(capsys.readouterr().out.split(" s; ")[1].split(" m ")[0])
    # 1/30 s in one piece of 20 substeps, or of 19 and of 1: the last digit of a substep's length.
    assert away < 1e-12


@engines
def test_the_folder_of_a_script_is_made_and_a_file_in_its_place_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    scene, engine = build_engine_scene(*HANGING), load_target(OPTIONAL_SOLVERS[name])()
    end = scene.mesh.rest_positions
    texts = write_engine_script("hangs", scene, engine, 20, 2, tmp_path / "new" / "folder", end=end)
    assert {path.name for path in (tmp_path / "new" / "folder").iterdir()} == {*texts, "hangs.npz"}
    (tmp_path / "net.yaml").write_text(NET)
    (tmp_path / "config.yaml").write_text(CONFIG.format(engine=name))
    (tmp_path / "file").touch()
    result = CliRunner().invoke(app, ["export-script", str(tmp_path / "config.yaml"), "-o", str(tmp_path / "file")])
    assert result.exit_code == 0, "without a point it only lists them"
    point = next(line for line in result.stdout.splitlines() if f"net-3-work-{name}" in line).split()[0]
    refused = ["export-script", str(tmp_path / "config.yaml"), point[-6:], "-o", str(tmp_path / "file")]
    result = CliRunner().invoke(app, refused)
    assert result.exit_code == 2
    assert "is a file; expected a folder" in result.stderr + capsys.readouterr().err


@engines
def test_a_script_moves_pins_and_slows_velocities_as_the_run_does(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    motion = {"key_frames": [{"time": 0.0}, {"time": 0.1, "offset": [0.1, 0.1, 0.0]}]}
    pulled = PinsEffect.model_validate({"parts": ["top_corners"], "weight": "exact", "motion": motion})
    scene = build_engine_scene(*HANGING[:2], pulled, EtherDragEffect(decay_rate=2.0), integrator="implicit-euler")
    ready(name, scene.system)
    engine = load_target(OPTIONAL_SOLVERS[name])()
    script = write_engine_script("pulled", scene, engine, substeps=20, frames=4, folder=tmp_path)["pulled.py"]
    assert "drag" in script
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    runpy.run_path("pulled.py")
    away = float(capsys.readouterr().out.split(" s; ")[1].split(" m ")[0])
    with np.load("pulled.npz") as stored:
        assert np.abs(stored["end"] - scene.mesh.rest_positions).max() > 0.05
    assert away < 1e-6


def test_mujoco_names_a_vertex_that_is_too_light():
    network: Any = SimpleNamespace(mass=np.array([1.0, 0.0, 1e-15]), free_vertices=np.array([0, 2]), spring_dashpots=())
    with pytest.raises(Unsupported, match=r"vertex 2 has a mass of 1e-15 kg, and at least 1e-14 kg"):
        build_mjcf(network, "RK4")


def test_a_point_of_none_or_of_several_is_a_mistake(tmp_path: Path):
    (tmp_path / "net.yaml").write_text(NET)
    (tmp_path / "config.yaml").write_text(CONFIG.format(engine="mujoco"))
    result = CliRunner().invoke(app, ["export-script", str(tmp_path / "config.yaml"), "nothing"])
    assert result.exit_code == 2

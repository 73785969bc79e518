"""First guesses from coarser meshes: what passes between two meshes, where they lead, and where there are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.sewing_effect import SewingEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.start_positions import MergedStart
from springbench.harness.simulation.nested_iteration import build_interpolation
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.step_problem import StopRule, Unsupported

from tests.scene_builders import CLOTH_SCENE_YAML


def build_cloth_scene(folder, mesh="{kind: grid}", pins="parts: [top_corners]", size=21, integrator="implicit-euler"):
    path = folder / "cloth.yaml"
    text = CLOTH_SCENE_YAML.replace("{kind: grid}", mesh).replace("parts: [top_corners]", pins).replace("300", "3000")
    path.write_text(text, encoding="utf-8")
    (run,) = load_config(path, solvers=["lbfgs"], sizes=[size]).list_runs()
    return build_scene(run.scene, size, integrator)


def build_spec(*effects: SceneEffect, start: MergedStart | None = None) -> SceneSpec:
    return SceneSpec(
        mesh=GridMesh(), mass=1.0, time_step=0.1, frames=1, effects=effects, start=start, path=Path("scene.yaml")
    )


@pytest.mark.parametrize("mesh", ["{kind: chain}", "{kind: grid}", "{kind: net}", "{kind: block}"])
def test_affine_motions_pass_between_meshes_without_change(tmp_path, mesh):
    pins = "stride: 1000"
    fine, coarse = (build_cloth_scene(tmp_path, mesh, pins, size).mesh.rest_positions for size in (12, 5))
    rng = np.random.default_rng(0)
    turn, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    for known, expected in ((fine, coarse), (coarse, fine)):
        weights = build_interpolation(known, expected)
        np.testing.assert_allclose(weights @ (known @ turn + shift), expected @ turn + shift, rtol=0, atol=1e-9)


def test_common_vertices_of_both_meshes_retain_their_values(tmp_path):
    fine, coarse = (build_cloth_scene(tmp_path, size=size).mesh.rest_positions for size in (9, 5))
    value = np.random.default_rng(0).normal(size=len(fine))
    where = [int(np.linalg.norm(fine - x, axis=1).argmin()) for x in coarse]
    np.testing.assert_allclose(build_interpolation(fine, coarse) @ value, value[where], rtol=0, atol=1e-6)


def test_the_guess_is_nearer_to_the_minimum_and_saves_iterations(tmp_path):
    scene = build_cloth_scene(tmp_path)
    state, ready = build_initial_state(scene), prepare(scene, Lbfgs())
    current, coarse = (build_problem(scene, state, guess) for guess in ("previous", "coarse-to-fine"))
    np.testing.assert_array_equal(coarse.initial_guess[scene.system.pins.vertices], coarse.pin_targets)
    expected = ready.solve(current, StopRule(2000, 1e-8)).positions
    away = [np.abs(stated.initial_guess - expected).max() for stated in (current, coarse)]
    assert away[1] <= 0.3 * away[0]
    first, second = (ready.solve(stated, StopRule(2000, 1e-3)) for stated in (current, coarse))
    assert first.termination_reason == second.termination_reason == "converged"
    assert second.num_iterations < first.num_iterations
    np.testing.assert_array_equal(coarse.initial_guess, build_problem(scene, state, "coarse-to-fine").initial_guess)


def test_nested_iteration_repeats_from_step_to_step(tmp_path):
    scene = build_cloth_scene(tmp_path, integrator="bdf2")
    rule, ready = StopRule(2000, 1e-4), prepare(scene, Lbfgs())
    runs = [
        list(simulate_scene(scene, ready, rule, initial_guess=guess, frames=3))
        for guess in ("previous", "coarse-to-fine")
    ]
    assert {step.solution.termination_reason for steps in runs for step in steps} == {"converged"}
    # It falls by 15 cm, and wrinkles of some millimetres choose their side by the guess.
    np.testing.assert_allclose(*(steps[-1].positions for steps in runs), rtol=0, atol=5e-3)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"size": 16}, "smaller than 17"),
        ({"pins": "indices: [0]"}, "effects name vertices by `indices` or `stride`"),
        ({"pins": "stride: 7"}, "effects name vertices by `indices` or `stride`"),
        ({"integrator": "sdirk-2"}, "coarse-to-fine is for integrators with one stage per step"),
        ({"pins": "box: {low: [0.02, -1, 0.02], high: [0.03, 1, 0.03]}", "size": 41}, "no vertex of the mesh lies in"),
    ],
    ids=["small", "indices", "every", "several unknowns", "an empty box"],
)
def test_where_there_is_no_coarser_mesh_it_is_refused(tmp_path, given, why):
    scene = build_cloth_scene(tmp_path, **given)
    with pytest.raises(Unsupported, match=why):
        build_problem(scene, build_initial_state(scene), "coarse-to-fine")


@pytest.mark.parametrize(
    ("row", "is_numbered"),
    [({"parts": ["right"]}, False), ({"indices": [220]}, True), ({"parts": ["right"], "stride": 7}, True)],
)
def test_rows_to_sew_by_index_have_no_coarser_mesh(row, is_numbered):
    rows = {"first_row": {"parts": ["left"]}, "second_row": row, "stiffness": 1.0}
    scene = build_scene(build_spec(SewingEffect.model_validate(rows)), 21)
    assert (scene.build_coarser is None) == is_numbered


def test_a_merged_start_has_no_coarser_mesh():
    assert build_scene(build_spec(start=MergedStart(vertices=(0, 440))), 21).build_coarser is None
    assert build_scene(build_spec(), 21).build_coarser is not None


def test_a_scene_of_one_size_has_none(tmp_path):
    scene = replace(build_cloth_scene(tmp_path), build_coarser=None)
    with pytest.raises(Unsupported, match="the mesh is from a file"):
        build_problem(scene, build_initial_state(scene), "coarse-to-fine")

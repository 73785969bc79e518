"""JGS2: what a vertex's step is, what rings are for, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh
from springbench.solvers.linalg import memory
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.vertex_block.jgs2 import Jgs2, compute_responses
from springbench.solvers.methods.vertex_block.jgs2_patches import PatchScratch, compute_directions
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule, Unsupported

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.scene_builders import build_cloth, build_first_problem, build_test_scene

HANGING = build_first_problem(build_cloth(8, "exact", stretch=1000.0))
PINS = PinsEffect.model_validate({"parts": ["left"], "weight": "exact"})
BEAM = build_first_problem(
    build_test_scene(
        BlockMesh(height=0.4, depth=0.4), SpringsEffect(stretch=1e5), GravityEffect(), PINS, size=5, mass=50.0
    )
)


def chain(vertices: int) -> csr_array:
    """Which vertices of a chain are next to which, themselves included."""
    return csr_array(np.eye(vertices, k=-1) + np.eye(vertices) + np.eye(vertices, k=1))


def positive_definite(graph: csr_array, seed: int) -> np.ndarray:
    """A matrix of 3 x 3 blocks where the graph has entries."""
    blocks = np.random.default_rng(seed).normal(size=(*graph.shape, 3, 3)) * graph.toarray()[:, :, None, None]
    half = blocks.transpose(0, 2, 1, 3).reshape(3 * graph.shape[0], -1)
    return half + half.T + 40.0 * np.eye(len(half))


def rotations(count: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(count, 3, 3)))
    return q * np.linalg.det(q)[:, None, None]


@pytest.mark.parametrize("rings", [0, 1, 3])
def test_a_vertex_takes_the_best_step_along_its_turned_response(rings):
    graph, f = chain(6), 6
    H, now, R = positive_definite(graph, 3), positive_definite(graph, 4), rotations(f)
    patches, g, out = (
        compute_responses(csr_array(H), graph, rings),
        np.random.default_rng(2).normal(size=18),
        np.empty((f, 3)),
    )
    blocks = now.reshape(f, 3, f, 3).transpose(0, 2, 1, 3)[graph.toarray() > 0.0]
    pointers, columns = graph.indptr.astype(np.int64), graph.indices.astype(np.int64)
    compute_directions(patches, R, pointers, columns, blocks, g.reshape(f, 3), PatchScratch.from_patches(patches), out)
    turn = np.zeros((18, 18))
    for i in range(f):
        turn[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = R[i]
    for i in range(f):
        near = [3 * a + c for a in range(max(0, i - rings), min(f, i + rings + 1)) for c in range(3)]
        own = slice(3 * i, 3 * i + 3)
        X = np.zeros((18, 3))
        X[near] = np.linalg.solve(H[np.ix_(near, near)], np.eye(18)[near, own])
        U = turn @ X @ np.linalg.inv(X[own]) @ R[i].T
        np.testing.assert_allclose(out[i], -np.linalg.solve(U.T @ now @ U, U.T @ g), rtol=1e-10, atol=1e-13)


def test_a_response_of_the_whole_mesh_to_a_quadratic_objective_is_a_newton_step():
    springs = Springs.from_parts([e for e in HANGING.system.energies if isinstance(e, Springs)])
    soft = replace(springs, rest_length=np.zeros(len(springs.edges)))
    problem = replace(HANGING, system=replace(HANGING.system, energies=(soft,)))
    expected = NewtonSolver().prepare(problem.system).solve(problem, StopRule(5, 1e-12)).positions
    np.testing.assert_allclose(first(Jgs2(neighbour_rings=8), problem), expected, rtol=0, atol=1e-10)


def first(solver: Jgs2, problem: StepProblem) -> Positions:
    return next(islice(solver.prepare(problem.system).iterates(problem), 1)).copy()


def test_responses_turn_with_the_mesh():
    R = rotations(1)[0]
    fields = ("inertial_target", "external_force", "pin_targets", "initial_guess", "current_positions")
    turned = replace(HANGING, **{name: getattr(HANGING, name) @ R.T for name in fields})
    # Half of the digits: how springs have turned follows from a sum that is singular across the cloth.
    np.testing.assert_allclose(first(Jgs2(), turned), first(Jgs2(), HANGING) @ R.T, rtol=0, atol=1e-8)


def test_on_a_solid_at_small_displacements_it_converges_as_newtons_method_does():
    none, two, whole = (
        Jgs2(rings, 0.001).prepare(BEAM.system).solve(BEAM, StopRule(5000, 1e-3)).num_iterations for rings in (0, 2, 8)
    )
    newton = NewtonSolver().prepare(BEAM.system).solve(BEAM, StopRule(50, 1e-3)).num_iterations
    assert none > 10 * two
    assert whole <= newton + 2


@pytest.mark.parametrize(("scene", "name"), [("contact", "HalfSpaceContact"), ("gas", "Gas")], ids=lambda x: x)
def test_effects_that_the_rest_shape_does_not_determine_are_refused_by_name(scene, name):
    with pytest.raises(Unsupported, match=f"jgs2: .*{name}"):
        Jgs2().prepare(build_moving_problem(EFFECT_SCENES[scene]()).system)


def test_responses_that_do_not_fit_in_memory_are_refused_beforehand(monkeypatch):
    monkeypatch.setattr(memory, "compute_memory_limit", lambda: 5e4)
    with pytest.raises(Unsupported, match=r"within 4 rings .* KiB of memory.*use fewer"):
        compute_responses(csr_array(np.eye(300)), chain(100), 4)


@pytest.mark.parametrize(
    ("given", "words"),
    [({"neighbour_rings": -1}, "neighbour_rings"), ({"lateral_stiffness_ratio": 1.5}, "lateral_stiffness_ratio")],
    ids=str,
)
def test_settings_without_meaning_are_refused(given, words):
    with pytest.raises(ValueError, match=f"{words}: should"):
        Jgs2(**given)

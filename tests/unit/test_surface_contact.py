"""Contact with surfaces of obstacles, and friction of pairs: derivatives, safe ways, closed forms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from springbench.harness.errors import InputError
from springbench.harness.recording.recorder_interface import build_obstacles_property
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.mesh.body_mesh import BodyMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.harness.scenes.primitive_obstacles import BoxObstacle, CapsuleObstacle, PlaneObstacle, SphereObstacle
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.surface_obstacles import (
    MeshObstacle,
    TriangleSurface,
    build_obstacle_surface,
    parse_obstacles,
)
from springbench.harness.simulation.instrumentation_pass import count_intersections
from springbench.harness.simulation.time_loop import (
    MotionState,
    build_initial_state,
    build_problem,
    prepare,
    simulate_scene,
)
from springbench.solvers.contact.ccd import MIN_GAP_FRACTION
from springbench.solvers.contact.contact_potential import ObstacleContact
from springbench.solvers.contact.geometry.aabb import CollisionQuery, compute_aabb_clearance
from springbench.solvers.contact.obstacle_advancement import NoClearance
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.oracles.verify_scene import verify_terms
from tests.scene_builders import build_test_scene
from tests.self_contact_scenes import random_displacement

BALL = MeshObstacle(mesh=BalloonMesh(radius=0.3), size=4, offset=(0.02, -0.33, 0.01))
RULE = StopRule(100, 1e-4)


def build_draped_sheet(*obstacles: object, size: int = 7, **options: float) -> Scene:
    """A level sheet of 1 m over obstacles."""
    effect = SurfaceContactEffect.model_validate({"min_distance": 0.01, "obstacles": obstacles or (BALL,), **options})
    return build_test_scene(GridMesh(), SpringsEffect(stretch=100.0, shear=20.0), GravityEffect(), effect, size=size)


def contact(made: Scene) -> ObstacleContact:
    (energy,) = (e for e in made.system.energies if isinstance(e, ObstacleContact))
    return energy


def touching(friction: float = 0.0) -> tuple[ObstacleContact, Positions]:
    """The contact in a step, and positions where it presses, and slips."""
    made = build_draped_sheet(friction=friction)
    *_, last = simulate_scene(made, prepare(made, NewtonSolver()), RULE, initial_guess="previous", frames=8)
    stated = build_problem(made, last.state, "previous")
    (energy,) = (e for e in stated.energies if isinstance(e, ObstacleContact))
    p = last.positions + random_displacement(0, last.positions, 1e-5)
    assert len(energy.hessian_blocks(p).vertices) > 20
    return energy, p


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_gradients_and_second_derivatives_are_those_of_the_value(friction):
    energy, p = touching(friction)
    gradient, h, hessian = np.zeros_like(p), 1e-8, energy.hessian(p)
    energy.add_gradient(p, gradient)
    for seed in range(3):
        d = random_displacement(seed, p, 1.0)
        change = (energy.value(p + h * d) - energy.value(p - h * d)) / (2 * h)
        # Central differences over a gap of some 1e-3: (h/gap)^2, and round-off over h.
        assert change == pytest.approx(float((gradient * d).sum()), rel=1e-5)
        ahead, behind = np.zeros_like(p), np.zeros_like(p)
        energy.add_gradient(p + h * d, ahead)
        energy.add_gradient(p - h * d, behind)
        bent = (ahead - behind).ravel() / (2 * h)
        np.testing.assert_allclose(hessian @ d.ravel(), bent, atol=1e-5 * np.abs(bent).max())
        product = np.zeros_like(p)
        energy.hessian_blocks(p).add_product(d, product)
        np.testing.assert_allclose(product.ravel(), hessian @ d.ravel(), atol=1e-12 * np.abs(product).max())


def test_frictions_own_derivatives_are_positive_semidefinite_and_pull_against_the_slip():
    energy, p = touching(0.5)
    grip = energy.tangential_collisions
    blocks = grip.hessian_blocks(energy.append_obstacle_positions(p)).values
    assert len(blocks) > 20
    assert np.linalg.eigvalsh(blocks)[:, 0].min() >= -1e-13 * np.abs(blocks).max()
    slipped = np.zeros((len(p) + len(energy.current_positions), 3))
    grip.add_gradient(energy.append_obstacle_positions(p), slipped)
    moved = energy.append_obstacle_positions(p) - np.concatenate([p, energy.current_positions])
    assert not moved.any()
    assert np.abs(slipped.sum(axis=0)).max() <= 1e-12 * np.abs(slipped).sum()


OBSTACLES = {
    "mesh": BALL,
    "body": MeshObstacle(mesh=BodyMesh(height=0.6), size=8, offset=(0.0, -0.63, 0.0)),
    "sphere": SphereObstacle(center=(0.0, -0.33, 0.0), radius=0.3),
    "capsule": CapsuleObstacle(end_points=((-0.3, -0.15, 0.1), (0.2, -0.15, 0.0)), radius=0.1),
    "box": BoxObstacle(low=(-0.2, -0.3, -0.2), high=(0.13, -0.04, 0.17)),
    "plane": PlaneObstacle(point=(0.0, -0.09, 0.0), normal=(0.1, 1.0, 0.0)),
}


@pytest.mark.parametrize("name", OBSTACLES)
def test_nothing_passes_through_any_obstacle(name):
    made = build_draped_sheet(OBSTACLES[name])
    touched = 0
    for step in simulate_scene(made, prepare(made, NewtonSolver()), RULE, initial_guess="previous", frames=12):
        assert count_intersections(made, step.positions, made.compute_time(step.index)) == 0
        touched += len(contact(made).hessian_blocks(step.positions).vertices)
    assert touched > 20


@pytest.mark.parametrize("name", ["newton", "newton-cg", "pncg", "lbfgs", "hybrid"])
@pytest.mark.parametrize("sideways", [0.0, 6.0])
def test_an_obstacle_that_moves_pushes_the_sheet_and_never_passes_it(name, sideways):
    keys = (
        KeyFrame(time=0.0),
        KeyFrame(time=0.1, offset=(0.0, 0.3, 0.0)),
        KeyFrame(time=0.3, offset=(0.2, 0.3, 0.0), angle=120.0),
    )
    speed = {"motion": KeyFrameMotion(key_frames=keys, axis=(0.0, 1.0, 0.3))}
    table = PlaneObstacle(point=(0.0, -0.7, 0.0))
    made = build_draped_sheet(BALL.model_copy(update=speed), table, friction=0.3, size=6)
    begun = build_initial_state(made).motion
    state = MotionState(Motion(begun.positions, begun.velocity + np.array([sideways, 0.0, 0.0])), None, 0)
    prepared = prepare(made, load_target(SOLVERS[name])())
    highest = 0.0
    for step in simulate_scene(made, prepared, RULE, initial_guess="previous", frames=12, initial_state=state):
        highest = float(step.positions[:, 1].max())
        assert count_intersections(made, step.positions, made.compute_time(step.index)) == 0
        assert not any(
            energy.find_violated_pairs(step.positions)
            for energy in step.problem.energies
            if isinstance(energy, ObstacleContact)
        )
    assert highest > 0.1 or sideways


def deforming(path: Path, rate: float) -> MeshObstacle:
    """The ball grows taller and thinner from frame to frame, and rises."""
    ball = BalloonMesh(radius=0.3).build_mesh(4).rest_positions
    stored = [ball * (1 / s, s, 1 / s) + (0.0, 0.4 * (s - 1), 0.0) for s in 1 + 0.08 * np.arange(7)]
    np.savez(path / "ball.npz", positions=np.array(stored))
    frames = {"positions": str(path / "ball.npz"), "frame_rate": rate}
    return MeshObstacle.model_validate(
        BALL.model_dump() | {"mesh": {"kind": "balloon", "radius": 0.3}, "frames": frames}
    )


def test_an_obstacle_that_deforms_along_stored_frames_lifts_the_sheet(tmp_path):
    one = deforming(tmp_path, 30.0)
    made, highest = build_draped_sheet(one, friction=0.3, size=6), 0.0
    for step in simulate_scene(made, prepare(made, NewtonSolver()), RULE, initial_guess="previous", frames=8):
        assert count_intersections(made, step.positions, made.compute_time(step.index)) == 0
        highest = float(step.positions[:, 1].max())
    assert highest > 0.2
    points, _ = one.build_surface()
    for time, frame in ((0.0, 0), (0.1, 3), (9.0, 6)):
        assert one.frames is not None
        np.testing.assert_allclose(
            one.place_points(points, time), one.frames.frame_positions[frame] + one.offset, atol=1e-12
        )
    (back,) = parse_obstacles(f"[{one.model_dump_json(exclude_none=True)}]")
    assert isinstance(back, MeshObstacle)
    np.testing.assert_allclose(
        back.place_points(back.build_surface()[0], 0.15), one.place_points(points, 0.15), atol=1e-12
    )


def test_the_reference_terms_agree_on_an_obstacle_that_deforms(tmp_path):
    effect = SurfaceContactEffect(min_distance=0.01, friction=0.3, obstacles=(deforming(tmp_path, 3.0),))
    given = {"mesh": GridMesh(), "mass": 1.0, "time_step": 1 / 30, "frames": 6, "path": Path("scene.yaml")}
    spec = SceneSpec.model_validate(given | {"effects": (SpringsEffect(stretch=100.0), effect)})
    assert verify_terms(spec, build_scene(spec, 4), "implicit-euler") == "agrees"


def test_frames_of_another_mesh_are_refused(tmp_path):
    np.savez(tmp_path / "ball.npz", positions=np.zeros((2, 5, 3)))
    frames = {"positions": str(tmp_path / "ball.npz")}
    for given, words in ((frames, "got 5 points for a mesh of"), ({"positions": [[[0, 0, 0]]]}, "got 1 points")):
        with pytest.raises(ValidationError, match=words):
            build_draped_sheet(BALL.model_dump() | {"mesh": {"kind": "balloon"}, "frames": given})


def test_clearance_of_an_obstacle_far_away_is_nearly_its_distance_and_never_more():
    rng, query = np.random.default_rng(0), CollisionQuery(0.05, 0.01, MIN_GAP_FRACTION)
    for k in range(20):
        p = rng.uniform(size=(40, 3))
        p[20:, 1] -= rng.uniform(0.9, 6.0)
        q = p + 0.1 * rng.normal(size=p.shape) * (k % 2)
        found = compute_aabb_clearance((0, 20), (20, 40), p, q, query)
        distance = float(np.linalg.norm(q[:20, None] - q[None, 20:], axis=2).min())
        assert found == 0.0 or query.inflation_radius <= found <= distance
        assert found > 0.0 or distance < 1.0
    p = rng.uniform(size=(40, 3)) - np.eye(3)[1] * np.repeat([0.0, 6.0], 20)[:, None]
    assert compute_aabb_clearance((0, 20), (20, 40), p, p + np.eye(3)[1] * (p[:, 1:2] < 0.0) * 9.0, query) == 0.0


def test_a_vertex_squeezed_between_obstacles_is_reported():
    down = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=1.0, offset=(0.0, -5.0, 0.0))))
    press = PlaneObstacle(point=(0.0, 0.05, 0.0), normal=(0.0, -1.0, 0.0), motion=down)
    made = build_draped_sheet(PlaneObstacle(point=(0, -0.05, 0)), press, size=4)
    with pytest.raises(NoClearance, match="obstacles leave no room"):
        list(simulate_scene(made, prepare(made, NewtonSolver()), RULE, initial_guess="previous", frames=12))


@pytest.mark.parametrize(
    ("obstacle", "words"),
    [
        (SphereObstacle(center=(0.0, 0.0, 0.0), radius=0.3), "passes through obstacles, .* edge .* of the obstacles"),
        (
            PlaneObstacle(point=(0.0, -0.005, 0.0)),
            "nearer than the min_distance of 0.01 m: .* of the obstacles 0.005 m apart",
        ),
    ],
)
def test_an_intersecting_start_is_refused_with_the_pairs(obstacle, words):
    with pytest.raises(InputError, match=words):
        build_draped_sheet(obstacle)


def test_surfaces_of_round_obstacles_are_inside_by_at_most_the_stated_distance():
    rng = np.random.default_rng(0)
    for one in (OBSTACLES["sphere"], OBSTACLES["capsule"]):
        points, triangles = build_obstacle_surface(one, 1e-3, np.zeros((1, 3)))
        weights = rng.dirichlet(np.ones(3), size=(20, len(triangles)))
        inside = np.einsum("kfc,fcx->kfx", weights, points[triangles]).reshape(-1, 3)
        depth = -one.build_obstacle().signed_distance(inside, 0.0)
        assert depth.min() > -1e-12
        assert 1e-4 < depth.max() <= 1e-3


def test_a_mesh_from_a_file_is_identified_by_its_contents(tmp_path):
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 3 2\n")
    context = {"folder": tmp_path}
    given = {"kind": "mesh", "mesh": {"kind": "file", "path": "one.obj"}, "scale": 2.0, "offset": (0.0, -1.0, 0.0)}
    one = MeshObstacle.model_validate_json(json.dumps(given), strict=True, context=context)  # as configs are read
    (tmp_path / "one.obj").unlink()
    with pytest.raises(InputError):
        one.build_surface()
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 3 2\n")
    (read,) = parse_obstacles(build_obstacles_property([one])["obstacles"])
    assert isinstance(read, MeshObstacle)
    for found, expected in zip(read.build_surface(), one.build_surface(), strict=True):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(read.build_surface()[0][1], [2.0, -1.0, 0.0])
    with pytest.raises(ValueError, match=r"there is no file .*two\.obj"):
        MeshObstacle.model_validate(given | {"mesh": {"kind": "file", "path": "two.obj"}}, context=context)
    with pytest.raises(ValueError, match="three different points from 0 to 2"):
        TriangleSurface(points=((0.0, 0.0, 0.0),) * 3, triangles=((0, 1, 3),))


def test_a_body_is_closed_and_faces_outwards():
    mesh: Mesh = BodyMesh().build_mesh(12)
    sides = np.sort(np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    assert (np.unique(sides, axis=0, return_counts=True)[1] == 2).all()
    a, b, c = (mesh.rest_positions[mesh.triangles[:, k]] for k in range(3))
    assert 0.02 < np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 < 0.06  # m^3, of a form 0.9 m high
    assert mesh.rest_positions[:, 1].max() == pytest.approx(0.9)
    assert len(mesh.rest_positions) == BodyMesh().count_vertices(12)


MU = 0.4


DT = 0.005


def slide(tangent: float) -> tuple[np.ndarray, float]:
    """How fast a small sheet slides down a slope at the end of each step [m/s], and how it should accelerate."""
    angle, g = np.arctan(tangent), 9.81
    down = GravityEffect(acceleration=(g * np.sin(angle), -g * np.cos(angle), 0.0))
    floor = SurfaceContactEffect(min_distance=0.01, friction=MU, obstacles=(PlaneObstacle(point=(0.0, -0.0186, 0.0)),))
    made = build_test_scene(
        GridMesh(width=0.2, height=0.2), SpringsEffect(stretch=100.0, shear=20.0), down, floor, size=3, time_step=DT
    )
    steps = simulate_scene(
        made, prepare(made, NewtonSolver()), StopRule(100, 1e-6), initial_guess="extrapolated", frames=80
    )
    speeds = np.array([step.state.motion.velocity[:, 0].mean() for step in steps])
    return speeds, g * (np.sin(angle) - MU * np.cos(angle))


def test_it_slides_above_the_angle_of_friction_and_rests_below_within_a_twentieth():
    rests, _ = slide(0.95 * MU)
    assert rests[-1] < 1e-3  # the creep
    for steeper in (1.05, 1.5):
        slides, expected = slide(steeper * MU)
        assert slides[-1] > 10e-3
        # The plane is two triangles: near their common side normal forces lean, and friction is off by up to 1 %.
        friction = MU * 9.81 * np.cos(np.arctan(steeper * MU))
        assert (slides[-1] - slides[39]) / (40 * DT) == pytest.approx(expected, abs=0.01 * friction)


def test_sheets_that_collide_with_friction_conserve_momentum():
    rough = SelfContactEffect(min_distance=0.01, friction=0.5)
    made = build_test_scene(StackMesh(layer_spacing=0.05), SpringsEffect(stretch=100.0, shear=20.0), rough, size=5)
    p, v = made.mesh.rest_positions, np.zeros_like(made.mesh.rest_positions)
    upper = np.arange(len(p)) >= len(p) // 2
    v[upper] = (1.0, -2.0, 0.0)
    state, mass = MotionState(Motion(p, v), None, 0), made.system.mass
    before, after = mass @ v, v
    for step in simulate_scene(
        made,
        prepare(made, NewtonSolver()),
        StopRule(100, 1e-11),
        initial_guess="extrapolated",
        frames=8,
        initial_state=state,
    ):
        # Forces of pairs add up to nothing; what is left is the solve's tolerance.
        after = step.state.motion.velocity
        np.testing.assert_allclose(mass @ after, before, atol=1e-8)
    # Friction has taken the lower one along.
    assert (mass[~upper] @ after[~upper])[0] > 0.02 * before[0]

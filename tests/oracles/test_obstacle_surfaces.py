"""Contact with obstacles' surfaces: both implementations agree, and a planted error in the law is found."""

from __future__ import annotations

import re
from typing import Any

import pytest
from springbench.harness.scenes import collision_primitives
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.harness.scenes.primitive_obstacles import BoxObstacle, CapsuleObstacle, PlaneObstacle, SphereObstacle
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.surface_obstacles import MeshObstacle
from springbench.solvers.contact.contact_potential import ObstacleContact

from tests.oracles.verify_scene import verify_terms

ROTATION = KeyFrameMotion(
    key_frames=(KeyFrame(time=0.0), KeyFrame(time=0.1, offset=(0.01, 0.02, 0.0), angle=20.0)), axis=(0.1, 1.0, 0.2)
)
BALL = MeshObstacle(mesh=BalloonMesh(radius=0.3), size=2, offset=(0.1, -0.5, 0.0))
OBSTACLES: dict[str, tuple[Any, ...]] = {
    "mesh": (BALL,),
    "mesh that turns": (BALL.model_copy(update={"motion": ROTATION}),),
    "plane and box": (PlaneObstacle(point=(0, -1, 0)), BoxObstacle(low=(0.0, 0.5, 0.0), high=(0.4, 0.7, 0.3))),
    "sphere and capsule": (
        SphereObstacle(center=(0, -1, 0), radius=0.5),
        CapsuleObstacle(end_points=((0, 1, 0), (0.5, 1, 0)), radius=0.2, motion=ROTATION),
    ),
}


def spec(*obstacles: Any, more: tuple[Any, ...] = (), friction: float = 0.0) -> SceneSpec:
    rubs = SurfaceContactEffect(obstacles=obstacles, min_distance=0.1, friction=friction)
    given = {"mesh": GridMesh(), "mass": 1.0, "time_step": 0.02, "frames": 3, "path": "scene.yaml"}
    return SceneSpec.model_validate(given | {"effects": (SpringsEffect(stretch=100.0), rubs, *more)})


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("name", OBSTACLES)
def test_implementations_agree(name: str, friction: float):
    given = spec(*OBSTACLES[name], friction=friction)
    assert verify_terms(given, build_scene(given, 3), "implicit-euler") == "agrees"


def test_implementations_agree_with_bdf2_and_self_contact():
    given = spec(*OBSTACLES["mesh that turns"], friction=0.4, more=(SelfContactEffect(min_distance=0.1),))
    assert verify_terms(given, build_scene(given, 3, "bdf2"), "bdf2") == "agrees"


def test_implementations_agree_where_an_obstacle_with_friction_leaves_in_one_step():
    shot = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=0.1, offset=(5.0, 2.0, 0.0))))
    given = spec(BALL.model_copy(update={"motion": shot}), PlaneObstacle(point=(0, -1, 0)), friction=0.4)
    assert verify_terms(given, build_scene(given, 3), "implicit-euler") == "agrees"


WRONG = r"disagrees: (objective \(gradient\), by \S+ of its size; )?effects\[1\] surface-contact"


@pytest.mark.parametrize("name", OBSTACLES)
def test_another_stiffness_is_found(name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(collision_primitives, "_STIFFNESS_FRACTION", 0.1001)
    given = spec(*OBSTACLES[name])
    assert re.match(WRONG, verify_terms(given, build_scene(given, 3), "implicit-euler"))


def test_another_friction_is_found():
    given = spec(BALL, friction=0.4)
    made = build_scene(given, 3)
    (energy,) = (e for e in made.system.energies if isinstance(e, ObstacleContact))
    object.__setattr__(energy, "friction", 0.401)
    assert re.match(WRONG, verify_terms(given, made, "implicit-euler"))


def test_an_obstacle_that_is_a_step_late_is_found():
    given = spec(*OBSTACLES["mesh that turns"])
    made = build_scene(given, 3)
    (energy,) = (e for e in made.system.energies if isinstance(e, ObstacleContact))
    positions_at = energy.obstacle_positions_at
    object.__setattr__(energy, "obstacle_positions_at", lambda time: positions_at(max(0.0, time - 0.02)))
    assert re.match(WRONG, verify_terms(given, made, "implicit-euler"))

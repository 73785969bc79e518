"""The second opinion of contact with obstacles' surfaces: it agrees, and with no other law."""

from __future__ import annotations

import re
from typing import Any

import pytest

from harness.scenes import touching
from harness.scenes.bind import build
from harness.scenes.effects.self_contact import SelfContact
from harness.scenes.effects.springs import Springs
from harness.scenes.effects.surface_contact import SurfaceContact
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.surfaces import Balloon
from harness.scenes.motion import Key, KeyedMotion
from harness.scenes.obstacles import Box, Capsule, Plane, Sphere
from harness.scenes.shapes import Solid
from harness.scenes.spec import SceneSpec
from harness.simulation.opinion.second import second_opinion
from solvers.contact.self_contact import ObstacleContact

TURNS = KeyedMotion(keys=(Key(time=0.0), Key(time=0.1, offset=(0.01, 0.02, 0.0), turn=20.0)), axis=(0.1, 1.0, 0.2))
BALL = Solid(mesh=Balloon(radius=0.3), size=2, offset=(0.1, -0.5, 0.0))
OBSTACLES: dict[str, tuple[Any, ...]] = {
    "mesh": (BALL,),
    "mesh that turns": (BALL.model_copy(update={"motion": TURNS}),),
    "plane and box": (Plane(point=(0, -1, 0)), Box(low=(0.0, 0.5, 0.0), high=(0.4, 0.7, 0.3))),
    "sphere and capsule": (
        Sphere(center=(0, -1, 0), radius=0.5),
        Capsule(ends=((0, 1, 0), (0.5, 1, 0)), radius=0.2, motion=TURNS),
    ),
}


def spec(*obstacles: Any, more: tuple[Any, ...] = (), friction: float = 0.0) -> SceneSpec:
    rubs = SurfaceContact(obstacles=obstacles, thickness=0.1, friction=friction)
    given = {"mesh": Grid(), "mass": 1.0, "time_step": 0.02, "frames": 3, "path": "scene.yaml"}
    return SceneSpec.model_validate(given | {"effects": (Springs(stretch=100.0), rubs, *more)})


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("name", OBSTACLES)
def test_it_agrees(name: str, friction: float):
    given = spec(*OBSTACLES[name], friction=friction)
    assert second_opinion(given, build(given, 3), "implicit-euler") == "agrees"


def test_it_agrees_with_another_integrator_and_beside_self_contact():
    given = spec(*OBSTACLES["mesh that turns"], friction=0.4, more=(SelfContact(thickness=0.1),))
    assert second_opinion(given, build(given, 3, "bdf2"), "bdf2") == "agrees"


def test_it_agrees_where_an_obstacle_that_rubs_is_gone_in_a_step():
    shot = KeyedMotion(keys=(Key(time=0.0), Key(time=0.1, offset=(5.0, 2.0, 0.0))))
    given = spec(BALL.model_copy(update={"motion": shot}), Plane(point=(0, -1, 0)), friction=0.4)
    assert second_opinion(given, build(given, 3), "implicit-euler") == "agrees"


WRONG = r"disagrees: (objective \(gradient\), by \S+ of its size; )?effects\[1\] surface-contact"


@pytest.mark.parametrize("name", OBSTACLES)
def test_it_knows_another_stiffness(name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(touching, "_STIFF", 0.1001)
    given = spec(*OBSTACLES[name])
    assert re.match(WRONG, second_opinion(given, build(given, 3), "implicit-euler"))


def test_it_knows_another_friction():
    given = spec(BALL, friction=0.4)
    made = build(given, 3)
    (energy,) = (e for e in made.system.energies if isinstance(e, ObstacleContact))
    object.__setattr__(energy, "friction", 0.401)
    assert re.match(WRONG, second_opinion(given, made, "implicit-euler"))


def test_it_knows_an_obstacle_that_is_a_step_late():
    given = spec(*OBSTACLES["mesh that turns"])
    made = build(given, 3)
    (energy,) = (e for e in made.system.energies if isinstance(e, ObstacleContact))
    object.__setattr__(energy, "place", lambda time, place=energy.place: place(max(0.0, time - 0.02)))
    assert re.match(WRONG, second_opinion(given, made, "implicit-euler"))

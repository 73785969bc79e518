"""Scenes as files declare them, and ways to lie about how they are stated: what the second opinion has to tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from harness.scenes.bind import build
from harness.scenes.effects.base import Contribution, Pin, Steady
from harness.scenes.effects.effect_names import EFFECTS
from harness.scenes.mesh.mesh_names import MESHES
from harness.scenes.spec import SceneSpec
from harness.simulation.opinion.second import second_opinion
from solvers.contact.energy import Contact
from solvers.integrators import INTEGRATORS, Integrator
from solvers.problem import Positions, System
from solvers.registry import load

METHODS = ("implicit-euler", "bdf2", "midpoint")


def opinion(spec: SceneSpec, size: int = 0, integrator: str = "implicit-euler") -> str:
    return second_opinion(spec, build(spec, size, integrator), integrator)


MOVES = {"keys": [{"time": 0}, {"time": 0.4, "offset": (0.1, 0.2, 0), "turn": 90}, {"time": 1, "turn": 30}]}
SMOOTH = MOVES | {"between": "smooth", "axis": (1, 2, 0), "about": (0.1, 0, 0.3)}
OBSTACLES = [
    {"kind": "plane", "point": (0, -0.3, 0), "normal": (0.2, 1, 0)},
    {"kind": "sphere", "center": (0, -0.9, 0), "radius": 0.3, "motion": SMOOTH},
    {"kind": "capsule", "ends": [(0, -1, 0), (1, -1, 0.5)], "radius": 0.1, "motion": MOVES},
    {"kind": "box", "low": (-0.2, -2, -0.2), "high": (0.3, -1.7, 0.4), "motion": MOVES},
]
SPRINGS = {"kind": "springs", "stretch": 300, "shear": 60}
SKIP_ONE = {"kind": "springs", "stretch": 300, "shear": 60, "bend": 0.01}
PINS = {"kind": "pins", "at": ["top_corners"], "motion": SMOOTH}
TIED = {"kind": "attachments", "at": ["bottom"], "stiffness": 50, "motion": MOVES}
LIMITS = {"kind": "strain-limits", "longest": 1.02, "shortest": 0.98, "stiffness": 500}
GUSTS = {"kind": "wind", "field": "gusts", "per": "triangle", "velocity": (3, 0, 1), "lift": 0.5}
BEND, DASHPOTS = {"kind": "bending", "stiffness": 0.5}, {"kind": "dashpots", "stretch": 2}
RAYLEIGH = {"kind": "rayleigh", "mass": 0.5, "stiffness": 0.02}
DRAG, GRAVITY = {"kind": "air-drag", "coefficient": 2}, {"kind": "gravity"}
FLOOR = {"kind": "contact", "obstacles": OBSTACLES, "friction": 0.3, "creep": 0.08}
BLOWN = {"kind": "wind", "field": "assignment"}
FORCES = [GRAVITY, {"kind": "constant-force", "force": (0, 0, 0.1)}, BLOWN]
SLOWED = [{"kind": "ether-drag", "rate": 2}, {"kind": "air-drag", "law": "quadratic", "coefficient": 0.3}]
BALL = {"kind": "balloon"}
GAS = {"kind": "gas", "pressure": 200}


def declared(*effects: dict[str, Any], mesh: dict[str, Any] | None = None, **more: Any) -> SceneSpec:
    """A cloth (or another mesh) with effects, as a file declares them."""
    given = mesh or {"kind": "grid", "skip_one": True}
    made = tuple(load(EFFECTS[effect["kind"]]).model_validate(effect) for effect in effects)
    fields: dict[str, Any] = {"mass": 1.0, "time_step": 1 / 30, "frames": 40} | more
    return SceneSpec(mesh=load(MESHES[given["kind"]])(**given), effects=made, path=Path("scene.yaml"), **fields)


def scaled(**fields: float) -> Callable[[Any], Any]:
    """Energies with some fields multiplied."""
    return lambda energy: replace(energy, **{name: by * getattr(energy, name) for name, by in fields.items()})


class Lie(NamedTuple):
    """What is told: of the class of an energy, changed as they are bound; or by a patch. words: in what the opinion has
    to disagree."""

    effects: list[dict[str, Any]]
    words: str
    tell: Callable[[pytest.MonkeyPatch], None]
    integrator: str = "implicit-euler"
    mesh: dict[str, Any] | None = None
    size: int = 5


def bound(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Every energy of a class is changed when a scene is built."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        made = System.__init__

        def lying(self: System, mass: Any, time_step: float, energies: Any = (), *more: Any, **named: Any) -> None:
            told = tuple(change(one) if type(one) is kind else one for one in energies)
            made(self, mass, time_step, told, *more, **named)

        patch.setattr(System, "__init__", lying)

    return tell


def begun(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Every energy of a class is changed when a step begins."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        true = kind.begin_step
        patch.setattr(kind, "begin_step", lambda self, start: change(true(self, start)))

    return tell


def started(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Every energy of a class begins its steps at another start."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        true = kind.begin_step
        patch.setattr(kind, "begin_step", lambda self, start: true(self, change(start)))

    return tell


def scales(kind: type, method: str, by: float) -> Callable[[pytest.MonkeyPatch], None]:
    """A method of a class returns so many times what it should, in its last argument where it adds to that."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        true = getattr(kind, method)

        def lying(self: Any, p: Positions, *out: Positions) -> Any:
            if not out:
                return by * true(self, p)
            added = np.zeros_like(out[0])
            true(self, p, added)
            out[0][:] += by * added
            return None

        patch.setattr(kind, method, lying)

    return tell


def contributed(target: str, change: Callable[[Contribution], Contribution]) -> Callable[[pytest.MonkeyPatch], None]:
    """An effect binds to something else."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        kind = load(EFFECTS[target])
        true = kind.bind
        patch.setattr(kind, "bind", lambda *given: change(true(*given)))

    return tell


def steady(by: float) -> Callable[[Contribution], Contribution]:
    def change(part: Contribution) -> Contribution:
        return replace(part, forces=tuple(Steady(by * one.force) for one in part.forces if isinstance(one, Steady)))

    return change


def blown(by: float) -> Callable[[Contribution], Contribution]:
    return lambda part: replace(part, forces=tuple(lambda p, v, t, one=one: by * one(p, v, t) for one in part.forces))


def pinned(**changes: Callable[[Pin], Any]) -> Callable[[Contribution], Contribution]:
    return lambda part: replace(
        part, pins=tuple(replace(pin, **{name: of(pin) for name, of in changes.items()}) for pin in part.pins)
    )


def filtered(by: float) -> Callable[[Contribution], Contribution]:
    return lambda part: replace(part, filters=tuple(lambda v, one=one: by * one(v) for one in part.filters))


def integrated(name: str, **changes: Any) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setitem(INTEGRATORS, name, replace(INTEGRATORS[name], **changes))


def predicted(name: str, target: float = 1.0, origin: float = 1.0) -> Callable[[pytest.MonkeyPatch], None]:
    """The target or the origin of an integrator, by how much of the way that it leads from the positions."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        integrator = INTEGRATORS[name]
        assert isinstance(integrator, Integrator)
        true = integrator.predict

        def lying(now: Any, before: Any, dt: float) -> tuple[Positions, Positions]:
            p, (aim, began) = now.positions, true(now, before, dt)
            return p + target * (aim - p), p + origin * (began - p)

        integrated(name, predict=lying)(patch)

    return tell


def patched(where: Any, name: str, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setattr(where, name, change(getattr(where, name)))


def planes(**changes: Callable[[Any], Any]) -> Callable[[Contact], Contact]:
    """The half-spaces of a step, changed."""
    return lambda energy: replace(
        energy, planes=energy.planes._replace(**{name: of(energy.planes) for name, of in changes.items()})
    )


def leaves_out(word: str) -> Callable[[Any], Any]:
    """`StepProblem.terms` without a term."""
    return lambda true: lambda self, p: {name: value for name, value in true(self, p).items() if name != word}

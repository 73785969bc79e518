"""Scenes as files declare them, and errors to plant in the terms of their steps, which the comparison must find."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from springbench.harness.scenes.effects.effect_interface import ConstantForceField, EffectContribution, PinGroup
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.mesh.mesh_table import MESH_CLASSES
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact
from springbench.solvers.model.integrators import INTEGRATORS, SingleStageIntegrator
from springbench.solvers.model.step_problem import Positions, System
from springbench.solvers.registry import load_target

from tests.oracles.verify_scene import verify_terms

INTEGRATOR_NAMES = ("implicit-euler", "bdf2", "midpoint")


def run_reference_check(spec: SceneSpec, size: int = 0, integrator: str = "implicit-euler") -> str:
    return verify_terms(spec, build_scene(spec, size, integrator), integrator)


MOTION_SPEC = {
    "key_frames": [{"time": 0}, {"time": 0.4, "offset": (0.1, 0.2, 0), "angle": 90}, {"time": 1, "angle": 30}]
}
SMOOTH_MOTION = MOTION_SPEC | {"interpolation": "smooth", "axis": (1, 2, 0), "pivot": (0.1, 0, 0.3)}
OBSTACLE_SPECS = [
    {"kind": "plane", "point": (0, -0.3, 0), "normal": (0.2, 1, 0)},
    {"kind": "sphere", "center": (0, -0.9, 0), "radius": 0.3, "motion": SMOOTH_MOTION},
    {"kind": "capsule", "end_points": [(0, -1, 0), (1, -1, 0.5)], "radius": 0.1, "motion": MOTION_SPEC},
    {"kind": "box", "low": (-0.2, -2, -0.2), "high": (0.3, -1.7, 0.4), "motion": MOTION_SPEC},
]
SPRINGS_SPEC = {"kind": "springs", "stretch": 300, "shear": 60}
BEND_SPRINGS_SPEC = {"kind": "springs", "stretch": 300, "shear": 60, "bend": 0.01}
PINS_SPEC = {"kind": "pins", "parts": ["top_corners"], "motion": SMOOTH_MOTION}
ATTACHMENTS_SPEC = {"kind": "attachments", "parts": ["bottom"], "stiffness": 50, "motion": MOTION_SPEC}
STRAIN_LIMITS_SPEC = {"kind": "strain-limits", "max_stretch": 1.02, "min_stretch": 0.98, "stiffness": 500}
GUSTS_SPEC = {"kind": "wind", "field": "gusts", "acts_on": "triangle", "velocity": (3, 0, 1), "lift_coefficient": 0.5}
BENDING_SPEC, DASHPOTS_SPEC = {"kind": "bending", "stiffness": 0.5}, {"kind": "dashpots", "stretch": 2}
RAYLEIGH_SPEC = {"kind": "rayleigh", "mass_coefficient": 0.5, "stiffness_coefficient": 0.02}
AIR_DRAG_SPEC, GRAVITY_SPEC = {"kind": "air-drag", "coefficient": 2}, {"kind": "gravity"}
FLOOR_SPEC = {"kind": "contact", "obstacles": OBSTACLE_SPECS, "friction": 0.3, "eps_v": 0.08}
ASSIGNED_WIND_SPEC = {"kind": "wind", "field": "assignment"}
FORCE_SPECS = [GRAVITY_SPEC, {"kind": "constant-force", "force": (0, 0, 0.1)}, ASSIGNED_WIND_SPEC]
DRAG_SPECS = [
    {"kind": "ether-drag", "decay_rate": 2},
    {"kind": "air-drag", "drag_law": "quadratic", "coefficient": 0.3},
]
BALLOON_SPEC = {"kind": "balloon"}
GAS_SPEC = {"kind": "gas", "pressure": 200}


def build_scene_spec(*effects: dict[str, Any], mesh: dict[str, Any] | None = None, **more: Any) -> SceneSpec:
    """Build the specification of a cloth, or of another mesh, with effects as a file declares them."""
    given = mesh or {"kind": "grid", "bend_springs": True}
    made = tuple(load_target(EFFECT_CLASSES[effect["kind"]]).model_validate(effect) for effect in effects)
    fields: dict[str, Any] = {"mass": 1.0, "time_step": 1 / 30, "frames": 40} | more
    return SceneSpec(
        mesh=load_target(MESH_CLASSES[given["kind"]])(**given), effects=made, path=Path("scene.yaml"), **fields
    )


def scale_fields(**fields: float) -> Callable[[Any], Any]:
    """Multiply fields of energies."""
    return lambda energy: replace(energy, **{name: by * getattr(energy, name) for name, by in fields.items()})


class FormulaMutation(NamedTuple):
    """A planted error.

    Attributes:
      effects: effects of the scene.
      expected_words: words that name the term which must differ.
      apply_patch: plants the error.
      integrator: name of the integrator.
      mesh: mesh of the scene, None for a cloth.
      size: mesh size.
    """

    effects: list[dict[str, Any]]
    expected_words: str
    apply_patch: Callable[[pytest.MonkeyPatch], None]
    integrator: str = "implicit-euler"
    mesh: dict[str, Any] | None = None
    size: int = 5


def mutate_energy(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Change every energy of a class when a scene is built."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        made = System.__init__

        def with_error(self: System, mass: Any, time_step: float, energies: Any = (), *more: Any, **named: Any) -> None:
            changed = tuple(change(one) if type(one) is kind else one for one in energies)
            made(self, mass, time_step, changed, *more, **named)

        patch.setattr(System, "__init__", with_error)

    return apply


def mutate_step_energy(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Change every energy of a class when a step begins."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        true = kind.begin_step
        patch.setattr(kind, "begin_step", lambda self, start: change(true(self, start)))

    return apply


def mutate_step_start(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Change the start of every step of an energy class."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        true = kind.begin_step
        patch.setattr(kind, "begin_step", lambda self, start: true(self, change(start)))

    return apply


def scale_method(kind: type, method: str, factor: float) -> Callable[[pytest.MonkeyPatch], None]:
    """Multiply the result of a method of a class, or what it adds to its last argument."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        true = getattr(kind, method)

        def with_error(self: Any, p: Positions, *out: Positions) -> Any:
            if not out:
                return factor * true(self, p)
            added = np.zeros_like(out[0])
            true(self, p, added)
            out[0][:] += factor * added
            return None

        patch.setattr(kind, method, with_error)

    return apply


def mutate_contribution(
    target: str, change: Callable[[EffectContribution], EffectContribution]
) -> Callable[[pytest.MonkeyPatch], None]:
    """Change the contribution of an effect."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        kind = load_target(EFFECT_CLASSES[target])
        true = kind.build_contribution
        patch.setattr(kind, "build_contribution", lambda *given: change(true(*given)))

    return apply


def scale_steady_forces(factor: float) -> Callable[[EffectContribution], EffectContribution]:
    def change(part: EffectContribution) -> EffectContribution:
        return replace(
            part,
            forces=tuple(
                ConstantForceField(factor * one.force) for one in part.forces if isinstance(one, ConstantForceField)
            ),
        )

    return change


def scale_forces(factor: float) -> Callable[[EffectContribution], EffectContribution]:
    return lambda part: replace(
        part, forces=tuple(lambda p, v, t, one=one: factor * one(p, v, t) for one in part.forces)
    )


def mutate_pins(**changes: Callable[[PinGroup], Any]) -> Callable[[EffectContribution], EffectContribution]:
    return lambda part: replace(
        part, pins=tuple(replace(pin, **{name: of(pin) for name, of in changes.items()}) for pin in part.pins)
    )


def scale_filters(factor: float) -> Callable[[EffectContribution], EffectContribution]:
    return lambda part: replace(
        part, velocity_filters=tuple(lambda v, one=one: factor * one(v) for one in part.velocity_filters)
    )


def mutate_integrator(name: str, **changes: Any) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setitem(INTEGRATORS, name, replace(INTEGRATORS[name], **changes))


def scale_prediction(name: str, target: float = 1.0, origin: float = 1.0) -> Callable[[pytest.MonkeyPatch], None]:
    """Scale the displacements of an integrator's target and origin from the current positions."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        integrator = INTEGRATORS[name]
        assert isinstance(integrator, SingleStageIntegrator)
        true = integrator.predict_target

        def with_error(now: Any, before: Any, dt: float) -> tuple[Positions, Positions]:
            p, (aim, began) = now.positions, true(now, before, dt)
            return p + target * (aim - p), p + origin * (began - p)

        mutate_integrator(name, predict_target=with_error)(patch)

    return apply


def patch_attribute(where: Any, name: str, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setattr(where, name, change(getattr(where, name)))


def mutate_half_spaces(**changes: Callable[[Any], Any]) -> Callable[[HalfSpaceContact], HalfSpaceContact]:
    """Change the half-spaces of a step."""
    return lambda energy: replace(
        energy,
        active_planes=energy.active_planes._replace(**{name: of(energy.active_planes) for name, of in changes.items()}),
    )


def drop_term(word: str) -> Callable[[Any], Any]:
    """Return `StepProblem.evaluate_terms` without a term."""
    return lambda true: lambda self, p: {name: value for name, value in true(self, p).items() if name != word}

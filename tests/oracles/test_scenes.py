"""The second opinion agrees with every shipped scene and hard case, holds what comes from outside against itself, and
disputes the runs of steps that it finds wrong."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.effects.effect_interface import EffectContribution, PinGroup
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies.quadratic_energy import Quadratic
from springbench.solvers.model.integrators import INTEGRATORS
from springbench.solvers.model.step_problem import Energy, Positions

from tests.oracles.planted_errors import (
    AIR_DRAG_SPEC,
    ATTACHMENTS_SPEC,
    BALLOON_SPEC,
    BEND_SPRINGS_SPEC,
    BENDING_SPEC,
    DASHPOTS_SPEC,
    DRAG_SPECS,
    FLOOR_SPEC,
    FORCE_SPECS,
    GAS_SPEC,
    GRAVITY_SPEC,
    GUSTS_SPEC,
    INTEGRATOR_NAMES,
    PINS_SPEC,
    RAYLEIGH_SPEC,
    SPRINGS_SPEC,
    STRAIN_LIMITS_SPEC,
    build_scene_spec,
    patch_attribute,
    run_reference_check,
)

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SCENES = {path.stem: path for path in sorted((CONFIGS / "scenes").glob("*.yaml"))}
HARD = {path.stem: path for folder in ("hard", "hard-long") for path in sorted((CONFIGS / folder).glob("*.yaml"))}
SIZES = {"pulled-curtain": 9}
"""Mesh sizes of scenes whose pins ask for them."""


@pytest.mark.parametrize("name", SCENES)
def test_both_opinions_agree_on_a_scene(name: str):
    spec = load_scene(SCENES[name])
    # A third of the size has the same formulas and takes a tenth of the time; the integrators take turns.
    size = SIZES.get(name) or max(getattr(spec.mesh, "MIN_SIZE", 2), (spec.default_size or 0) // 3)
    assert run_reference_check(spec, size, INTEGRATOR_NAMES[list(SCENES).index(name) % 3]) == "agrees"


@pytest.mark.parametrize("name", HARD)
def test_both_opinions_agree_on_a_hard_case(name: str):
    spec = load_scene(HARD[name])
    assert run_reference_check(spec, spec.default_size or 0) == "agrees"


@pytest.mark.long
@pytest.mark.parametrize("integrator", INTEGRATOR_NAMES)
@pytest.mark.parametrize("name", [*SCENES, *HARD])
def test_both_opinions_agree_with_every_integrator_at_full_size(name: str, integrator: str):
    spec = load_scene((SCENES | HARD)[name])
    assert run_reference_check(spec, spec.default_size or 0, integrator) == "agrees"


@pytest.mark.parametrize("integrator", [*INTEGRATOR_NAMES, "sdirk-2"])
def test_both_opinions_agree_where_all_effects_are(integrator: str):
    every = [
        BEND_SPRINGS_SPEC,
        PINS_SPEC,
        ATTACHMENTS_SPEC,
        STRAIN_LIMITS_SPEC,
        GUSTS_SPEC,
        BENDING_SPEC,
        DASHPOTS_SPEC,
        RAYLEIGH_SPEC,
        AIR_DRAG_SPEC,
        FLOOR_SPEC,
        *FORCE_SPECS,
        *DRAG_SPECS,
    ]
    assert run_reference_check(build_scene_spec(*every, velocity=(0.1, 0.2, 0.3)), 5, integrator) == "agrees"
    gas = [
        SPRINGS_SPEC,
        GAS_SPEC,
        STRAIN_LIMITS_SPEC,
        GUSTS_SPEC,
        BENDING_SPEC,
        DASHPOTS_SPEC,
        RAYLEIGH_SPEC,
        AIR_DRAG_SPEC,
        *FORCE_SPECS,
    ]
    assert run_reference_check(build_scene_spec(*gas, mesh=BALLOON_SPEC), 2, integrator) == "agrees"


def test_steps_of_two_lengths_are_compared(monkeypatch: pytest.MonkeyPatch):
    spec = build_scene_spec(SPRINGS_SPEC, PINS_SPEC, DASHPOTS_SPEC, FLOOR_SPEC, *DRAG_SPECS, alternate_time_step=1 / 50)
    assert run_reference_check(spec, 5) == "agrees"
    patch_attribute(Scene, "compute_time", lambda true: lambda self, index: index * self.system.time_step)(monkeypatch)
    assert "times" in run_reference_check(spec, 5)


class Well(Quadratic):
    """A well that draws every vertex to the origin; the name is that of no shipped energy."""


class Cone:
    """w |p| for each vertex: no function of complex numbers, for it takes lengths by `numpy.linalg.norm`."""

    def __init__(self, weight: float, told: float) -> None:
        self.weight, self.told = weight, told

    def value(self, p: Positions) -> float:
        return self.weight * float(np.linalg.norm(p, axis=1).sum())

    def add_gradient(self, p: Positions, out: Positions) -> None:
        out += self.told * p / np.linalg.norm(p, axis=1)[:, None]

    def hessian(self, p: Positions) -> csr_array:
        return csr_array((p.size, p.size))


class Cast(Cone):
    """The same, made a real number on the way, at which NumPy warns of what is lost."""

    def value(self, p: Positions) -> float:
        return self.weight * float(np.sqrt((p**2).sum(axis=1)).sum())


class Outside(ConfigModel):
    """An effect that nobody but its author knows."""

    kind: Literal["magnet"] = "magnet"
    told: float = 3.0
    """The gradient in parts of what it should be, times 3."""
    shape: Literal["well", "cone", "cast"] = "well"

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        n = len(mass)
        well = Well(csr_array(np.eye(n)), np.full(n, 3.0), np.zeros((n, 3)))
        if self.told != 3.0:
            true = well.add_gradient
            object.__setattr__(well, "add_gradient", lambda p, out: scaled_sum(true, p, out, self.told / 3.0))
        energy: Energy = well if self.shape == "well" else (Cone if self.shape == "cone" else Cast)(3.0, self.told)
        return EffectContribution(
            energies=(energy,),
            forces=(lambda p, v, t: 0.1 * np.sin(p) - v + t,),
            velocity_filters=(lambda v: 0.99 * v,),
            pins=(PinGroup(np.array([0]), mesh.rest_positions[:1], 1e5),),
        )


def scaled_sum(true: Callable[[Positions, Positions], None], p: Positions, out: Positions, by: float) -> None:
    added = np.zeros_like(out)
    true(p, added)
    out += by * added


STAGED = [name for name in INTEGRATORS if name not in INTEGRATOR_NAMES]


@pytest.mark.parametrize("integrator", STAGED)
def test_both_opinions_agree_with_every_integrator_of_several_unknowns(integrator: str):
    assert (
        run_reference_check(build_scene_spec(SPRINGS_SPEC, PINS_SPEC, GUSTS_SPEC, *DRAG_SPECS), 3, integrator)
        == "agrees"
    )


@pytest.mark.parametrize("integrator", [name for name in STAGED if hasattr(INTEGRATORS[name], "a")])
def test_a_weight_that_is_wrong_by_a_millionth_is_told(integrator: str, monkeypatch: pytest.MonkeyPatch):
    method: Any = INTEGRATORS[integrator]
    rows = [list(row) for row in method.a]
    rows[-1][0] += 1e-6
    monkeypatch.setitem(INTEGRATORS, integrator, replace(method, a=tuple(map(tuple, rows))))
    assert "target" in run_reference_check(build_scene_spec(SPRINGS_SPEC), 3, integrator)


@pytest.mark.parametrize("integrator", INTEGRATOR_NAMES)
@pytest.mark.parametrize("shape", ["well", "cone", "cast"])
def test_an_effect_from_outside_is_held_against_its_own_value(shape: Any, integrator: str):
    spec = build_scene_spec(SPRINGS_SPEC, GRAVITY_SPEC, FLOOR_SPEC)
    known = spec.effects

    def asked(outside: Outside) -> str:
        return run_reference_check(spec.model_copy(update={"effects": (*known, outside)}), 4, integrator)

    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        assert asked(Outside(shape=shape)) == "single opinion: effects[3] magnet"
    assert [str(one.message) for one in heard] == []
    assert asked(Outside(shape=shape, told=3.003)).startswith(
        "disagrees: effects[3] magnet (gradient against its own value)"
    )


def test_an_effect_that_takes_a_known_name_is_from_outside():
    class Springs(Outside):
        kind: Literal["springs"] = "springs"  # pyright: ignore[reportIncompatibleVariableOverride]

    spec = build_scene_spec(GRAVITY_SPEC)
    spec = spec.model_copy(update={"effects": (*spec.effects, Springs())})
    assert run_reference_check(spec, 4) == "single opinion: effects[1] springs"


def test_damping_of_what_comes_from_outside_has_no_second_opinion():
    spec = build_scene_spec(SPRINGS_SPEC, RAYLEIGH_SPEC)
    spec = spec.model_copy(update={"effects": (*spec.effects, Outside())})
    assert run_reference_check(spec, 4) == "single opinion: effects[1] rayleigh, effects[2] magnet"

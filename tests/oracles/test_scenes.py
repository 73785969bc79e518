"""Both implementations of the step's terms agree on every scene of the configs, and on all effects and integrators."""

from __future__ import annotations

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
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies.quadratic_energy import Quadratic
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.integrators import INTEGRATORS

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
    scale_method,
)

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SIZES = {"pulled-curtain": 9, "touching-curtain": 9}
"""Mesh sizes of scenes whose pins require them."""


def find_scenes(*folders: str) -> dict[str, Path]:
    """Return the scene files of folders of `configs`, by name."""
    return {f"{folder}/{path.stem}": path for folder in folders for path in sorted((CONFIGS / folder).glob("*.yaml"))}


SCENES = find_scenes("scenes")
VERIFIED_SCENES = find_scenes("hard", "hard-long", "exact")
"""Scenes of the published sweeps with `verify: true`."""
TOUCHING = {"unseen/cloth-over-ball", "unseen/sheets-pressed"}
"""Scenes with contact in folders of scenes without."""
UNSEEN_SCENES = find_scenes("unseen")
OTHERS = find_scenes("hessians", "stiff", "winners") | {
    name: path for name, path in UNSEEN_SCENES.items() if name not in TOUCHING
}
CONTACT = find_scenes("contact-accuracy", "growth", "hard-touch", "touch") | {
    name: UNSEEN_SCENES[name] for name in TOUCHING
}


def coarse_size(spec: SceneSpec) -> int:
    """Return a third of the default size: it has the same formulas and takes a tenth of the time."""
    return SIZES.get(spec.path.stem) or max(getattr(spec.mesh, "MIN_SIZE", 2), (spec.default_size or 0) // 3)


@pytest.mark.parametrize("name", SCENES | OTHERS)
def test_both_implementations_agree_on_a_coarse_scene(name: str):
    spec = load_scene((SCENES | OTHERS)[name])
    integrator = INTEGRATOR_NAMES[[*SCENES, *OTHERS].index(name) % len(INTEGRATOR_NAMES)]
    assert run_reference_check(spec, coarse_size(spec), integrator) == "agrees"


@pytest.mark.parametrize("name", VERIFIED_SCENES)
def test_both_implementations_agree_on_a_verified_scene(name: str):
    spec = load_scene(VERIFIED_SCENES[name])
    assert run_reference_check(spec, spec.default_size or 0) == "agrees"


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(CONTACT))
def test_both_implementations_agree_on_a_coarse_scene_with_contact(name: str):
    spec = load_scene(CONTACT[name])
    assert run_reference_check(spec, coarse_size(spec)) == "agrees"


@pytest.mark.long
@pytest.mark.parametrize("integrator", INTEGRATOR_NAMES)
@pytest.mark.parametrize("name", SCENES | VERIFIED_SCENES | OTHERS)
def test_both_implementations_agree_with_every_integrator_at_full_size(name: str, integrator: str):
    spec = load_scene((SCENES | VERIFIED_SCENES | OTHERS)[name])
    assert run_reference_check(spec, spec.default_size or 0, integrator) == "agrees"


def test_every_scene_of_the_configs_is_compared():
    compared = {path for paths in (SCENES, VERIFIED_SCENES, OTHERS, CONTACT) for path in paths.values()}
    assert compared == set(CONFIGS.glob("*/*.yaml"))


@pytest.mark.parametrize("integrator", [*INTEGRATOR_NAMES, "sdirk-2"])
def test_both_implementations_agree_on_all_effects_together(integrator: str):
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


class Magnet(ConfigModel):
    """An effect from user code, with a term of each kind."""

    kind: Literal["magnet"] = "magnet"

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        n = len(mass)
        return EffectContribution(
            energies=(Quadratic(csr_array(np.eye(n)), np.full(n, 3.0), np.zeros((n, 3))),),
            forces=(lambda p, v, t: 0.1 * np.sin(p) - v + t,),
            velocity_filters=(lambda v: 0.99 * v,),
            pins=(PinGroup(np.array([0]), mesh.rest_positions[:1], 1e5),),
        )


MULTISTAGE_INTEGRATORS = [name for name in INTEGRATORS if name not in INTEGRATOR_NAMES]


@pytest.mark.parametrize("integrator", MULTISTAGE_INTEGRATORS)
def test_both_implementations_agree_with_integrators_of_several_stages(integrator: str):
    assert (
        run_reference_check(build_scene_spec(SPRINGS_SPEC, PINS_SPEC, GUSTS_SPEC, *DRAG_SPECS), 3, integrator)
        == "agrees"
    )


@pytest.mark.parametrize("integrator", [name for name in MULTISTAGE_INTEGRATORS if hasattr(INTEGRATORS[name], "a")])
def test_a_weight_that_is_wrong_by_a_millionth_is_found(integrator: str, monkeypatch: pytest.MonkeyPatch):
    method: Any = INTEGRATORS[integrator]
    rows = [list(row) for row in method.a]
    rows[-1][0] += 1e-6
    monkeypatch.setitem(INTEGRATORS, integrator, replace(method, a=tuple(map(tuple, rows))))
    assert "target" in run_reference_check(build_scene_spec(SPRINGS_SPEC), 3, integrator)


def check_with_user_code(*effects: dict[str, Any], user_effect: Magnet, integrator: str = "implicit-euler") -> str:
    spec = build_scene_spec(*effects)
    return run_reference_check(spec.model_copy(update={"effects": (*spec.effects, user_effect)}), 4, integrator)


@pytest.mark.parametrize("integrator", INTEGRATOR_NAMES)
def test_shipped_effects_agree_where_user_code_contributes(integrator: str, monkeypatch: pytest.MonkeyPatch):
    effects = SPRINGS_SPEC, GRAVITY_SPEC, FLOOR_SPEC
    found = check_with_user_code(*effects, user_effect=Magnet(), integrator=integrator)
    assert found == "agrees without: effects[3] magnet"
    scale_method(Springs, "add_gradient", 1.0001)(monkeypatch)
    found = check_with_user_code(*effects, user_effect=Magnet(), integrator=integrator)
    assert found.startswith("disagrees: effects[0] springs (gradient)")


def test_user_code_that_takes_a_shipped_name_has_no_reference():
    class OwnSprings(Magnet):
        kind: Literal["springs"] = "springs"  # pyright: ignore[reportIncompatibleVariableOverride]

    assert check_with_user_code(GRAVITY_SPEC, user_effect=OwnSprings()) == "agrees without: effects[1] springs"


def test_damping_of_energies_from_user_code_has_no_reference():
    found = check_with_user_code(SPRINGS_SPEC, RAYLEIGH_SPEC, user_effect=Magnet())
    assert found == "agrees without: effects[1] rayleigh, effects[2] magnet"

"""Materials of cloth as tests and tables state them: modulus and thickness, bending length, published fabrics."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import springbench
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.fabric_table import IMPLAUSIBLE_FACTOR, MEMBRANE_RANGE, PUBLISHED_FABRICS
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.solvers.model.energies.bending_energy import Bending

CLOTH = "mesh: {kind: grid, diagonals: both}\ntime_step: 0.1\nframes: 1\n"


def load_text(tmp_path: Path, text: str) -> Scene:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    return build_scene(load_scene(path), 5)


def build_cloth(tmp_path: Path, *effects: str, mass: str = "mass_per_area: 0.2") -> Scene:
    listed = "".join(f"  - {{{effect}}}\n" for effect in effects)
    return load_text(tmp_path, f"{CLOTH}{mass}\neffects:\n{listed}")


def find_bending(scene: Scene) -> Bending:
    return next(energy for energy in scene.system.energies if isinstance(energy, Bending))


def test_a_modulus_times_a_thickness_is_a_membrane_stiffness(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, "springbench"):
        scene = build_cloth(tmp_path, "kind: springs, youngs_modulus: 5.0e+5, thickness: 4.0e-4")
    np.testing.assert_allclose(scene.all_springs.stiffness, 200.0, rtol=1e-14)
    assert "make a stretch of 200 N/m" in caplog.text


@pytest.mark.parametrize(
    ("mesh", "effect", "needle"),
    [
        ("grid", "youngs_modulus: 1.0", "`thickness` [m] is missing"),
        ("block", "youngs_modulus: 1.0, thickness: 1.0", "no meaning for a solid"),
        ("chain", "youngs_modulus: 1.0, thickness: 1.0", "axial stiffness EA"),
        ("grid", "stretch: 1, youngs_modulus: 1.0, thickness: 1.0", "leave out one of them"),
        ("grid", "stretch: 1, thickness: 1.0", "needs a `youngs_modulus`"),
        ("grid", "youngs_modulus: 1.0, thickness: 1.0, scaling_rule: fixed", "scaling rule `continuum` or `area`"),
        ("grid", "", "`stretch` is missing"),
    ],
)
def test_a_modulus_that_does_not_fit_is_refused(tmp_path: Path, mesh: str, effect: str, needle: str):
    text = f"mesh: {{kind: {mesh}}}\nmass: 1\ntime_step: 0.1\nframes: 1\neffects: [{{kind: springs, {effect}}}]\n"
    with pytest.raises(InputError, match=re.escape(needle)):
        load_text(tmp_path, text.replace(", }", "}"))


def test_a_bending_length_is_a_rigidity_by_the_weight(tmp_path: Path):
    stated = find_bending(build_cloth(tmp_path, f"kind: bending, stiffness: {0.2 * 9.81 * 0.02**3!r}"))
    for given in ("0.02", "{warp: 0.04, weft: 0.01}"):
        found = find_bending(build_cloth(tmp_path, f"kind: bending, bending_length: {given}"))
        np.testing.assert_allclose(found.weight, stated.weight, rtol=1e-12)
    mean = find_bending(build_cloth(tmp_path, "kind: bending, stiffness: {warp: 4.0e-6, weft: 1.0e-6}"))
    np.testing.assert_allclose(
        mean.weight, find_bending(build_cloth(tmp_path, "kind: bending, stiffness: 2.0e-6")).weight, rtol=1e-12
    )
    for wrong in ("", ", stiffness: 1, bending_length: 1"):
        with pytest.raises(InputError, match=r"effects\[0\]"):
            build_cloth(tmp_path, f"kind: bending{wrong}")


@pytest.mark.parametrize("name", PUBLISHED_FABRICS)
def test_a_fabric_provides_what_a_scene_leaves_out(tmp_path: Path, name: str):
    fabric = PUBLISHED_FABRICS[name]
    scene = build_cloth(tmp_path, "kind: springs", "kind: bending", mass=f"fabric: {name}")
    assert scene.system.mass.sum() == pytest.approx(fabric.density)
    assert set(np.round(scene.all_springs.stiffness, 9)) == {
        round((fabric.warp * fabric.weft) ** 0.5, 9),
        round(fabric.shear, 9),
    }
    rigidity = build_cloth(tmp_path, f"kind: bending, stiffness: {fabric.rigidity!r}")
    np.testing.assert_array_equal(find_bending(scene).weight, find_bending(rigidity).weight)
    low, high = fabric.rigidity_range
    assert low <= fabric.rigidity <= high
    assert fabric.weft <= fabric.warp


def test_a_fabric_with_a_warp_distinguishes_the_threads(tmp_path: Path):
    scene = build_cloth(tmp_path, "kind: springs", mass="fabric: {name: 11oz-black-denim, warp: [0, 0, 1]}")
    assert {*scene.all_springs.stiffness.round(6)} == {1014.0, 205.0, 53.4}


def test_what_a_scene_states_takes_precedence_over_its_fabric(tmp_path: Path):
    scene = build_cloth(tmp_path, "kind: springs, stretch: 7, shear: 3", mass="fabric: royal-target")
    assert {*scene.all_springs.stiffness} == {7.0, 3.0}
    for text, needle in (
        ("fabric: royal-targt", "did you mean 'royal-target'"),
        ("mass: 1\nfabric: royal-target", "provides nothing"),
        ("fabric: {name: royal-target, weft: [1, 0, 0]}", "weft"),
    ):
        with pytest.raises(InputError, match=needle):
            build_cloth(tmp_path, "kind: springs, stretch: 7", mass=text)


def test_a_fabric_completes_an_effect_object():
    fields: dict[str, Any] = {"mesh": {"kind": "grid"}, "mass": 1.0, "time_step": 0.1, "frames": 1}
    fields["fabric"] = "royal-target"
    given, spring = SpringsEffect(scaling_rule="area"), {"kind": "springs", "scaling_rule": "area"}
    (made,) = springbench.make_scene(effects=[given], **fields).effects
    assert made == springbench.make_scene(effects=[spring], **fields).effects[0]
    assert made.stretch is not None
    with pytest.raises(InputError, match="provides nothing"):
        springbench.make_scene(effects=[SpringsEffect(stretch=5.0)], **fields)


@pytest.mark.parametrize("mesh", ["chain", "block"])
def test_a_mesh_that_is_no_cloth_has_no_fabric(tmp_path: Path, mesh: str):
    text = f"mesh: {{kind: {mesh}}}\nmass: 1\nfabric: royal-target\ntime_step: 0.1\nframes: 1\n"
    with pytest.raises(InputError, match=r"fabric: is the material of a cloth"):
        load_text(tmp_path, text + "effects: [{kind: springs}]\n")


@pytest.mark.parametrize(
    ("mass", "effect", "needle"),
    [
        ("mass_per_area: 0.2", "kind: springs, stretch: 5.0e+6", "given in Pa"),
        ("mass_per_area: 0.2", "kind: springs, stretch: 0.1", "N/mm"),
        ("mass_per_area: 150", "kind: springs, stretch: 100", "0.15 kg/m"),
        ("mass_per_area: 0.2", "kind: bending, stiffness: 20", "uN m"),
        ("mass_per_area: 0.2", "kind: springs, youngs_modulus: 5.0e+5, thickness: 0.5", "`thickness` given in mm"),
        ("mass_per_area: 0.2", "kind: bending, bending_length: 21", "`bending_length` given in mm"),
        ("mass_per_area: 0.2", "kind: bending, bending_length: 0.021", ""),
        ("mass_per_area: 0.2", "kind: springs, stretch: 100", ""),
        ("mass_per_area: 0.2", "kind: springs, stretch: 5.0e+6, scaling_rule: fixed", ""),
    ],
)
def test_a_material_far_from_all_fabrics_causes_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, mass: str, effect: str, needle: str
):
    with caplog.at_level(logging.WARNING, "springbench"):
        build_cloth(tmp_path, effect, mass=mass)
    assert (needle in caplog.text) if needle else not caplog.text


def test_values_within_the_factor_cause_no_warning():
    assert not MEMBRANE_RANGE.describe_outlier(MEMBRANE_RANGE.high * IMPLAUSIBLE_FACTOR)
    assert MEMBRANE_RANGE.describe_outlier(MEMBRANE_RANGE.high * IMPLAUSIBLE_FACTOR * 1.01)
    assert not MEMBRANE_RANGE.describe_outlier(0.0)


def test_the_page_shows_the_table():
    page = (Path(__file__).parents[2] / "configs" / "howto" / "networks-and-fabrics.md").read_text()
    for name, fabric in PUBLISHED_FABRICS.items():
        row = next(line for line in page.splitlines() if line.startswith(f"| `{name}` |"))
        numbers = [float(number) for number in re.findall(r"\d+\.?\d*", row.split(f"`{name}`")[1])]
        assert numbers[:5] == pytest.approx(
            [fabric.density, fabric.warp, fabric.weft, fabric.shear, 1e6 * fabric.rigidity]
        )

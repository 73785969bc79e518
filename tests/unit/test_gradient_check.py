"""Energies from user code: at run time each gradient is compared with the derivative of its energy's own value."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments import run_pipeline
from springbench.harness.reference.gradient_check import measure_gradient_errors
from springbench.harness.report.robustness import WRONG_GRADIENT, classify_run
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies.quadratic_energy import Quadratic
from springbench.solvers.model.step_problem import Energy, Positions, StepStart

from tests.scene_builders import build_test_scene

FRAMES = 40


class Well(Quadratic):
    """A well that draws every vertex to the origin; its value is analytic."""


class Cone:
    """w |p| for each vertex, by a norm that is not analytic."""

    def __init__(self, weight: float, slope: float) -> None:
        self.weight, self.slope = weight, slope

    def value(self, p: Positions) -> float:
        return self.weight * float(np.linalg.norm(p, axis=1).sum())

    def add_gradient(self, p: Positions, out: Positions) -> None:
        out += self.slope * p / np.linalg.norm(p, axis=1)[:, None]

    def hessian(self, p: Positions) -> csr_array:
        return csr_array((p.size, p.size))


class RealCone(Cone):
    """A cone whose value drops the imaginary part, of which NumPy warns."""

    def value(self, p: Positions) -> float:
        return self.weight * float(np.sqrt((p**2).sum(axis=1)).sum())


class RealOnlyCone(Cone):
    """A cone that refuses complex positions."""

    def value(self, p: Positions) -> float:
        assert not np.iscomplexobj(p)
        return super().value(p)


class MovingCone(Cone):
    """A cone whose tip moves: its gradient is right at the first step's end and wrong later if `slope` differs."""

    def begin_step(self, start: StepStart) -> Energy:
        late = start.time > 0.0
        return Cone(self.weight, self.slope if late else self.weight)


class NotANumber(Cone):
    """A cone without a gradient."""

    def add_gradient(self, p: Positions, out: Positions) -> None:
        out += np.nan


WEIGHT = 3.0


def build_well(slope: float) -> Energy:
    well = Well(csr_array(np.eye(25)), np.full(25, WEIGHT), np.zeros((25, 3)))
    if slope != WEIGHT:
        true = well.add_gradient
        object.__setattr__(well, "add_gradient", lambda p, out: add_scaled(true, p, out, slope / WEIGHT))
    return well


def add_scaled(add: Callable[[Positions, Positions], None], p: Positions, out: Positions, factor: float) -> None:
    added = np.zeros_like(out)
    add(p, added)
    out += factor * added


ENERGIES: dict[str, Callable[[float], Energy]] = {
    "Well": build_well,
    **{one.__name__: lambda slope, one=one: one(WEIGHT, slope) for one in (Cone, RealCone, RealOnlyCone, MovingCone)},
}


class Magnet(ConfigModel):
    """An effect from user code."""

    kind: Literal["magnet"] = "magnet"
    energy: str = "Well"
    slope: float = WEIGHT

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        return EffectContribution(energies=(ENERGIES[self.energy](self.slope),))


def build_magnet_scene(energy: str, slope: float, integrator: str) -> Scene:
    effects = SpringsEffect(stretch=300.0), GravityEffect(), Magnet(energy=energy, slope=slope)
    given = {"mesh": GridMesh(), "mass": 1.0, "time_step": 1 / 30, "frames": FRAMES, "path": Path("scene.yaml")}
    return build_scene(SceneSpec.model_validate(given | {"effects": effects}), 5, integrator)


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "midpoint", "sdirk-2"])
@pytest.mark.parametrize("energy", ENERGIES)
def test_a_gradient_of_user_code_is_compared_with_its_value(energy: str, integrator: str):
    with warnings.catch_warnings(action="error"):
        assert measure_gradient_errors(build_magnet_scene(energy, WEIGHT, integrator), FRAMES) == {energy: 0.0}
    (error,) = measure_gradient_errors(build_magnet_scene(energy, 1.001 * WEIGHT, integrator), FRAMES).values()
    assert error == pytest.approx(1e-3, rel=0.9)  # relative to the sum of absolute values along a random direction


def test_a_gradient_that_is_not_finite_is_infinitely_wrong(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(ENERGIES, "NotANumber", lambda slope: NotANumber(WEIGHT, slope))
    assert measure_gradient_errors(build_magnet_scene("NotANumber", WEIGHT, "bdf2"), FRAMES) == {"NotANumber": np.inf}


def test_shipped_energies_are_not_checked_at_run_time(monkeypatch: pytest.MonkeyPatch):
    scene = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), GravityEffect(), size=5)
    for energy in scene.system.energies:
        monkeypatch.setattr(type(energy), "add_gradient", lambda *given: pytest.fail("was evaluated"))
    assert measure_gradient_errors(scene, FRAMES) == {}


SCENE = """mesh: {{kind: grid}}
mass: 1
time_step: 0.03
frames: 2
default_size: 4
effects: [{{kind: gravity}}, {{kind: springs, stretch: 100}}, {{kind: pins, parts: [left]}}{more}]
"""
USER_CODE = """
from typing import Literal
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.schema.base_model import ConfigModel
from scipy.sparse import eye_array

class Funnel:
    def __init__(self, slope):
        self.slope = slope
    def value(self, p):
        return 1.5 * float((p**2).sum())
    def add_gradient(self, p, out):
        out += self.slope * p
    def hessian(self, p):
        return self.slope * eye_array(p.size, format="csr")

class Magnet(ConfigModel):
    kind: Literal["magnet"] = "magnet"
    slope: float
    def build_contribution(self, mesh, mass, time_step):
        return EffectContribution(energies=(Funnel(self.slope),))
"""


def run_scene(folder: Path, more: str, *, verify: bool = True) -> list[dict[str, Any]]:
    """Rows of the steps of a short run with Newton's method."""
    (folder / "magnet.py").write_text(USER_CODE)
    (folder / "scene.yaml").write_text(SCENE.format(more=more))
    options = {"rtol": 1e-6, "rounds": 1, "verify": verify, "record": False, "max_iterations": 200}
    (run,) = load_config(folder / "scene.yaml", solvers=["newton"], **options).list_runs()
    files = run_pipeline.RunFiles.for_run(run, folder)
    files.rows_path.parent.mkdir(exist_ok=True)
    absent = {"frame": None, "reason": None}
    rows = run_pipeline.execute_run(run, files, lambda phase: None)
    return [absent | row for row in rows if row["phase"] == "step"]


MAGNET = ', {{kind: "./magnet.py:Magnet", slope: {slope}}}'


@pytest.mark.parametrize(("more", "check"), [("", "release"), (MAGNET.format(slope=3.0), "gradient: Funnel")])
def test_a_verified_run_states_how_its_energies_were_checked(tmp_path: Path, more: str, check: str):
    rows = run_scene(tmp_path, more)
    assert {(row["status"], row["formula_check"]) for row in rows} == {("ok", check)}


def test_a_run_with_a_wrong_gradient_is_not_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(run_pipeline, "measure_gradient_errors", lambda *given: {"Funnel": 0.0123, "Well": 0.0})
    rows = run_scene(tmp_path, "")
    assert {(row["status"], row["formula_check"]) for row in rows} == {("wrong-gradient", "gradient: Funnel, Well")}
    verdict = classify_run(rows)
    assert verdict.outcome is WRONG_GRADIENT
    assert "the derivative of its energy's value: that of Funnel by 0.012 of its size; mend" in verdict.reason


def test_a_run_that_is_not_verified_is_not_checked(tmp_path: Path):
    rows = run_scene(tmp_path, "", verify=False)
    assert {(row["status"], row.get("formula_check")) for row in rows} == {("ok", None)}

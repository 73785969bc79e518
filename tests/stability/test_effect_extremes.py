"""Each effect at the extremes of its parameters: positions stay finite, nothing leaves the room, objectives descend."""

from __future__ import annotations

import numpy as np
import pytest
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.attachments_effect import AttachmentsEffect
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.gas_effect import GasEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.rayleigh_effect import RayleighEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.strain_limits_effect import StrainLimitsEffect
from springbench.harness.scenes.effects.wind_effect import WindEffect
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.step_problem import ProjectiveEnergy, Solver, StopRule
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

from tests.scene_builders import build_test_scene

TINY, HUGE = 1e-9, 1e9
LEAP = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=1e-6, offset=(0.3, 0.0, 0.0), angle=3e4)))

EFFECTS: dict[str, SceneEffect] = {
    "bending of 1e9 N m": BendingEffect(stiffness=HUGE),
    "bending of 1e-9 N m": BendingEffect(stiffness=TINY),
    "limits of 1e9 N/m about the rest length": StrainLimitsEffect(max_stretch=1.0, min_stretch=0.999, stiffness=HUGE),
    "limits of 1e-9 N/m": StrainLimitsEffect(max_stretch=1.0, stiffness=TINY),
    "dashpots of 1e9 N s/m": DashpotsEffect(stretch=HUGE),
    "Rayleigh damping of 1e9": RayleighEffect(mass_coefficient=HUGE, stiffness_coefficient=HUGE),
    "linear drag of 1e9 N s/m": AirDragEffect(coefficient=HUGE),
    "quadratic drag of 1e9 kg/m": AirDragEffect(drag_law="quadratic", coefficient=HUGE),
    "attachments of 1e9 N/m": AttachmentsEffect(parts=("bottom",), stiffness=HUGE),
    "attachments that leap": AttachmentsEffect(parts=("bottom",), stiffness=100.0, motion=LEAP),
    "pins that leap": PinsEffect(parts=("bottom",), motion=LEAP),
    "a storm of 300 m/s": WindEffect(acts_on="triangle", velocity=(0.0, 300.0, 0.0), lift_coefficient=2.0),
    "air as dense as 1e9 kg/m^3": WindEffect(acts_on="triangle", velocity=(0.0, 1.0, 0.0), air_density=HUGE),
}
TIME_STEPS = (1e-5, 1 / 30, 1.0)


def runs_well(made: Scene, solver: Solver, reach: float) -> None:
    Q = assemble_system_matrix(
        made.system, [energy for energy in made.system.energies if isinstance(energy, ProjectiveEnergy)]
    )
    # What objectives of sums of some hundred terms, and positions of order one that a solve has to 1e-12, leave.
    round_off, displaced = 1e-12, Q.trace() * 1e-12**2
    for step in simulate_scene(made, prepare(made, solver), StopRule(30), initial_guess="previous", frames=8):
        assert np.isfinite(step.positions).all()
        assert np.abs(step.positions).max() <= reach
        begin, end = (step.problem.value(p) for p in (step.problem.initial_guess, step.solution.positions))
        assert end <= begin + round_off * step.problem.value_scale(step.solution.positions) + displaced


@pytest.mark.parametrize("time_step", TIME_STEPS)
@pytest.mark.parametrize("solver", [SparseLocalGlobal(), Lbfgs()], ids=["sparse", "lbfgs"])
@pytest.mark.parametrize("effect", EFFECTS)
def test_a_cloth_with_an_effect_at_its_extreme_stays_in_the_room(effect, solver, time_step):
    pins = PinsEffect(parts=("top",))
    made = build_test_scene(
        GridMesh(),
        SpringsEffect(stretch=300.0),
        GravityEffect(),
        pins,
        EFFECTS[effect],
        size=6,
        mass=0.1,
        time_step=time_step,
    )
    # A cloth of a metre that hangs by its top; a step of a second can throw a corner some lengths before springs catch
    # it, and the storm's first step blows what is loose as far as the air goes in a second.
    runs_well(made, solver, 300.0 if "storm" in effect else 15.0)


@pytest.mark.parametrize("time_step", TIME_STEPS)
@pytest.mark.parametrize("pressure", [1e-9, 1.0, 1e4, 1e7])
def test_a_balloon_at_any_pressure_has_a_positive_volume(pressure, time_step):
    made = build_test_scene(
        BalloonMesh(),
        SpringsEffect(stretch=100.0),
        GravityEffect(),
        GasEffect(pressure=pressure),
        PinsEffect(parts=("pole_top",)),
        size=3,
        mass=0.1,
        time_step=time_step,
    )
    # At 1e7 Pa the membrane balances at a radius of 120 m, by 2 T / R = p.
    runs_well(made, Lbfgs(), 5.0 if pressure < 1e3 else 400.0)

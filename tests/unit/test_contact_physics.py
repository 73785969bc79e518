"""Contact of pairs against closed forms, and against itself as it is refined and comes to rest."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.harness.scenes.primitive_obstacles import PlaneObstacle
from springbench.harness.simulation.time_loop import MotionState, build_initial_state, prepare, simulate_scene
from springbench.solvers.contact.contact_potential import SelfContact as Energy
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import StopRule

from tests.contact_refinement import simulate_fall, successive_distances
from tests.scene_builders import build_test_scene

MU, DT, G = 0.4, 0.01, 9.81


def slide(tangent: float, frames: int) -> tuple[np.ndarray, float]:
    """How fast a sheet slides down a sheet that lies on a slope, at the end of each step [m/s], and how it should
    accelerate."""
    angle = np.arctan(tangent)
    down = GravityEffect(acceleration=(G * np.sin(angle), -G * np.cos(angle), 0.0))
    two, rough = (
        StackMesh(width=0.2, height=0.2, layer_spacing=0.0202),
        SelfContactEffect(min_distance=0.01, friction=MU),
    )
    lies = PinsEffect(parts=("lowest",))
    made = build_test_scene(two, SpringsEffect(stretch=100.0, shear=20.0), down, lies, rough, size=3, time_step=DT)
    upper = made.mesh.parts["highest"]
    steps = simulate_scene(
        made, prepare(made, NewtonSolver()), StopRule(100, 1e-6), initial_guess="extrapolated", frames=frames
    )
    speeds = np.array([step.state.motion.velocity[upper, 0].mean() for step in steps])
    return speeds, G * float(np.sin(angle) - MU * np.cos(angle))


def test_a_sheet_on_a_sheet_slides_above_the_angle_of_friction_and_rests_below_within_a_twentieth():
    rests, _ = slide(0.95 * MU, 80)
    assert rests[-1] < 1e-3  # the creep; what it gathered while the first steps' pressure was none is gone
    slides, _ = slide(1.05 * MU, 25)
    assert slides[-1] > slides[12] > 0.05
    slides, expected = slide(1.5 * MU, 25)
    # Settled after 0.08 s, and not yet beyond the lower sheet's side by more than a cell.
    assert (slides[24] - slides[8]) / (16 * DT) == pytest.approx(expected, rel=0.05)


@pytest.mark.long
def test_it_converges_as_its_thickness_shrinks_and_as_its_barrier_stiffens():
    thinner = successive_distances([simulate_fall(t, 100.0) for t in (0.02, 0.01, 0.005, 0.0025)])
    for one, next_ in pairwise(thinner):
        assert one / next_ == pytest.approx(2.0, rel=0.1)  # order 1
    stiffer = successive_distances([simulate_fall(0.02, k) for k in (1e2, 1.6e3, 2.56e4, 4.096e5)])
    assert stiffer[0] > 1.5 * stiffer[1] > 3.0 * stiffer[2]


@pytest.mark.long
def test_a_cloth_that_is_dropped_onto_itself_loses_energy_and_comes_to_rest():
    floor = SurfaceContactEffect(min_distance=0.01, obstacles=(PlaneObstacle(point=(0.0, -0.45, 0.0)),))
    acts = (
        SpringsEffect(stretch=100.0, shear=20.0),
        GravityEffect(),
        EtherDragEffect(decay_rate=3.0),
        SelfContactEffect(min_distance=0.01),
        floor,
    )
    made = build_test_scene(GridMesh(plane="vertical", width=0.2, height=0.4), *acts, size=4)
    p, mass = build_initial_state(made).motion.positions, made.system.mass
    shaken = MotionState(Motion(p, 0.3 * np.random.default_rng(0).normal(size=p.shape)), None, 0)
    energy, pressed, far, before = list[float](), list[int](), np.inf, p
    rule = StopRule(300, 1e-10)
    for step in simulate_scene(
        made, prepare(made, NewtonSolver()), rule, initial_guess="previous", frames=300, initial_state=shaken
    ):
        p, v = step.positions, step.state.motion.velocity
        parts = [one.value(p) for one in step.problem.energies]
        energy.append(sum(parts) + 0.5 * float(mass @ (v * v).sum(axis=1)) + G * float(mass @ p[:, 1]))
        (own,) = (e for e in step.problem.energies if isinstance(e, Energy))
        pressed.append(len(own.hessian_blocks(p).vertices))
        far, before = float(np.abs(p - before).max()), p.copy()
    # The last impact: when the number of pairs in range grew last.
    last = max(k for k in range(1, len(pressed)) if pressed[k] > pressed[k - 1])
    rises = np.array(energy[10:]) - np.array(energy[:-10])
    assert pressed[-1] > 10
    assert rises.max() <= 1e-6 * abs(energy[last])
    assert far < 1e-6 * made.mesh.spacing

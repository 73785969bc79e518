"""Properties of each time integrator at convergence: its order, and what it conserves.

Order and conservation: Hairer and Wanner, Solving Ordinary Differential Equations II, sections IV.12 and V.1; Hairer,
Lubich and Wanner, Geometric Numerical Integration, sections IV.1 and IV.2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, integrate_motion
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.rayleigh_effect import RayleighEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import MeshSource, SceneSpec
from springbench.harness.simulation.time_loop import MotionState, build_initial_state, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import INTEGRATORS, Motion
from springbench.solvers.model.step_problem import Positions, Solver, StopRule
from springbench.solvers.registry import SOLVERS, load_target

CONVERGED_STOP = StopRule(100, 1e-13)

integrators = pytest.mark.parametrize("name", [name for name in INTEGRATORS if name != "substepping"])


def build_unit_scene(
    name: str,
    mesh: MeshSource,
    *effects: SceneEffect,
    size: int,
    time_step: float,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """A scene of 1 kg by an integrator."""
    given = {"mesh": mesh, "effects": effects, "velocity": velocity, "time_step": time_step}
    return build_scene(SceneSpec(mass=1.0, frames=1, path=Path("scene.yaml"), **given), size, name)


def run(
    scene: Scene,
    steps: int,
    solver: Solver | None = None,
    stop: StopRule = CONVERGED_STOP,
    state: MotionState | None = None,
) -> list[Motion]:
    """The motions at the start and after each step."""
    state, prepared = state or build_initial_state(scene), prepare(scene, solver or NewtonSolver())
    path = simulate_scene(scene, prepared, stop, initial_guess="inertial", frames=steps, initial_state=state)
    return [state.motion, *(step.state.motion for step in path)]


FIRST_PIN = PinsEffect(parts=("first",), weight="exact")
MOVING_PIN = PinsEffect.model_validate(
    {
        "parts": ["first"],
        "weight": "exact",
        "motion": {"key_frames": [{"time": 0.0}, {"time": 1.0, "offset": [0.5, 1.0, 0.0], "angle": 40.0}]},
    }
)
SOFT = SpringsEffect(stretch=20.0)


def gusts(p: Positions, v: Positions, t: float) -> Positions:
    """A force of place, speed and time, on each of a few vertices [N]."""
    return np.sin(9.0 * t + p[:, :1]) * np.array([0.4, 1.0, -0.8]) - 0.3 * v


PROBLEMS: dict[str, tuple[tuple[SceneEffect, ...], tuple, tuple[float, float, float]]] = {
    "swinging": ((SOFT, GravityEffect(), FIRST_PIN), (), (0.5, 1.0, 2.0)),
    "under a force of time, place and speed": ((SOFT, FIRST_PIN), (gusts,), (1.0, 0.0, 0.5)),
    "slowed by ether drag": ((SOFT, GravityEffect(), EtherDragEffect(decay_rate=3.0), FIRST_PIN), (), (0.0, 0.0, 0.0)),
    "slowed by quadratic drag": (
        (SOFT, AirDragEffect(drag_law="quadratic", coefficient=3.0), FIRST_PIN), (), (1.0, 0.0, 2.0)
    ),
    "slowed by air": ((SOFT, GravityEffect(), AirDragEffect(coefficient=2.0), FIRST_PIN), (), (1.0, 0.0, 2.0)),
    "slowed by dashpots": ((SOFT, GravityEffect(), DashpotsEffect(stretch=0.4), FIRST_PIN), (), (1.0, 0.0, 2.0)),
    "slowed by Rayleigh's damping": (
        (SOFT, GravityEffect(), RayleighEffect(mass_coefficient=0.5, stiffness_coefficient=0.02), FIRST_PIN),
        (), (1.0, 0.0, 2.0),
    ),
    "swung by its pin": ((SOFT, GravityEffect(), MOVING_PIN), (), (0.5, 1.0, 0.0)),
}  # fmt: skip


SPLIT = {("slowed by quadratic drag", "midpoint"): 1}
"""The order where filters of the velocity act half a step early."""

END = 0.15


@cache
def integrate_reference(problem: str) -> ReferenceTrajectory:
    """The motion at the end, which no integrator has a share in; forces take the place of filters."""
    effects, forces, velocity = PROBLEMS[problem]
    scene = build_unit_scene("esdirk-4", ChainMesh(), *effects, size=4, time_step=0.1, velocity=velocity)
    return integrate_motion(replace(scene, varying_forces=(*scene.varying_forces, *forces)), [END])


@integrators
@pytest.mark.parametrize("problem", PROBLEMS)
def test_the_error_falls_with_the_methods_order(name, problem):
    effects, forces, velocity = PROBLEMS[problem]
    errors = []
    for steps in (12, 24):
        scene = build_unit_scene(name, ChainMesh(), *effects, size=4, time_step=END / steps, velocity=velocity)
        scene = replace(scene, varying_forces=(*scene.varying_forces, *forces))
        errors.append(integrate_reference(problem).measure_error(0, run(scene, steps)[-1].positions))
    found = np.log2(errors[0] / errors[1])
    # The next term of the error is smaller by a time step times the fastest frequency or rate of decay, at most 0.2.
    assert found == pytest.approx(SPLIT.get((problem, name), INTEGRATORS[name].order), abs=0.2)


FREE = (GridMesh(), SpringsEffect(stretch=300.0))
RNG = np.random.default_rng(4)


def build_spinning_state(scene: Scene, *, spin: float, noise: float = 0.0) -> MotionState:
    """The rest shape, spinning about the vertical [1/s], with random speeds besides [m/s]."""
    arm = scene.mesh.rest_positions - scene.mesh.rest_positions.mean(axis=0)
    velocity = np.cross([0.0, spin, 0.0], arm) + noise * np.random.default_rng(4).normal(size=arm.shape)
    return MotionState(Motion(scene.mesh.rest_positions, velocity), None, 0)


@integrators
def test_linear_momentum_is_conserved(name):
    scene = build_unit_scene(name, *FREE, size=5, time_step=1 / 30)
    momenta = [scene.system.mass @ v for _, v in run(scene, 15, state=build_spinning_state(scene, spin=2.0, noise=1.0))]
    # Converged forces add up to 1e-13 of some tens of newtons, and round-off of positions over dt to 1e-14.
    np.testing.assert_allclose(momenta, np.tile(momenta[0], (16, 1)), rtol=0, atol=1e-12)


def euler_law(m: np.ndarray, path: list[Motion], dt: float) -> np.ndarray:
    """L' - L - dt sum m v' x v, zero because springs are central where they pull, at p'."""
    L = [np.cross(p, m * v).sum(axis=0) for p, v in path]
    return np.array([b - a - dt * np.cross(m * w, v).sum(axis=0)
                     for (a, b), ((_, v), (_, w)) in zip(pairwise(L), pairwise(path), strict=True)])  # fmt: skip


def bdf2_law(m: np.ndarray, path: list[Motion], dt: float) -> np.ndarray:
    """sum p'' x m (3 v'' - 4 v' + v)/2, zero for the same reason; the first step is one of implicit Euler."""
    steps = zip(path, path[1:], path[2:], strict=False)
    return np.array([np.cross(p, m * (1.5 * w - 2.0 * v + 0.5 * u)).sum(axis=0) for (_, u), (_, v), (p, w) in steps])


def midpoint_law(m: np.ndarray, path: list[Motion], dt: float) -> np.ndarray:
    """L' - L, zero: quadratic invariants are conserved."""
    return np.diff([np.cross(p, m * v).sum(axis=0) for p, v in path], axis=0)


LAWS: dict[str, Callable[[np.ndarray, list[Motion], float], np.ndarray]] = {
    "implicit-euler": euler_law,
    "bdf2": bdf2_law,
    "midpoint": midpoint_law,
}


@pytest.mark.parametrize("name", LAWS)
def test_angular_momentum_obeys_the_methods_law(name):
    scene = build_unit_scene(name, *FREE, size=5, time_step=1 / 30)
    path = run(scene, 12, state=build_spinning_state(scene, spin=4.0, noise=0.5))
    # What is left of forces of some tens of newtons, 1e-12 of them, and round-off of positions over dt.
    np.testing.assert_allclose(LAWS[name](scene.system.mass[:, None], path, 1 / 30), 0.0, rtol=0, atol=2e-11)


def quadratic(name: str) -> Scene:
    """A net of springs without rest length, whose energy is quadratic."""
    scene = build_unit_scene(name, *FREE, size=4, time_step=1 / 10)
    springs = replace(scene.all_springs, rest_length=np.zeros(len(scene.all_springs.edges)))
    return replace(scene, system=replace(scene.system, energies=(springs,)))


def energies(scene: Scene, path: list[Motion]) -> np.ndarray:
    """Kinetic and elastic energy [J] at each time."""
    m = scene.system.mass
    elastic = (sum(e.value(p) for e in scene.system.energies) for p, _ in path)
    return np.array([0.5 * m @ np.sum(v**2, axis=1) + e for (_, v), e in zip(path, elastic, strict=True)])


def test_midpoint_conserves_a_quadratic_energy():
    scene = quadratic("midpoint")
    found = energies(scene, run(scene, 40, state=build_spinning_state(scene, spin=2.0, noise=1.0)))
    np.testing.assert_allclose(found, found[0], rtol=1e-12)  # forty steps of some roundings of sums of tens of terms


@pytest.mark.parametrize("name", ["implicit-euler", "bdf2"])
def test_the_others_damp_a_quadratic_energy(name):
    scene = quadratic(name)
    found = energies(scene, run(scene, 40, state=build_spinning_state(scene, spin=2.0, noise=1.0)))
    assert found[-1] < 0.9 * found[0]
    if name == "implicit-euler":
        assert all(b <= a * (1.0 + 1e-12) for a, b in pairwise(found))  # as above


@pytest.mark.long
@pytest.mark.parametrize("name", ["midpoint", "newmark"])
def test_the_energy_stays_near_over_a_hundred_thousand_steps(name):
    """Midpoint is symplectic; the trapezoidal rule, Newmark's mean acceleration, is conjugate to it."""
    scene = build_unit_scene(
        name, ChainMesh(), SpringsEffect(scaling_rule="fixed", stretch=25.0), size=3, time_step=0.02
    )  # omega h = .3
    begun = MotionState(Motion(1.1 * scene.mesh.rest_positions, np.random.default_rng(0).normal(size=(3, 3))), None, 0)
    path = simulate_scene(
        scene,
        prepare(scene, NewtonSolver()),
        CONVERGED_STOP,
        initial_guess="inertial",
        frames=100_000,
        initial_state=begun,
    )
    found = energies(scene, [begun.motion, *(step.state.motion for step in path if step.index % 500 == 0)])
    # It swings by (omega h)^2 at most, and does not drift.
    assert np.ptp(found) < 0.1 * found[0]
    assert abs(found[-100:].mean() - found[:100].mean()) < 0.02 * found[0]


MINIMISERS = [name for name, target in SOLVERS.items() if load_target(target).is_minimiser]


@pytest.mark.parametrize("name", ["implicit-euler", "bdf2", "midpoint", "generalised-alpha", "sdirk-3"])
@pytest.mark.parametrize("solver", MINIMISERS)
def test_every_minimiser_takes_the_steps_of_every_integrator(name, solver):
    scene = build_unit_scene(
        name,
        GridMesh(),
        SpringsEffect(stretch=30.0),
        GravityEffect(),
        PinsEffect(parts=("top_corners",)),
        size=4,
        time_step=1 / 60,
    )
    stop = StopRule(20_000, 1e-11)
    by_newton, found = (
        np.array([p for p, _ in run(scene, 6, one, stop)]) for one in (NewtonSolver(), load_target(SOLVERS[solver])())
    )
    # 1e-11 of a step's residual is 1e-12 m along stiff springs, and some hundred times that along the softest way.
    np.testing.assert_allclose(found, by_newton, rtol=0, atol=1e-8)
    assert np.abs(by_newton - scene.mesh.rest_positions).max() > 0.01

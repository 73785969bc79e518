"""Air drag, dashpots and Rayleigh damping against closed forms, and what they conserve."""

from __future__ import annotations

import numpy as np
import pytest
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.rayleigh_effect import RayleighEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.energies.quadratic_energy import RayleighDamping
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, StopRule

from tests.effect_scenes import with_integrator
from tests.scene_builders import build_test_scene

INTEGRATORS = ("implicit-euler", "bdf2", "midpoint")
G = 9.81


def moving(made: Scene, velocity: Positions, steps: int, at: Positions | None = None) -> list[Motion]:
    """The motion at the start and after each converged step."""
    state = MotionState(Motion(made.mesh.rest_positions if at is None else at, velocity), None, 0)
    run = simulate_scene(
        made,
        prepare(made, NewtonSolver()),
        StopRule(20, 1e-10),
        initial_guess="inertial",
        frames=steps,
        initial_state=state,
    )
    return [state.motion, *(step.state.motion for step in run)]


def pendulum(drag: AirDragEffect, dt: float) -> Scene:
    """1 kg at the end of a stiff rod of 1 m; the other kilogramme is at the pivot, and so is half of the drag."""
    pins = PinsEffect(parts=("first",), weight="exact")
    made = build_test_scene(
        ChainMesh(direction=(0.0, -1.0, 0.0)),
        SpringsEffect(stretch=1e5),
        GravityEffect(),
        pins,
        drag,
        size=2,
        mass=2.0,
        time_step=dt,
    )
    return with_integrator(made, "midpoint")


def amplitudes(made: Scene, seconds: float, first: float) -> np.ndarray:
    """The pendulum's amplitude [rad] after each step, A^2 = angle^2 + (angle'/w)^2 for small ones."""
    stretched = 1.0 + G / 1e5  # or the rod would vibrate, and the drag see that
    at = stretched * np.array([[0.0, 0.0, 0.0], [np.sin(first), -np.cos(first), 0.0]])
    path = moving(made, np.zeros((2, 3)), round(seconds / made.system.time_step), at)
    x, y = np.array([now.positions[1, :2] for now in path]).T
    vx, vy = np.array([now.velocity[1, :2] for now in path]).T
    return np.hypot(np.arctan2(x, -y), (x * vy - y * vx) / (x**2 + y**2) / G**0.5)


PERIOD = 2 * np.pi / G**0.5


def test_a_pendulum_in_linear_drag_decays_at_its_rate():
    """m x'' = -c x' - m g x / l: the amplitude decays by exp(-c t / 2 m)."""
    c, dt = 0.2, PERIOD / 100
    found = amplitudes(pendulum(AirDragEffect(coefficient=2 * c), dt), 5 * PERIOD, 0.05)
    rate = -np.log(found[-1] / found[0]) / (5 * PERIOD)
    assert rate == pytest.approx(c / 2, rel=0.01)  # midpoint and the rod's stretch err by some (dt w)^2 = 0.4 %


def test_a_pendulum_in_quadratic_drag_decays_as_one_over_time():
    """m x'' = -k |x'| x' - m g x / l: 1/A grows by 4 k w l / (3 pi m) a second, by the work done in a period."""
    k, dt = 2.0, PERIOD / 200
    found = amplitudes(pendulum(AirDragEffect(drag_law="quadratic", coefficient=2 * k), dt), 5 * PERIOD, 0.01)
    expected = 4 * k * G**0.5 / (3 * np.pi)
    growth = (1 / found[-1] - 1 / found[0]) / (5 * PERIOD)
    assert growth == pytest.approx(expected, rel=0.01)  # averaging over a period errs by some k A/4


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_linear_drag_slows_a_free_body_by_each_integrators_own_formula(integrator):
    """v' = v / (1 + c dt/m) for implicit Euler; the others are closer to exp(-c dt/m) by an order."""
    velocity = np.tile([1.0, -2.0, 0.5], (4, 1))
    made = build_test_scene(ChainMesh(), AirDragEffect(coefficient=3.0), size=4, mass=2.0, time_step=0.02)
    v = moving(with_integrator(made, integrator), velocity, 20)[-1].velocity
    factor = {"implicit-euler": (1 + 0.03) ** -20.0}.get(integrator, np.exp(-0.6))
    # Euler's is exact; BDF2's first step is Euler's, whose error is (0.03)^2 / 2.
    np.testing.assert_allclose(v, factor * velocity, rtol=1e-11 if integrator == "implicit-euler" else 2e-3)


@pytest.mark.parametrize("coefficient", [0.01, 1.0, 1e6])
def test_quadratic_drag_is_exact_at_any_time_step(coefficient):
    made = build_test_scene(
        ChainMesh(), AirDragEffect(drag_law="quadratic", coefficient=coefficient), size=3, mass=2.0, time_step=5.0
    )
    v = moving(made, np.tile([3.0, 0.0, 4.0], (3, 1)), 4)[-1].velocity
    # 1/|v| grows by c/m a second,
    # with a velocity of 1e-7 m/s as the difference of positions of order one over 5 s, at worst.
    np.testing.assert_allclose(1 / np.linalg.norm(v, axis=1), 0.2 + coefficient / 2.0 * 20.0, rtol=1e-9)


def oscillator(*damping: SceneEffect) -> Scene:
    """Two masses of 1 kg on a spring of 100 N/m and 1 m: the angular frequency is sqrt(200)."""
    made = build_test_scene(ChainMesh(), SpringsEffect(stretch=100.0), *damping, size=2, mass=2.0, time_step=0.002)
    return with_integrator(made, "midpoint")


OSCILLATORS = {
    "dashpots": (DashpotsEffect(stretch=1.5), 1.5),
    "Rayleigh, stiffness": (RayleighEffect(stiffness_coefficient=0.015), 1.5),
    "Rayleigh, masses": (RayleighEffect(mass_coefficient=3.0), 1.5),
    "Rayleigh, both": (RayleighEffect(mass_coefficient=1.0, stiffness_coefficient=0.01), 1.5),
}


@pytest.mark.parametrize("case", OSCILLATORS)
def test_an_oscillator_decays_at_its_rate(case):
    """x'' + 2 s x' + w^2 x = 0 with s = c, a/2, b w^2/2; w^2 = 200, so all of these make 1.5 in all."""
    effect, rate = OSCILLATORS[case]
    w = (200.0 - rate**2) ** 0.5
    steps = round(4 * np.pi / w / 0.002)  # two periods
    path = moving(oscillator(effect), np.zeros((2, 3)), steps, np.array([[-0.005, 0, 0], [1.005, 0, 0]]))
    length = np.array([now.positions[1, 0] - now.positions[0, 0] for now in path]) - 1.0
    t = 0.002 * np.arange(steps + 1)
    expected = 0.01 * np.exp(-rate * t) * (np.cos(w * t) + rate / w * np.sin(w * t))
    # Midpoint's phase errs by (w dt)^2 / 12 = 7e-5 of 13 radians.
    np.testing.assert_allclose(length, expected, rtol=0, atol=0.002 * 0.01)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_dashpots_conserve_linear_momentum(integrator):
    rng = np.random.default_rng(0)
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=100.0), DashpotsEffect(stretch=5.0), size=5)
    velocity = rng.normal(size=made.mesh.rest_positions.shape)
    path = moving(with_integrator(made, integrator), velocity, 10)
    momentum = np.array([made.system.mass @ now.velocity for now in path])
    # Newton's residual, 1e-10 of the first forces of some newtons, times dt.
    np.testing.assert_allclose(momentum, momentum[[0]].repeat(11, 0), rtol=0, atol=1e-10)


def test_dashpots_conserve_angular_momentum_by_implicit_euler():
    """Their forces are along p^t, so sum p^t x f = 0, and p' x m v' = p^t x m v' for p' = p^t + dt v'."""
    rng = np.random.default_rng(1)
    made = build_test_scene(GridMesh(), DashpotsEffect(stretch=5.0), size=5)
    path = moving(made, rng.normal(size=made.mesh.rest_positions.shape), 10)
    spin = [np.cross(now.positions, made.system.mass[:, None] * now.velocity).sum(axis=0) for now in path]
    np.testing.assert_allclose(spin, [spin[0]] * 11, rtol=0, atol=1e-10)
    energy = [made.system.mass @ np.sum(now.velocity**2, axis=1) for now in path]
    assert energy[-1] < 0.5 * energy[0]


def test_dashpots_do_not_affect_a_rigid_motion():
    made = build_test_scene(GridMesh(), DashpotsEffect(stretch=1e4), size=5, time_step=1e-3)
    velocity = np.array([1.0, 2.0, 0.0]) + np.cross([0.0, 3.0, 0.0], made.mesh.rest_positions)
    now = moving(made, velocity, 1)[-1]
    # A turn by w dt stretches springs to second order: that speed, w^2 dt l = 0.009 l, is all that can be taken.
    np.testing.assert_allclose(now.velocity, velocity, rtol=0, atol=0.02)


@pytest.mark.parametrize(
    "damping",
    [
        DashpotsEffect(stretch=1e9),
        RayleighEffect(mass_coefficient=1e9, stiffness_coefficient=1e9),
        AirDragEffect(coefficient=1e9),
    ],
)
def test_extreme_damping_stops_motion_and_nothing_else(damping):
    made = build_test_scene(
        GridMesh(), SpringsEffect(stretch=100.0), GravityEffect(), damping, PinsEffect(parts=("top",)), size=5
    )
    velocity = np.random.default_rng(2).normal(size=made.mesh.rest_positions.shape)
    prepared, state = (
        prepare(made, SparseLocalGlobal()),
        MotionState(Motion(made.mesh.rest_positions, velocity), None, 0),
    )
    for step in simulate_scene(made, prepared, StopRule(50), initial_guess="previous", frames=10, initial_state=state):
        assert np.isfinite(step.positions).all()
        assert np.abs(step.positions - made.mesh.rest_positions).max() < 1.0


def test_rayleigh_damping_takes_the_matrix_of_bending():
    made = build_test_scene(GridMesh(), BendingEffect(stiffness=2.0), RayleighEffect(stiffness_coefficient=0.5), size=4)
    bending, damping = made.system.energies
    assert isinstance(damping, RayleighDamping)
    n = len(made.mesh.rest_positions)
    found, expected = damping.stiffness_matrix(n), bending.stiffness_matrix(n)  # pyright: ignore[reportAttributeAccessIssue]
    assert np.abs(found - 0.5 * expected).max() <= 1e-14 * np.abs(expected).max()  # at the rate of 1/s


def test_damping_is_the_same_in_the_first_step_of_an_integrator_that_needs_a_history():
    """The first step is implicit Euler's, whose Q has the rate 1/dt and not 3/(2 dt)."""
    made = build_test_scene(
        GridMesh(),
        SpringsEffect(stretch=100.0),
        DashpotsEffect(stretch=1.0),
        GravityEffect(),
        PinsEffect(parts=("top",)),
        size=4,
    )
    euler, bdf2 = (with_integrator(made, name) for name in ("implicit-euler", "bdf2"))
    stop = StopRule(7)
    one, two = (
        next(simulate_scene(s, prepare(s, SparseLocalGlobal()), stop, initial_guess="previous", frames=1))
        for s in (euler, bdf2)
    )
    np.testing.assert_array_equal(one.positions, two.positions)

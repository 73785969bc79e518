"""Symplectic Euler against closed forms, its stability limit, and what it conserves."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect as PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, simulate_scene
from springbench.solvers.methods.time_stepping.symplectic_euler import (
    PreparedSymplecticEuler,
    SymplecticEuler,
    bound_max_frequency,
)
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import DirichletPins, StopRule, System, Unsupported
from springbench.solvers.model.system_matrix_assembly import diagonal_matrix

from tests.scene_builders import (
    SCENE_BUILDERS,
    build_cloth,
    build_first_problem,
    build_random_network,
    build_random_problem,
    build_test_scene,
)
from tests.unit.test_xpbd import Other, without_mass

G, DT = 9.81, 1 / 30
STOP = StopRule(1)


def ready(system: System) -> PreparedSymplecticEuler:
    """The method, on the processor."""
    prepared = SymplecticEuler().prepare(system)
    assert isinstance(prepared, PreparedSymplecticEuler)
    return prepared


def motions(made: Scene, velocity: np.ndarray, frames: int, substeps: int | None = None) -> list[Motion]:
    """Positions and velocities at the start and after each step."""
    prepared = ready(made.system)
    prepared = replace(prepared, num_substeps=substeps or prepared.num_substeps)
    state = MotionState(Motion(made.mesh.rest_positions, velocity), None, 0)
    run = simulate_scene(made, prepared, STOP, initial_guess="previous", frames=frames, initial_state=state)
    return [state.motion, *(step.state.motion for step in run)]


FREE = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), size=6)
VELOCITY = np.random.default_rng(0).normal(size=FREE.mesh.rest_positions.shape)


def spring(stretch: float = 500.0, time_step: float = 1e-3) -> tuple[Scene, float]:
    """A mass of 1 kg on a vertical spring of 1 m, and its angular frequency [rad/s]."""
    pins = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
    mesh = ChainMesh(direction=(0.0, -1.0, 0.0))
    made = build_test_scene(mesh, SpringsEffect(stretch=stretch), pins, size=2, mass=2.0, time_step=time_step)
    return made, stretch**0.5


def test_a_free_cloth_falls_by_the_recurrence_of_its_substeps():
    """v = -g t, and y after n substeps of h is -g h^2 n (n + 1)/2."""
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), GravityEffect(), size=6, time_step=DT)
    last = motions(made, np.zeros_like(made.mesh.rest_positions), 12, substeps=8)[-1]
    n, h = 12 * 8, DT / 8
    fallen = made.mesh.rest_positions - [0.0, G * h**2 * n * (n + 1) / 2, 0.0]
    np.testing.assert_allclose(last.positions, fallen, rtol=0, atol=1e-12)  # a hundred roundings of a metre
    np.testing.assert_allclose(last.velocity[:, 1], -G * 12 * DT, rtol=0, atol=1e-11)


def test_a_mass_on_a_spring_follows_its_recurrence_and_its_period_is_of_second_order():
    """u_{n+1} = (2 - (omega h)^2) u_n - u_{n-1}, which swings at the frequency w with cos(w h) = 1 - (omega h)^2/2."""
    made, omega = spring(time_step=0.01)
    velocity = np.array([[0.0, 0.0, 0.0], [0.0, -0.3, 0.0]])
    u = np.array([-1.0 - m.positions[1, 1] for m in motions(made, velocity, 400, substeps=1)])
    np.testing.assert_allclose(u[2:], (2.0 - (omega * 0.01) ** 2) * u[1:-1] - u[:-2], rtol=0, atol=1e-14)
    w = np.arccos(1.0 - (omega * 0.01) ** 2 / 2) / 0.01
    wave = np.column_stack([np.cos(w * 0.01 * np.arange(401)), np.sin(w * 0.01 * np.arange(401))])
    (_, residual, _, _) = np.linalg.lstsq(wave, u)
    assert residual[0] <= 1e-20  # four hundred roundings of 1e-15 each, squared and added
    assert w / omega - 1.0 == pytest.approx((omega * 0.01) ** 2 / 24, rel=0.02)  # the next order


def test_the_error_of_a_swing_is_of_first_order_in_the_substep():
    made, omega = spring(time_step=0.05)
    velocity = np.array([[0.0, 0.0, 0.0], [0.0, -0.3, 0.0]])
    expected = -0.3 * np.cos(omega * 0.05)
    errors = [abs(motions(made, velocity, 1, k)[-1].velocity[1, 1] - expected) for k in (64, 128, 256)]
    np.testing.assert_allclose([a / b for a, b in pairwise(errors)], 2.0, rtol=0.03)  # the next order


@pytest.mark.parametrize(("share", "stable"), [(0.99, True), (1.01, False)])
def test_a_spring_is_stable_just_below_the_limit_and_not_above_it(share, stable):
    """A spring of no rest length is linear in all directions."""
    system = System(
        np.array([1.0, 2.0]), 1.0, (Springs(np.array([[0, 1]]), np.array([300.0]), np.zeros(1), np.eye(1, 3)),)
    )
    (springs,) = system.energies
    assert isinstance(springs, Springs)
    limit = 2.0 / bound_max_frequency(system, springs)
    system = replace(system, time_step=share * limit)
    problem = build_random_problem(0, n=2, m=0, weights=())
    prepared = replace(ready(system), num_substeps=1)
    p, v = np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.1]]), np.zeros((2, 3))
    for _ in range(500):
        start = replace(problem.step_start, positions=p, velocity=v)
        stated = replace(problem, system=system, step_start=start, external_force=np.zeros((2, 3)))
        solution = prepared.solve(stated, STOP)
        assert solution.velocity is not None
        p, v = solution.positions, solution.velocity
    # Below, it is bounded by 1/sqrt(1 - share^2) = 7 of its first size; above it grows by 1.3 a step.
    assert (np.abs(p).max() < 10.0) == stable
    assert stable or np.abs(p).max() > 1e50


@pytest.mark.parametrize("seed", range(4))
def test_no_shape_vibrates_faster_than_the_bound(seed):
    rng = np.random.default_rng(seed)
    rest, springs = build_random_network(rng, 12, 30)
    system = System(rng.uniform(0.1, 2.0, 12), DT, (springs,), DirichletPins(np.array([2, 5]), np.array([np.inf, 1e9])))
    free = np.repeat(system.unpinned_mask, 3)
    scale = diagonal_matrix(np.repeat(system.mass, 3)[free] ** -0.5)
    bound = bound_max_frequency(system, springs)
    for stretch in (0.1, 1.0, 3.0, 1e3):
        H = springs.hessian(stretch * rest + 0.3 * rng.normal(size=rest.shape))[free][:, free]
        assert np.linalg.eigvalsh((scale @ H @ scale).toarray())[-1] <= bound**2 * (1 + 1e-12)  # round-off


@pytest.mark.parametrize("name", ["single-spring", "chain", "net", "cloth", "tower", "block"])
def test_the_bound_is_near_the_largest_frequency_of_a_stretched_scene(name):
    """Far stretched, springs are as stiff sideways as they are along, so the Hessian is A'KA."""
    made = SCENE_BUILDERS[name](1e10)
    free = made.system.unpinned_mask
    scale = diagonal_matrix(made.system.mass[free] ** -0.5)
    L = made.all_springs.stiffness_matrix(made.system.num_vertices)[free][:, free]
    exact = np.linalg.eigvalsh((scale @ L @ scale).toarray())[-1] ** 0.5
    assert 1.0 - 1e-12 <= bound_max_frequency(made.system, made.all_springs) / exact <= 1.3


def test_linear_and_angular_momentum_are_conserved():
    mass = FREE.system.mass[:, None]
    steps = motions(FREE, VELOCITY, 20)
    linear = [(mass * v).sum(axis=0) for _, v in steps]
    angular = [np.cross(p, mass * v).sum(axis=0) for p, v in steps]
    # Springs' forces are central and equal at both ends: only round-off of some hundred substeps is left.
    np.testing.assert_allclose(linear, np.tile(linear[0], (21, 1)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(angular, np.tile(angular[0], (21, 1)), rtol=0, atol=1e-12)


def test_energy_does_not_drift():
    """A symplectic method of first order: energy swings with h, and comes back."""
    (springs,), mass = FREE.system.energies, FREE.system.mass
    drift = {}
    for substeps in (20, 40):
        steps = motions(FREE, VELOCITY, 120, substeps)
        energy = np.array([springs.value(p) + 0.5 * mass @ (v**2).sum(axis=1) for p, v in steps])
        drift[substeps] = np.abs(energy / energy[0] - 1.0)
        assert drift[substeps][60:].max() <= 1.5 * drift[substeps][:60].max()
    assert drift[40].max() <= 0.7 * drift[20].max()


def test_pins_move_evenly_and_have_that_velocity():
    made = build_cloth(4, "exact")
    problem = build_first_problem(made)
    pins = made.system.pins.vertices
    goal = problem.pin_targets + np.array([0.0, 0.3, 0.1])
    solution = SymplecticEuler().prepare(made.system).solve(replace(problem, pin_targets=goal), STOP)
    assert solution.velocity is not None
    np.testing.assert_array_equal(solution.positions[pins], goal)
    np.testing.assert_allclose(solution.velocity[pins], np.tile([0.0, 0.3 * 30, 0.1 * 30], (2, 1)), rtol=1e-14)


def test_penalty_pins_are_taken_as_exact_and_reported_as_such():
    by_penalty, exact = (ready(build_cloth(6, w).system) for w in (1e10, "exact"))
    assert by_penalty.num_substeps == exact.num_substeps
    assert "2 pins by penalty taken as exact" in by_penalty.description
    assert "penalty" not in exact.description
    found = [
        p.solve(build_first_problem(build_cloth(6, w)), STOP).positions
        for p, w in ((by_penalty, 1e10), (exact, "exact"))
    ]
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.parametrize("stretch", [3.0, 300.0, 3e6])
def test_substeps_follow_from_the_stiffness(stretch):
    made = build_cloth(6, stretch=stretch)
    prepared = ready(made.system)
    h = DT / prepared.num_substeps
    limit = 2.0 / bound_max_frequency(made.system, made.all_springs)
    assert h < limit
    assert prepared.num_substeps == 1 or DT / (prepared.num_substeps - 1) > 0.95 * limit
    assert f"{prepared.num_substeps} substeps" in prepared.description


@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param(lambda s: replace(s, energies=(*s.energies, Other())), "Other", id="another energy"),
        pytest.param(lambda s: replace(s, inertia_factor=4.0), "implicit-euler", id="another integrator"),
        pytest.param(without_mass, r"1 of 12 have none and are not pinned \(3\)", id="no mass"),
        pytest.param(lambda s: replace(s, time_step=1e9), r"stable with 6.*e\+10 substeps", id="too many substeps"),
    ],
)
def test_unsupported_features_are_refused_before_any_work(change, message):
    with pytest.raises(Unsupported, match=message):
        SymplecticEuler().prepare(change(build_random_problem(0).system))


def test_it_is_done_after_one_iteration_and_has_no_residual():
    problem = build_first_problem(build_cloth(6))
    solution = SymplecticEuler().prepare(problem.system).solve(problem, StopRule(50, 1e-3))
    assert (solution.num_iterations, solution.termination_reason) == (1, "max-iter")
    assert np.isnan([solution.residual, solution.initial_residual]).all()


def test_a_solve_without_iterations_counts_none():
    solution = ready(FREE.system).solve(build_first_problem(FREE), StopRule(0))
    assert solution.num_iterations == 0

"""Motion and rest against closed forms, and what implicit Euler conserves."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, prepare, simulate_scene
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, StopRule

from tests.scene_builders import LOCAL_GLOBAL_BACKENDS, build_test_scene, compute_static_shape, simulate_trajectory

G = 9.81
DT = 1 / 30
CONVERGED_STOP = StopRule(20_000, 1e-13)

backends = pytest.mark.parametrize("backend", LOCAL_GLOBAL_BACKENDS, ids=lambda b: type(b).__name__)

FREE = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), size=6)
"""A cloth without supports and loads."""


def moving(
    made: Scene, velocity: Positions, steps: int, stop: StopRule = CONVERGED_STOP
) -> list[tuple[Positions, Positions]]:
    """Positions and velocities at the start and after each step."""
    prepared, state = (
        prepare(made, CompiledLocalGlobal()),
        MotionState(Motion(made.mesh.rest_positions, velocity), None, 0),
    )
    run = simulate_scene(made, prepared, stop, initial_guess="previous", frames=steps, initial_state=state)
    return [
        (state.motion.positions, velocity),
        *((now.positions, now.velocity) for now in (s.state.motion for s in run)),
    ]


def spinning(made: Scene, rate: float) -> Positions:
    """The velocity of a rotation about the vertical through the middle [m/s]."""
    arm = made.mesh.rest_positions - made.mesh.rest_positions.mean(axis=0)
    return np.cross([0.0, rate, 0.0], arm)


def angular_momentum(made: Scene, p: Positions, v: Positions) -> np.ndarray:
    return np.cross(p, made.system.mass[:, None] * v).sum(axis=0)


@backends
@pytest.mark.parametrize("stretch", [5.0, 500.0, 5e6])
def test_a_mass_on_a_spring_follows_the_recurrence_of_implicit_euler(backend, stretch):
    """(m/dt^2 + k) u' = m/dt^2 (2 u - u_before) + m g, along the spring's own axis, where it is linear."""
    pins = PinsEffect(parts=("first",), weight="exact")
    made = build_test_scene(
        ChainMesh(direction=(0.0, -1.0, 0.0)),
        SpringsEffect(stretch=stretch),
        GravityEffect(),
        pins,
        size=2,
        mass=2.0,
        time_step=DT,
    )
    made = replace(made, initial_velocity=(0.0, -0.5, 0.0))
    extension = -simulate_trajectory(made, backend, 50)[:, 1, 1] - 1.0
    u, before, inertia = 0.0, -0.5 * DT, 1.0 / DT**2
    for found in extension:
        u, before = (inertia * (2 * u - before) + G) / (inertia + stretch), u
        assert abs(found - u) <= 2e-13  # fifty steps of a few times the last digit of three, 4e-16


@pytest.mark.parametrize("stretch", [10.0, 500.0, 5e4])
def test_a_mass_on_a_spring_hangs_at_the_extension_of_its_weight(stretch):
    made = build_test_scene(
        ChainMesh(direction=(0.0, -1.0, 0.0)),
        SpringsEffect(stretch=stretch),
        GravityEffect(),
        PinsEffect(parts=("first",)),
        size=2,
        mass=2.0,
    )
    # The pin of 1e10 N/m gives way by 2e-9 m under 2 kg; inertia pulls with 1e-12 N/m.
    assert compute_static_shape(made)[1, 1] == pytest.approx(-1.0 - G / stretch, abs=1e-8)


@backends
def test_a_free_cloth_falls_as_a_stone_does(backend):
    """y_n = -g dt^2 n (n + 1) / 2, by implicit Euler."""
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), GravityEffect(), size=6, time_step=DT)
    p = simulate_trajectory(made, backend, 40)
    n = np.arange(1, 41)[:, None]
    expected = made.mesh.rest_positions[:, 1] - G * DT**2 * n * (n + 1) / 2
    # A thousand roundings of a fall of 9 m, which the cloth's own vibration carries on: 1e-12 to 1e-11.
    np.testing.assert_allclose(p[:, :, 1], expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        p[:, :, [0, 2]], made.mesh.rest_positions[:, [0, 2]][None].repeat(40, 0), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("iterations", [1, 20])
def test_linear_momentum_is_conserved_converged_or_not(iterations):
    velocity = np.random.default_rng(0).normal(size=FREE.mesh.rest_positions.shape)
    momenta = [FREE.system.mass @ v for _, v in moving(FREE, velocity, 20, StopRule(iterations))]
    # Round-off of positions, 1e-16, times stiffness over inertia, some tens, divided by dt.
    np.testing.assert_allclose(momenta, np.tile(momenta[0], (21, 1)), rtol=0, atol=1e-12)


def test_the_centre_of_mass_moves_as_a_particle_under_drag_and_gravity():
    made = build_test_scene(
        GridMesh(), SpringsEffect(stretch=300.0), GravityEffect(), EtherDragEffect(decay_rate=2.0), size=6, time_step=DT
    )
    velocity = np.random.default_rng(1).normal(size=made.mesh.rest_positions.shape)
    share = made.system.mass / made.system.mass.sum()
    centre, v = share @ made.mesh.rest_positions, share @ velocity
    for p, _ in moving(made, velocity, 20, StopRule(5))[1:]:
        v = np.exp(-2.0 * DT) * v + DT * np.array([0.0, -G, 0.0])
        centre = centre + DT * v
        np.testing.assert_allclose(share @ p, centre, rtol=0, atol=1e-12)  # as above


def test_angular_momentum_changes_by_exactly_what_implicit_euler_takes():
    """L' = L + dt sum m v' x v.

    Springs are central, sum p' x F(p') = 0, so sum p' x M v' = sum p' x M v, and p' = p + dt v'.
    """
    velocity = spinning(FREE, 3.0) + 0.3 * np.random.default_rng(2).normal(size=FREE.mesh.rest_positions.shape)
    steps = moving(FREE, velocity, 10)
    for (p, v), (after, faster) in pairwise(steps):
        taken = DT * np.cross(FREE.system.mass[:, None] * faster, v).sum(axis=0)
        change = angular_momentum(FREE, after, faster) - angular_momentum(FREE, p, v)
        # Forces that are left after convergence: 1e-13 of the first, some tens of newtons, times dt.
        np.testing.assert_allclose(change, taken, rtol=0, atol=1e-10)


def test_implicit_euler_slows_a_spin_in_proportion_to_the_time_step():
    """v' x v has the size |v|^2 w dt for a turn by w dt: L falls by the fraction w^2 dt^2 a step, w^2 dt a second."""
    lost = []
    for steps in (10, 20, 40):
        made = replace(FREE, system=replace(FREE.system, time_step=0.1 / steps))
        path = moving(made, spinning(made, 3.0), steps)
        L = [angular_momentum(made, p, v)[1] for p, v in path]
        assert all(after < before for before, after in pairwise(L))
        lost.append(1.0 - L[-1] / L[0])
    # The next term is smaller by w dt, at most 0.03, and by the cloth's stretch.
    np.testing.assert_allclose([lost[0] / lost[1], lost[1] / lost[2]], 2.0, rtol=0.1)


@backends
@pytest.mark.parametrize("iterations", [1, 3, 50])
def test_a_step_never_ends_with_more_than_it_had(backend, iterations):
    """E(p') + |v' - v|^2_M / 2 <= E(p) + |v|^2_M / 2 after any number of iterations, since each of them descends."""
    mass, (springs,) = FREE.system.mass, FREE.system.energies
    velocity = 2.0 * np.random.default_rng(3).normal(size=FREE.mesh.rest_positions.shape)
    state = MotionState(Motion(FREE.mesh.rest_positions, velocity), None, 0)
    prepared, stop = backend.prepare(FREE.system), StopRule(iterations)
    for step in simulate_scene(FREE, prepared, stop, initial_guess="previous", frames=30, initial_state=state):
        (p, v), (after, v_after) = state.motion, step.state.motion
        had = springs.value(p) + 0.5 * mass @ np.sum(v**2, axis=1)
        has = springs.value(after) + 0.5 * mass @ np.sum((v_after - v) ** 2, axis=1)
        assert has <= had * (1 + 1e-13)  # sums of some hundred terms
        state = step.state

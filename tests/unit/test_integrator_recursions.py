"""Each time integrator against the closed forms of its own recursion: free flight and a linear oscillator."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest
from springbench.harness.scenes.effects.constant_force_effect import ConstantForceEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, build_initial_state, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import INTEGRATORS, GeneralisedAlpha, Motion, RungeKutta, StageSolution
from springbench.solvers.model.step_problem import StopRule

from tests.scene_builders import build_test_scene

DT, STEPS = 1 / 30, 25
CONVERGED_STOP = StopRule(100, 1e-14)

STAGE_INTEGRATORS = [name for name in INTEGRATORS if name != "substepping"]
integrators = pytest.mark.parametrize("name", STAGE_INTEGRATORS)
ALPHAS = [name for name, method in INTEGRATORS.items() if isinstance(method, GeneralisedAlpha)]
LINEAR = [name for name in STAGE_INTEGRATORS if name not in ALPHAS or name == "newmark"]  # a power a step
TABLEAUX = [name for name, method in INTEGRATORS.items() if isinstance(method, RungeKutta)]


def by(made: Scene, name: str) -> Scene:
    """The scene by another integrator."""
    method = INTEGRATORS[name]
    return replace(
        made,
        integrator=method,
        system=replace(made.system, inertia_factor=method.inertia_factor, velocity_factor=method.velocity_factor),
    )


def motions(made: Scene, state: MotionState | None = None) -> list[Motion]:
    """The motions at the start and after each step."""
    state = state or build_initial_state(made)
    steps = simulate_scene(
        made, prepare(made, NewtonSolver()), CONVERGED_STOP, initial_guess="previous", frames=STEPS, initial_state=state
    )
    return [state.motion, *(step.state.motion for step in steps)]


# What a method's recursion adds to a t^2/2 after n steps, in units of a dt^2/2: implicit Euler takes each velocity from
# the step's end; BDF2 makes that error in its first step alone, and e_n = (4 e_(n-1) - e_(n-2)) / 3 retains 3/2 of it.
LATE = {"implicit-euler": lambda n: n, "bdf2": lambda n: 1.5 * (1.0 - 3.0**-n)}


@integrators
def test_free_flight_follows_the_methods_own_parabola(name):
    push, mass, velocity = np.array([3.0, -1.0, 0.5]), 2.0, (1.0, 2.0, -0.5)
    force = ConstantForceEffect.model_validate({"force": tuple(push)})
    made = by(build_test_scene(ChainMesh(), force, size=2, mass=mass, velocity=velocity), name)
    n = np.arange(STEPS + 1.0)[:, None]
    a = 2.0 * push / mass  # on each of the two vertices
    positions = np.array([p[0] for p, _ in motions(made)])
    expected = n * DT * np.array(velocity) + 0.5 * a * DT**2 * (n**2 + LATE.get(name, lambda n: 0.0 * n)(n))
    # A few roundings of positions of one metre in each step; weights of tableaux, of up to 8, add up some tens of them.
    more = 100.0 if name in TABLEAUX else 1.0
    np.testing.assert_allclose(positions, made.mesh.rest_positions[0] + expected, rtol=0, atol=more * 1e-13)
    speeds = np.array([v[0] for _, v in motions(made)])
    np.testing.assert_allclose(speeds, np.array(velocity) + n * DT * a, rtol=0, atol=more * 1e-11)  # the same over dt


def powers(name: str, z: complex) -> np.ndarray:
    """w_n / w_0 of w' = i omega w, n = 0, ..., STEPS, where z = i omega dt."""
    n = np.arange(STEPS + 1)
    if name == "implicit-euler":
        return (1.0 - z) ** -n
    if name in TABLEAUX:
        method: Any = INTEGRATORS[name]
        rows = method.a
        A = np.array([[*row, *[0.0] * (len(rows) - len(row))] for row in rows])
        once = np.linalg.solve(np.eye(len(A)) - z * A, np.ones(len(A)))[-1]  # the last stage is the step's end
        return once**n
    if name in ("midpoint", "newmark"):
        return ((1.0 + z / 2.0) / (1.0 - z / 2.0)) ** n
    root = np.sqrt(1.0 + 2.0 * z)  # of (3 - 2 z) r^2 - 4 r + 1, from which 1/(1 - z) starts
    one, two = (2.0 + root) / (3.0 - 2.0 * z), (2.0 - root) / (3.0 - 2.0 * z)
    share = (1.0 / (1.0 - z) - two) / (one - two)
    return share * one**n + (1.0 - share) * two**n


@pytest.mark.parametrize("name", LINEAR)
@pytest.mark.parametrize("stiffness", [5.0, 500.0, 5e4])
def test_a_mass_on_a_spring_turns_by_the_methods_own_powers(name, stiffness):
    """Along its axis the spring is linear, and w = v + i omega u turns as w' = i omega w."""
    speed, omega = 0.3, np.sqrt(stiffness)
    springs, pins = SpringsEffect(scaling_rule="fixed", stretch=stiffness), PinsEffect(parts=("first",), weight="exact")
    made = by(build_test_scene(ChainMesh(), springs, pins, size=2, mass=2.0, velocity=(speed, 0.0, 0.0)), name)
    found = motions(made)
    w = speed * powers(name, 1j * omega * DT)
    # Round-off of positions of one metre, which the spring makes a speed by its frequency; more as above.
    more = 100.0 if name in TABLEAUX else 1.0
    np.testing.assert_allclose([p[1, 0] - 1.0 for p, _ in found], w.imag / omega, rtol=0, atol=more * 1e-12)
    np.testing.assert_allclose([v[1, 0] for _, v in found], w.real, rtol=0, atol=more * 1e-12 * (omega + 1.0 / DT))


def orbit(name: str, time_step: float) -> np.ndarray:
    """The angular momenta of a mass that circles a pin on a spring of no rest length, which is linear."""
    omega = 4.0
    pins, springs = PinsEffect(parts=("first",), weight="exact"), SpringsEffect(scaling_rule="fixed", stretch=omega**2)
    made = by(
        build_test_scene(ChainMesh(), springs, pins, size=2, mass=2.0, time_step=time_step, velocity=(0.0, omega, 0.0)),
        name,
    )
    linear = replace(made.all_springs, rest_length=np.zeros(1))
    made = replace(made, system=replace(made.system, energies=(linear,)))
    return np.array([np.cross(p[1], v[1])[2] for p, v in motions(made)])


@pytest.mark.parametrize("name", LINEAR)
def test_a_circular_orbit_has_the_angular_momentum_that_the_method_leaves_it(name):
    """Position and velocity turn by the same powers, so that L_n = |w_n|^2 omega."""
    # Rounded some tens of times, by some units of the last digit, and divided by dt in the velocity.
    np.testing.assert_allclose(orbit(name, DT), 4.0 * np.abs(powers(name, 4.0j * DT)) ** 2, rtol=1e-11)


@pytest.mark.parametrize(("name", "power"), [("implicit-euler", 2), ("bdf2", 4), ("midpoint", None)])
def test_an_orbit_decays_by_the_methods_damping(name, power):
    """|R(i w)| = 1 - w^2/2, 1 - w^4/4 and 1 a step of w = omega dt; BDF2 after its first steps."""
    lost = [np.log(L[15] / L[-1]) for L in (orbit(name, dt) for dt in (DT, DT / 2, DT / 4))]
    if power is None:
        assert np.abs(lost).max() < 1e-12  # round-off
    else:
        # The next term is smaller by w^2, at most 0.02; BDF2's other root has decayed to 3^-15.
        np.testing.assert_allclose([np.log2(a / b) for a, b in pairwise(lost)], power, rtol=0, atol=0.1)


def test_bdf2_starts_with_a_step_of_implicit_euler():
    made = build_test_scene(ChainMesh(), SpringsEffect(stretch=10.0), size=4, velocity=(0.0, 1.0, 0.0))
    first, second = (
        list(
            islice(simulate_scene(m, prepare(m, NewtonSolver()), CONVERGED_STOP, initial_guess="previous", frames=2), 2)
        )
        for m in (made, by(made, "bdf2"))
    )
    np.testing.assert_array_equal(first[0].positions, second[0].positions)
    assert [step.problem.system.inertia_factor for step in second] == [1.0, 2.25]


@pytest.mark.parametrize("name", ["implicit-euler", "bdf2", "midpoint"])
def test_the_unknown_moves_with_the_velocity_of_the_start(name):
    """rate (target - origin) is the velocity that inertia alone leads to; for a steady flight it is that flight's."""
    method: Any = INTEGRATORS[name]
    v = np.array([[1.0, -2.0, 0.5]])
    now, before = Motion(DT * v, v), Motion(0.0 * v, v)
    target, origin = method.predict_target(now, before, DT)
    np.testing.assert_allclose(target, (1.0 + method.stage_fraction) * DT * v, rtol=1e-14)
    np.testing.assert_allclose(method.inertia_factor**0.5 / DT * (target - origin), v, rtol=1e-13)


@pytest.mark.parametrize("name", TABLEAUX)
def test_a_spring_far_too_stiff_for_the_step_is_at_rest_after_one(name):
    """L-stability: R(z) falls as 1/z, here with |z| = 1e4, on a spring of no rest length, which is linear."""
    springs, pins = (
        SpringsEffect(scaling_rule="fixed", stretch=(1e4 / DT) ** 2),
        PinsEffect(parts=("first",), weight="exact"),
    )
    made = by(build_test_scene(ChainMesh(), springs, pins, size=2, mass=2.0), name)
    linear = replace(made.all_springs, rest_length=np.zeros(1))
    made = replace(made, system=replace(made.system, energies=(linear,)))
    assert max(abs(p[1, 0]) for p, _ in motions(made)[1:]) < 0.01  # of the one metre at the start


@pytest.mark.parametrize(("name", "radius"), [("newmark", 1.0), ("hht", 0.9 / 1.1), ("generalised-alpha", 0.5)])
def test_generalised_alpha_damps_the_highest_frequencies_by_its_spectral_radius(name, radius):
    """That of d, v dt and a dt^2 in a step, z = omega dt without limit; af of HHT has (1 - af)/(1 + af)."""
    method: Any = INTEGRATORS[name]
    size = 1e8
    columns = []
    for d, v, a in np.eye(3):
        one = [np.full((1, 3), x) for x in (d, v, a)]
        step = method.iterate_stages(Motion(one[0], one[1]), one[2], 1.0)
        unknown = next(step)
        x = unknown.inertial_target * method.inertia_factor / (method.inertia_factor + size)  # c (x - target) = -z^2 x
        with pytest.raises(StopIteration) as ended:
            step.send(StageSolution(x, x, method.inertia_factor * (x - unknown.inertial_target)))
        (p, w), b, _ = ended.value.value
        columns.append([p[0, 0], w[0, 0], b[0, 0]])
    powers = np.abs(np.linalg.eigvals(np.transpose(columns)))
    # Two of the three are alike, and so known to half of the digits; z is not infinite.
    np.testing.assert_allclose(powers.max(), radius, rtol=0, atol=2e-3)


@pytest.mark.parametrize("name", TABLEAUX)
def test_a_tableau_meets_the_conditions_of_its_order(name):
    """Butcher's, one a rooted tree; those of the embedded method up to its own order, and not the next."""
    method: Any = INTEGRATORS[name]
    A = np.array([[*row, *[0.0] * (len(method.a) - len(row))] for row in method.a])
    c, one = A.sum(axis=1), np.ones(len(A))
    trees = [
        [(one, 1)],
        [(c, 2)],
        [(c**2, 3), (A @ c, 6)],
        [(c**3, 4), (c * (A @ c), 8), (A @ c**2, 12), (A @ A @ c, 24)],
    ]
    for weights, order in [(A[-1], method.order), (np.array(method.embedded_weights), method.embedded_order)]:
        missed = [max(abs(weights @ tree - 1 / gamma) for tree, gamma in level) for level in trees] if order else []
        assert all(error < 1e-14 for error in missed[:order])
        assert all(error > 1e-4 for error in missed[order : order + 1])


@integrators
def test_the_same_steps_give_the_same_bits(name):
    made = by(build_test_scene(ChainMesh(), SpringsEffect(stretch=10.0), size=4, velocity=(0.0, 1.0, 0.0)), name)
    one, two = motions(made), motions(made)
    np.testing.assert_array_equal(np.array(one), np.array(two))


@pytest.mark.parametrize("name", TABLEAUX)
def test_an_explicit_first_stage_gives_a_stage_order_of_two(name: str):
    method = INTEGRATORS[name]
    assert isinstance(method, RungeKutta)
    assert method.stage_order == (2 if method.needs_start_acceleration else 1)

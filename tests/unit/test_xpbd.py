"""XPBD and its small steps against what theory says of them."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect as PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.position_based.xpbd import Xpbd, XpbdSmallSteps
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import DirichletPins, StepProblem, StopRule, System, Unsupported

from tests.bench.primal_dual import MAX_ITERATIONS, build_hanging_chain, count_iterations
from tests.scene_builders import (
    SCENE_BUILDERS,
    build_cloth,
    build_first_problem,
    build_random_problem,
    build_test_scene,
)

G, DT = 9.81, 1 / 30
methods = pytest.mark.parametrize("method", [Xpbd(), XpbdSmallSteps()], ids=lambda m: type(m).__name__)


def chain(time_step: float = DT, *, direction=(1.0, 0.0, 0.0), stretch: float = 20.0, at: str = "ends") -> Scene:
    pins = PinsEffect.model_validate({"parts": [at], "weight": "exact"})
    mesh = ChainMesh(length=2.0, direction=direction)
    return build_test_scene(mesh, SpringsEffect(stretch=stretch), GravityEffect(), pins, size=10, time_step=time_step)


def solve_positions(method, problem: StepProblem, iterations: int) -> np.ndarray:
    return method.prepare(problem.system).solve(problem, StopRule(iterations)).positions


def minimiser(problem: StepProblem) -> np.ndarray:
    return CompiledLocalGlobal().prepare(problem.system).solve(problem, StopRule(50_000, 1e-14)).positions


@pytest.mark.parametrize("stretch", [2.0, 2e3, 2e6])
@pytest.mark.parametrize("factor", [1.0, 2.25, 4.0], ids="c = {:g}".format)
def test_springs_that_do_not_turn_reach_the_minimiser_of_the_step(stretch, factor):
    problem = build_first_problem(chain(direction=(0.0, -1.0, 0.0), stretch=stretch, at="first"))
    problem = replace(problem, system=replace(problem.system, inertia_factor=factor))
    # A chain of ten: Gauss-Seidel needs some hundred passes where springs outweigh inertia. The rest is round-off.
    np.testing.assert_allclose(solve_positions(Xpbd(), problem, 5000), minimiser(problem), rtol=0, atol=1e-12)


def test_springs_that_turn_in_a_step_leave_an_error_of_fourth_order_in_the_time_step():
    """A turn is of the way from the inertial target, dt^2, and so is the way that a force goes in a step."""
    apart = []
    for frames in (24, 48, 96):
        made = chain(0.2 / frames)
        prepared, stop = prepare(made, CompiledLocalGlobal()), StopRule(2000, 1e-12)
        *_, last = simulate_scene(made, prepared, stop, initial_guess="previous", frames=frames)
        apart.append(np.abs(solve_positions(Xpbd(), last.problem, 2000) - last.solution.positions).max())
    ratios = [a / b for a, b in pairwise(apart)]
    np.testing.assert_allclose(ratios, 16.0, rtol=0.1)  # the next order


def test_multipliers_add_up_over_iterations_instead_of_stiffening_the_springs():
    """Position based dynamics without them would pull springs to their rest lengths as the iterations go on."""
    problem = build_first_problem(chain())
    few, many = solve_positions(Xpbd(), problem, 500), solve_positions(Xpbd(), problem, 5000)
    np.testing.assert_allclose(many, few, rtol=0, atol=1e-14)  # it has converged, and stays


def test_tension_begins_at_zero_in_each_step():
    problem = build_first_problem(chain())
    prepared = Xpbd().prepare(problem.system)
    one, two = (prepared.solve(problem, StopRule(3)).positions for _ in range(2))
    np.testing.assert_array_equal(one, two)


@methods
def test_a_free_cloth_falls_by_the_recurrence_of_its_steps(method):
    """v = -g t, and y after n steps of h is -g h^2 n (n + 1)/2: of the substeps for small steps, else of dt."""
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), GravityEffect(), size=6, time_step=DT)
    frames, iterations = 12, 5
    prepared, stop = prepare(made, method), StopRule(iterations)
    *_, last = simulate_scene(made, prepared, stop, initial_guess="previous", frames=frames)
    n = frames * iterations if isinstance(method, XpbdSmallSteps) else frames
    h = frames * DT / n
    fallen = made.mesh.rest_positions - [0.0, G * h**2 * n * (n + 1) / 2, 0.0]
    np.testing.assert_allclose(last.positions, fallen, rtol=0, atol=1e-12)  # a hundred roundings of a metre
    np.testing.assert_allclose(last.state.motion.velocity[:, 1], -G * frames * DT, rtol=0, atol=1e-10)  # divided by h


@methods
def test_linear_momentum_is_conserved(method):
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), size=6, time_step=DT)
    problem = build_first_problem(made)
    velocity = np.random.default_rng(0).normal(size=problem.current_positions.shape)
    start = replace(problem.step_start, velocity=velocity)
    problem = replace(problem, inertial_target=problem.current_positions + DT * velocity, step_start=start)
    solution = method.prepare(made.system).solve(problem, StopRule(7))
    after = start.velocity_at(solution.positions) if solution.velocity is None else solution.velocity
    # Round-off of positions, 1e-16, divided by the substep.
    np.testing.assert_allclose(made.system.mass @ after, made.system.mass @ velocity, rtol=0, atol=1e-13)


def test_one_small_step_is_one_iteration():
    problem = build_first_problem(build_cloth(8))
    np.testing.assert_allclose(
        solve_positions(XpbdSmallSteps(), problem, 1), solve_positions(Xpbd(), problem, 1), rtol=0, atol=1e-14
    )  # the same terms, added in another order


def test_small_steps_converge_to_the_motion_in_first_order():
    made = chain(0.1, stretch=200.0)
    stated = build_first_problem(made)
    free, n = made.system.free_vertices, made.system.num_vertices

    def motion(t: float, state: np.ndarray) -> np.ndarray:
        p, v = state.reshape(2, n, 3)
        gradient = np.zeros((n, 3))
        made.all_springs.add_gradient(p, gradient)
        a = np.zeros((n, 3))
        a[free] = (made.constant_force - gradient)[free] / made.system.mass[free, None]
        return np.concatenate([v.ravel(), a.ravel()])

    begin = np.concatenate([stated.step_start.positions.ravel(), stated.step_start.velocity.ravel()])
    truth = solve_ivp(motion, (0.0, 0.1), begin, "DOP853", rtol=1e-10, atol=1e-12).y[: 3 * n, -1].reshape(n, 3)
    errors = [np.abs(solve_positions(XpbdSmallSteps(), stated, k) - truth).max() for k in (200, 400, 800)]
    ratios = [a / b for a, b in pairwise(errors)]
    np.testing.assert_allclose(ratios, 2.0, rtol=0.05)  # the next order
    assert errors[-1] <= 5e-3 * np.abs(truth - stated.current_positions).max()  # of order 1/800


def test_pins_that_move_do_so_evenly_in_small_steps():
    rest = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    made = build_random_problem(0, n=2, m=0, weights=(np.inf, 1e12))
    goal = rest + np.array([0.3, 0.2, 0.1])
    start = replace(made.step_start, positions=rest, velocity=np.zeros((2, 3)))
    problem = replace(made, pin_targets=goal, step_start=start, external_force=np.zeros((2, 3)))
    solution = XpbdSmallSteps().prepare(made.system).solve(problem, StopRule(4))
    assert solution.velocity is not None
    np.testing.assert_array_equal(solution.positions[0], goal[0])
    # The penalty yields by 1e-12 of what inertia requires, some hundred times that in the last of the substeps.
    np.testing.assert_allclose(solution.positions[1], goal[1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(solution.velocity, (goal - rest) / made.system.time_step, rtol=1e-7)


@methods
@pytest.mark.parametrize("name", ["chain", "net", "cloth"])
def test_the_heaviest_pins_by_penalty_are_exact_pins(method, name):
    heavy, exact = (solve_positions(method, build_first_problem(SCENE_BUILDERS[name](w)), 20) for w in (1e14, "exact"))
    np.testing.assert_allclose(heavy, exact, rtol=0, atol=1e-10)  # 1e14 N/m give way by 1e-13 m under the cloth


@methods
def test_springs_without_stiffness_and_loops_do_nothing(method):
    problem = build_random_problem(3)
    idle = Springs.from_rest_shape(
        problem.current_positions, np.array([[0, 5], [4, 4], [2, 9]]), np.array([0.0, 100.0, 0.0])
    )
    with_, without = (replace(problem, system=replace(problem.system, energies=e)) for e in ((idle,), ()))
    np.testing.assert_array_equal(solve_positions(method, with_, 5), solve_positions(method, without, 5))


@methods
def test_coincident_vertices_come_apart_along_the_rest_shape(method):
    made = chain()
    problem = build_first_problem(made)
    collapsed = np.zeros_like(problem.current_positions)
    start = replace(problem.step_start, positions=collapsed)
    problem = replace(
        problem,
        inertial_target=collapsed,
        step_start=start,
        pin_targets=np.zeros((2, 3)),
        external_force=0.0 * problem.external_force,
    )
    p = solve_positions(method, problem, 4)
    assert np.isfinite(p).all()
    assert np.abs(p[1:-1, 0]).min() > 0.0
    np.testing.assert_array_equal(p[:, 1:], 0.0)


class Other:
    """An energy that is not of springs."""

    def value(self, p):
        return 0.0

    def add_gradient(self, p, out): ...

    def hessian(self, p):
        raise NotImplementedError


def without_mass(system: System) -> System:
    return replace(system, mass=np.where(np.arange(system.num_vertices) == 3, 0.0, system.mass))


@methods
@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param(lambda s: replace(s, energies=(*s.energies, Other())), "Other", id="another energy"),
        pytest.param(without_mass, r"1 of 12 have none and are not pinned \(3\)", id="no mass"),
    ],
)
def test_unsupported_features_are_refused_before_any_work(method, change, message):
    with pytest.raises(Unsupported, match=message):
        method.prepare(change(build_random_problem(0).system))


def test_small_steps_take_the_place_of_the_integrator():
    with pytest.raises(Unsupported, match="implicit-euler"):
        XpbdSmallSteps().prepare(replace(build_random_problem(0).system, inertia_factor=2.25))


@methods
def test_a_vertex_without_mass_may_be_pinned(method):
    made = chain()
    system = replace(made.system, mass=np.where(np.arange(10) == 0, 0.0, made.system.mass))
    assert np.isfinite(solve_positions(method, replace(build_first_problem(made), system=system), 3)).all()


@methods
def test_a_method_that_does_not_minimise_has_no_residual_and_no_tolerance(method):
    problem = build_first_problem(build_cloth(6))
    solution = method.prepare(problem.system).solve(problem, StopRule(5, 0.5))
    assert (solution.num_iterations, solution.termination_reason) == (5, "max-iter")
    assert np.isnan([solution.residual, solution.initial_residual]).all()


def test_iterates_of_small_steps_are_whole_steps_in_ever_more_substeps():
    problem = build_first_problem(chain())
    prepared = XpbdSmallSteps().prepare(problem.system)
    for k, p in enumerate(islice(prepared.iterates(problem), 4), 1):
        np.testing.assert_array_equal(p, prepared.solve(problem, StopRule(k)).positions)


def test_nothing_but_pins_needs_no_springs():
    system = System(np.ones(3), DT, (), DirichletPins(np.array([1]), np.array([np.inf])))
    problem = replace(build_random_problem(0, n=3, m=0, weights=(np.inf,)), system=system)
    np.testing.assert_allclose(
        solve_positions(Xpbd(), problem, 2)[[0, 2]],
        (problem.inertial_target + DT**2 * problem.external_force)[[0, 2]],
        rtol=1e-15,
    )


def test_stiff_springs_slow_primal_methods_and_heavy_ends_dual_ones():
    # Macklin, Erleben and Mueller 2020.
    plain, stiffer = build_hanging_chain(1e3), build_hanging_chain(1e3, stiffness_ratio=100.0)
    light, heavier = build_hanging_chain(1e5), build_hanging_chain(1e5, mass_ratio=100.0)
    primal, dual = VertexBlockDescent(spectral_radius=0.0), Xpbd()
    problems = plain, stiffer, light, heavier
    found = {solver: [count_iterations(solver, problem) for problem in problems] for solver in (primal, dual)}
    (a, b, c, d), (e, f, g, h) = ([k or MAX_ITERATIONS for k in found[solver]] for solver in (primal, dual))
    assert b > 20 * a
    assert d < c
    assert f < 3 * e
    assert h > 3 * g

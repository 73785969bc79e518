"""MGPBD: where it ends, how much sooner than XPBD, its multigrid, and what it refuses."""

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
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.linalg.multigrid.near_nullspace import (
    PreconditionedSolve,
    ProlongationHierarchy,
    VCycle,
    compute_near_nullspace,
    ordered_norm,
)
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.position_based.mgpbd import MultigridXpbd
from springbench.solvers.methods.position_based.xpbd import Xpbd
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import DirichletPins, StepProblem, StopRule, System, Unsupported

from tests.bench.duals import iterate_mgpbd, iterate_xpbd, record_history
from tests.scene_builders import (
    build_cloth,
    build_first_problem,
    build_random_problem,
    build_step_start,
    build_test_scene,
)
from tests.unit.test_xpbd import Other, without_mass

STIFF = build_first_problem(build_cloth(16, "exact", stretch=1e4))
"""Nine hundred springs, which multigrid takes two levels for."""


def solve_positions(problem: StepProblem, iterations: int, solver: MultigridXpbd | Xpbd | None = None) -> np.ndarray:
    return (solver or MultigridXpbd()).prepare(problem.system).solve(problem, StopRule(iterations)).positions


def hanging(stretch: float, factor: float = 1.0) -> StepProblem:
    pins = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
    mesh = ChainMesh(length=2.0, direction=(0.0, -1.0, 0.0))
    problem = build_first_problem(
        build_test_scene(mesh, SpringsEffect(stretch=stretch), GravityEffect(), pins, size=10)
    )
    return replace(problem, system=replace(problem.system, inertia_factor=factor))


def dual(problem: StepProblem, solver: MultigridXpbd | None = None):
    """The matrix of the first iteration, its right-hand side, and how it is prolonged."""
    made = (solver or MultigridXpbd()).prepare(problem.system)
    run = made.init_state(problem, problem.initial_guess)
    A = made.dual_matrix(made.scaled_constraints(run.positions)[1])
    return A, run.dual_residual, made.build_prolongation(A)


def test_one_spring_ends_where_its_force_is_that_of_inertia():
    """k (l - r) = m/dt^2 (y - l), for a mass that inertia leads to y below where its spring is pinned."""
    k, r, m, dt, y = 500.0, 0.7, 0.3, 0.1, 1.2
    rest = np.array([[0.0, 0.0, 0.0], [0.0, -r, 0.0]])
    springs = Springs.from_rest_shape(rest, np.array([[0, 1]]), np.array([k]))
    system = System(np.full(2, m), dt, (springs,), DirichletPins(np.array([0]), np.array([np.inf])))
    target = np.array([[0.0, 0.0, 0.0], [0.0, -y, 0.0]])
    start = build_step_start(system, target, rest)
    problem = StepProblem(system, target, np.zeros((2, 3)), rest[:1], rest, rest, start)
    diagonal = m / dt**2
    expected = (k * r + diagonal * y) / (k + diagonal)
    np.testing.assert_allclose(
        solve_positions(problem, 1), [[0.0, 0.0, 0.0], [0.0, -expected, 0.0]], rtol=0, atol=1e-15
    )


@pytest.mark.parametrize("stretch", [2.0, 2e3, 2e6])
@pytest.mark.parametrize("factor", [1.0, 2.25], ids="c = {:g}".format)
def test_springs_that_do_not_turn_reach_the_minimiser_of_the_step_at_once(stretch, factor):
    problem = hanging(stretch, factor)
    expected = CompiledLocalGlobal().prepare(problem.system).solve(problem, StopRule(50_000, 1e-14)).positions
    # The first iteration is exact but for round-off, which stiff springs multiply, and the second for less.
    np.testing.assert_allclose(solve_positions(problem, 2), expected, rtol=0, atol=1e-12)


def test_springs_that_turn_in_a_step_leave_an_error_of_fourth_order_in_the_time_step():
    apart = []
    pins = PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"})
    for frames in (24, 48, 96):
        made = build_test_scene(
            ChainMesh(length=2.0), SpringsEffect(stretch=20.0), GravityEffect(), pins, size=10, time_step=0.2 / frames
        )
        prepared = prepare(made, NewtonSolver())
        *_, last = simulate_scene(made, prepared, StopRule(100, 1e-12), initial_guess="previous", frames=frames)
        apart.append(np.abs(solve_positions(last.problem, 20) - last.solution.positions).max())
    np.testing.assert_allclose([a / b for a, b in pairwise(apart)], 16.0, rtol=0.1)  # the next order


@pytest.mark.parametrize(
    "solver", [MultigridXpbd(), MultigridXpbd(near_null_vectors=0), MultigridXpbd(setup_interval=2)]
)
def test_tensions_converge_to_those_of_their_springs_and_those_of_xpbd_do_not(solver):
    mgpbd, xpbd = record_history(iterate_mgpbd(STIFF, solver), 30), record_history(iterate_xpbd(STIFF), 300)
    assert mgpbd.residuals[-1] <= 1e-6
    assert all(a > b for a, b in pairwise([1.0, *mgpbd.residuals]))
    assert xpbd.residuals[-1] >= 1e-2


def test_a_free_cloth_conserves_momentum():
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=3e4), size=6)
    problem = build_first_problem(made)
    velocity = np.random.default_rng(0).normal(size=problem.current_positions.shape)
    moving = replace(problem.step_start, velocity=velocity)
    problem = replace(
        problem, inertial_target=problem.current_positions + made.system.time_step * velocity, step_start=moving
    )
    after = moving.velocity_at(solve_positions(problem, 5))
    np.testing.assert_allclose(made.system.mass @ after, made.system.mass @ velocity, rtol=0, atol=1e-12)


def test_springs_without_stiffness_and_loops_do_nothing():
    problem = build_random_problem(3)
    idle = Springs.from_rest_shape(
        problem.current_positions, np.array([[0, 5], [4, 4], [2, 9]]), np.array([0.0, 100.0, 0.0])
    )
    with_, without = (replace(problem, system=replace(problem.system, energies=e)) for e in ((idle,), ()))
    np.testing.assert_array_equal(solve_positions(with_, 5), solve_positions(without, 5))


@pytest.mark.parametrize("smoothed", [False, True], ids=["unsmoothed", "smoothed"])
def test_the_cycle_is_symmetric_and_positive_definite(smoothed):
    A, _, prolongation = dual(STIFF, MultigridXpbd(smooth_prolongation=smoothed))
    cycle = VCycle(A, prolongation)
    assert cycle.level_sizes[0] > 400 >= cycle.level_sizes[-1]
    r, s = np.random.default_rng(0).normal(size=(2, A.shape[0]))
    zr, zs = cycle.apply_cycle(r), cycle.apply_cycle(s)
    assert abs(s @ zr - r @ zs) <= 1e-10 * np.abs(r * zs).sum()
    assert r @ zr > 0.0


def test_prolongations_reproduce_the_near_null_space_and_are_orthonormal():
    A, _, _ = dual(STIFF)
    B = compute_near_nullspace(A, 6, 30)
    P = ProlongationHierarchy(A, B).prolongators[0]
    gathered = np.diff(P.indptr) > 0
    np.testing.assert_allclose((P.T @ P).toarray(), np.eye(P.shape[1]), rtol=0, atol=1e-12)
    np.testing.assert_allclose((P @ (P.T @ B))[gathered], B[gathered], rtol=0, atol=1e-12)
    assert gathered.mean() > 0.9


def test_sweeps_leave_near_null_space_errors():
    A, _, _ = dual(STIFF)
    rough, smooth = compute_near_nullspace(A, 2, 0), compute_near_nullspace(A, 2, 30)
    resisted = [np.einsum("ij,ij->j", B, A @ B) / np.einsum("ij,ij->j", B, B) for B in (rough, smooth)]
    assert (resisted[1] <= 1e-2 * resisted[0]).all()


def test_the_linear_solve_is_that_of_the_dual_system():
    A, b, prolongation = dual(build_first_problem(build_cloth(16, "exact", stretch=100.0)))
    solving = PreconditionedSolve(A, VCycle(A, prolongation), b, 1e-10)
    assert solving.solve(400) < 400
    np.testing.assert_allclose(A @ solving.x, b, rtol=0, atol=1e-9 * ordered_norm(b))


@pytest.mark.parametrize(("components", "most"), [(0, 40), (6, 80)])
def test_multigrid_makes_up_for_the_length_of_a_chain(components, most):
    """Whose near-kernel is one tension for all; smoothing alone needs hundreds of iterations."""
    pins = PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"})
    long = build_first_problem(
        build_test_scene(ChainMesh(length=2.0), SpringsEffect(stretch=1e4), GravityEffect(), pins, size=1500)
    )
    A, b, prolongation = dual(long, MultigridXpbd(near_null_vectors=components))
    assert PreconditionedSolve(A, VCycle(A, prolongation), b, 1e-6).solve(500) <= most
    prolongation.prolongators.clear()
    assert PreconditionedSolve(A, VCycle(A, prolongation), b, 1e-6).solve(500) > 5 * most


@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param(lambda s: replace(s, energies=(*s.energies, Other())), "mgpbd: .*Other", id="another energy"),
        pytest.param(without_mass, r"mgpbd: .*1 of 12 have none and are not pinned \(3\)", id="no mass"),
    ],
)
def test_unsupported_features_are_refused_before_any_work(change, message):
    with pytest.raises(Unsupported, match=message):
        MultigridXpbd().prepare(change(build_random_problem(0).system))


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"near_null_vectors": -1}, "near_null_vectors"), ({"setup_interval": 0}, "setup_interval")],
)
def test_invalid_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=f"{message}: should be at least"):
        MultigridXpbd(**settings)

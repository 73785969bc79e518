"""Vertex block descent: it descends, and ends where local-global does."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest
from springbench.harness.simulation.time_loop import INITIAL_GUESSES
from springbench.solvers.contact.half_space.half_space_potential import ContactPlanes
from springbench.solvers.contact.half_space.half_space_steps import insert_index
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.vertex_block.vbd import PreparedVertexBlockDescent, SweepState, VertexBlockDescent
from springbench.solvers.model.step_problem import NotPositiveDefinite, StepProblem, StopRule, Unsupported

from tests.contact_scenes import OBSTACLE_SPECS, build_contact, build_sheet, collect_steps
from tests.scene_builders import SCENE_BUILDERS, build_cloth, build_first_problem, build_random_problem
from tests.unit.test_xpbd import Other

METHODS = {"plain": VertexBlockDescent(0.0), "accelerated": VertexBlockDescent()}
methods = pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))

PROBLEMS = {
    "chain": lambda: build_first_problem(SCENE_BUILDERS["chain"](1e10)),
    "net, exact pins": lambda: build_first_problem(SCENE_BUILDERS["net"]("exact")),
    "cloth": lambda: build_first_problem(build_cloth(8)),
    "cloth, exact pins, inertial guess": lambda: build_first_problem(build_cloth(8, "exact"), "inertial"),
    "random": lambda: build_random_problem(0, weights=(1e4, np.inf, 1e2)),
    "random, not pinned": lambda: build_random_problem(1, weights=()),
}
problems = pytest.mark.parametrize("problem", [make() for make in PROBLEMS.values()], ids=list(PROBLEMS))


def iterates(method, problem: StepProblem, count: int) -> list[np.ndarray]:
    prepared = method.prepare(problem.system)
    return [p.copy() for p in islice(prepared.iterates(problem), count)]


@methods
@problems
@pytest.mark.parametrize("factor", [1.0, 2.25], ids="c = {:g}".format)
def test_it_ends_at_the_minimiser_of_local_global(method, problem, factor):
    problem = replace(problem, system=replace(problem.system, inertia_factor=factor))
    # Near the minimiser, where the objective is convex: from far away they may choose other valleys.
    expected = CompiledLocalGlobal().prepare(problem.system).solve(problem, StopRule(30_000, 1e-13)).positions
    near = replace(problem, initial_guess=expected + 1e-3 * np.random.default_rng(0).normal(size=expected.shape))
    found = method.prepare(problem.system).solve(near, StopRule(4000)).positions
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)  # what local-global's rate leaves at its tolerance


STARTS = {
    "the guess": lambda p, rng: p,
    "one point": lambda p, rng: np.zeros_like(p),
    "a line": lambda p, rng: p * [1.0, 0.0, 0.0],
    "a tangle": lambda p, rng: rng.normal(size=p.shape),
    "inside out": lambda p, rng: -p,
    "far apart": lambda p, rng: 1e3 * rng.normal(size=p.shape),
}


@methods
@problems
@pytest.mark.parametrize("start", STARTS)
def test_no_iteration_raises_the_objective(method, problem, start):
    problem = replace(problem, initial_guess=STARTS[start](problem.initial_guess, np.random.default_rng(0)))
    path = iterates(method, problem, 60)
    for before, after in pairwise(path):
        assert problem.value(after) <= problem.value(before) + 1e-13 * problem.value_scale(before)  # a hundred terms
    assert problem.value(path[-1]) < problem.value(path[0])


@methods
@pytest.mark.parametrize("seed", range(5))
def test_vertices_without_mass_descend_as_well(method, seed):
    """Blocks of those are singular where their springs lie in a line or a plane: the majorant's step takes over."""
    problem = build_random_problem(seed)
    light = replace(problem.system, mass=np.where(np.arange(12) % 3, 0.0, problem.system.mass))
    problem = replace(problem, system=light, initial_guess=problem.current_positions * [1.0, 1.0, 0.0])
    for before, after in pairwise(iterates(method, problem, 40)):
        assert np.isfinite(after).all()
        assert problem.value(after) <= problem.value(before) + 1e-13 * problem.value_scale(before)


@pytest.mark.parametrize(("name", "times"), [("cloth", 2), ("block", 4), ("tower", 4)])
def test_acceleration_needs_a_fraction_of_the_iterations(name, times):
    problem = build_first_problem(SCENE_BUILDERS[name](1e10))
    plain, fast = (iterates(method, problem, 100) for method in METHODS.values())
    assert problem.value(fast[100 // times - 1]) <= problem.value(plain[-1])


def test_a_single_vertex_takes_a_newton_step():
    """One free vertex: the iteration is Newton's, and squares the error."""
    made = build_random_problem(0, n=4, m=0, weights=(np.inf,) * 3)
    springs = SCENE_BUILDERS["chain"](1e10).all_springs
    star = replace(springs, edges=np.array([[0, 3], [1, 3], [2, 3]]))
    star = replace(star, stiffness=np.full(3, 50.0), rest_length=np.full(3, 0.2), rest_direction=np.eye(3))
    problem = replace(made, system=replace(made.system, energies=(star,)))
    gradients = [np.abs(problem.gradient(p)).max() for p in iterates(METHODS["plain"], problem, 6)]
    steep = [g for g in gradients if g > 1e-6]
    assert gradients[-1] <= 1e-11  # round-off of forces of some hundred newtons
    assert len(steep) <= 4


@methods
def test_a_tolerance_ends_a_solve_at_the_first_iterate_whose_residual_is_below_it(method):
    problem = build_first_problem(build_cloth(8))
    prepared = method.prepare(problem.system)
    initial_residual = prepared.solve(problem, StopRule(1, 0.5)).initial_residual
    residuals = [prepared.solve(problem, StopRule(k)).residual for k in range(1, 40)]
    below = next(k for k, residual in enumerate(residuals, 1) if residual <= 0.02 * initial_residual)
    solution = prepared.solve(problem, StopRule(100, 0.02))
    assert (solution.num_iterations, solution.termination_reason) == (below, "converged")
    assert solution.residual == residuals[below - 1]


@methods
def test_the_initial_residual_is_taken_at_the_current_positions_whatever_the_first_guess(method):
    found = []
    for guess in INITIAL_GUESSES:
        problem = build_first_problem(replace(build_cloth(8), initial_velocity=(1.0, 0.0, 0.0)), guess)
        found.append(method.prepare(problem.system).solve(problem, StopRule(1, 1e-9)).initial_residual)
    assert len(set(found)) == 1


@methods
def test_a_scene_at_rest_stops_after_one_iteration(method):
    problem = build_first_problem(build_cloth(8))
    p = problem.current_positions
    still = replace(problem, inertial_target=p, external_force=np.zeros_like(p), initial_guess=p)
    solution = method.prepare(problem.system).solve(still, StopRule(50, 1e-6))
    assert solution.num_iterations == 1
    assert solution.termination_reason in ("roundoff", "converged")


@methods
def test_a_solve_that_diverged_reports_it(method):
    problem = build_random_problem(0, weights=())
    lost = replace(problem, initial_guess=np.full_like(problem.initial_guess, np.nan))
    solution = method.prepare(problem.system).solve(lost, StopRule(4, 1e-3))
    assert (solution.num_iterations, solution.termination_reason) == (4, "max-iter")
    assert np.isnan(solution.residual)


@pytest.mark.parametrize("radius", [-0.1, 1.0, 2.0, np.nan])
def test_a_spectral_radius_is_less_than_one(radius):
    with pytest.raises(ValueError, match="spectral_radius"):
        VertexBlockDescent(radius)


def test_unsupported_features_are_refused_before_any_work():
    system = build_random_problem(0).system
    with pytest.raises(Unsupported, match="Other"):
        VertexBlockDescent().prepare(replace(system, energies=(*system.energies, Other())))
    with pytest.raises(NotPositiveDefinite, match="nothing determines"):
        VertexBlockDescent().prepare(replace(system, energies=(), mass=0.0 * system.mass))


def test_a_push_by_pairs_leaves_the_half_spaces_of_obstacles_where_they_were():
    problem = collect_steps(build_sheet(build_contact(OBSTACLE_SPECS["plane"])), 8)[-1].problem
    p, none = problem.initial_guess, np.empty(0)

    def sweeps(problem: StepProblem) -> SweepState:
        prepared = VertexBlockDescent().prepare(problem.system)
        assert isinstance(prepared, PreparedVertexBlockDescent)  # on no device
        return SweepState(prepared, problem, p)

    swept = sweeps(problem).sweep_without_contact(p)
    assert np.any(
        sweeps(replace(problem, system=without_vertex_contact(problem.system))).sweep_without_contact(p) != swept
    )
    after = sweeps(problem)
    after.sweep_with_planes(p, ContactPlanes(none.astype(int), np.empty((0, 3)), none, np.empty((0, 3)), none, none))
    np.testing.assert_array_equal(after.sweep_without_contact(p), swept)


@jit_kernel
def write_set_keys(keys):
    """Write the keys of the sets of one half-space each."""
    for k in range(len(keys)):
        keys[k] = insert_index(0, k)


def test_the_sets_of_active_half_spaces_have_different_keys():
    keys = np.empty(200, np.int64)
    write_set_keys(keys)
    assert keys[:63].tolist() == [2**k for k in range(63)]
    assert len(set(keys.tolist())) == len(keys)

"""The hybrid: where it starts, what it makes of soft and of stiff springs, and how much sooner it is there."""

from __future__ import annotations

from dataclasses import replace
from itertools import count, islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.harness.config.config_loader import load_scene
from springbench.harness.reference.exact_lengths import StationarityEvaluator
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
    PreparedDescent,
    ResidualMetric,
    pick_lowest_positions,
)
from springbench.solvers.iteration.phase_clock import measure_phases
from springbench.solvers.kernels import descent_rounds
from springbench.solvers.kernels.descent_rounds import REASON_SWITCH
from springbench.solvers.kernels.free_components import FreeComponents
from springbench.solvers.kernels.iteration_loop import (
    REASON_ITERATIONS,
    RESIDUAL_EACH,
    RESIDUAL_LAST,
    RESIDUAL_NEVER,
    LoopLimits,
)
from springbench.solvers.linalg.cholesky import symbolic_factorisation
from springbench.solvers.methods.newton import hybrid_newton
from springbench.solvers.methods.newton.hybrid_newton import (
    HybridIteration,
    HybridNewton,
    LbfgsFirstState,
    MeasuredRule,
    MethodChoice,
    PreparedHybrid,
    SolveControl,
)
from springbench.solvers.methods.newton.inertia_shift import InertiaShift
from springbench.solvers.methods.newton.negative_curvature import probe_negative_curvature
from springbench.solvers.methods.newton.newton_direct import NewtonIteration, NewtonSolver
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.methods.quasi_newton.sweep_rounds import ROUND_SWEEPS
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.step_problem import DirichletPins, Positions, StepProblem, StopRule, System
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def stiff(ratio: float) -> StepProblem:
    """A step of a cloth with k dt^2/m = ratio, that gravity pulls."""
    given = build_first_problem(build_cloth(8, "exact"))
    mass = np.full(given.system.num_vertices, 300.0 * given.system.time_step**2 / ratio)
    force = np.zeros_like(given.external_force)
    force[:, 1] = -9.8 * mass
    return replace(given, system=replace(given.system, mass=mass), external_force=force)


@pytest.mark.parametrize("ratio", [1e6, 1e8, 1e10], ids="{:g}".format)
def test_stiff_springs_take_less_than_half_of_newtons_factorisations(ratio):
    """Counted to a gap of 1e-4: 11 and 33, 35 and 135, 65 and 594."""
    given = stiff(ratio)
    prepared = {solver: solver.prepare(given.system) for solver in (NewtonSolver(), HybridNewton())}
    ends = [p.solve(given, StopRule(3000)).positions for p in prepared.values()]
    best, start = min(map(given.value, ends)), given.value(given.current_positions)

    def count_until_close(solver) -> float:
        found = prepared[solver]
        assert isinstance(found, PreparedDescent)
        factor = found.fixed_objective.hessian_matrix.factor  # a factorisation that fails counts as a part
        before, iterates = factor.num_factorisations, islice(found.iterates(given), 3000)
        next(p for p in iterates if given.value(p) - best <= 1e-4 * (start - best))
        return factor.num_factorisations - before

    hybrid, newton = count_until_close(HybridNewton()), count_until_close(NewtonSolver())
    assert hybrid < 0.5 * newton


def test_a_graph_is_ordered_once(monkeypatch):
    """Q for residuals, Q for L-BFGS and the Hessian have one graph."""
    ordered, whole = [0], symbolic_factorisation.nested_dissection_order

    def ordering(*graph):
        ordered[0] += 1
        return whole(*graph)

    monkeypatch.setattr(symbolic_factorisation, "nested_dissection_order", ordering)
    HybridNewton().prepare(stiff(1.0).system)
    assert ordered == [1]
    HybridNewton().prepare(stiff(1.0).system)
    assert ordered == [2]  # the cache lives as long as the prepared solver


@pytest.mark.parametrize("size", [0.9, 1.1])
def test_a_path_to_a_saddle_is_left_where_curvature_is_negative(size):
    """A net in its plane, in which up and down are equivalent: pressed it bends out of it, stretched it stays."""
    given = stiff(1e4)
    flat = given.current_positions * [size, 1.0, size]
    np.testing.assert_array_equal(np.ptp(flat[:, 1]), 0.0)
    pinned = flat[given.system.pins.vertices]
    given = replace(given, inertial_target=flat, pin_targets=pinned, external_force=np.zeros_like(flat))
    step = StepObjective(FixedObjective(given.system), given)
    at, hessian = DescentPoint(flat, step.gradient(flat)), step.hessian(flat)
    assert hessian.factorise(0.0)
    found = probe_negative_curvature(step, at, hessian, np.repeat(ResidualMetric(given.system).free_diagonal, 3))
    if size > 1.0:
        assert found is None
    else:
        assert found is not None
        assert step.objective_change(flat, found.positions)[0] < 0.0
        assert np.ptp(found.positions[:, 1]) > 0.0


def inertial_prediction(given: StepProblem) -> Positions:
    fall = given.inertial_target + given.external_force / given.system.inertia_diagonal[:, None]
    fall[given.system.pins.vertices] = given.pin_targets
    return fall


@pytest.mark.parametrize("guess", ["previous", "solution"])
def test_the_first_segment_of_iterations_is_that_of_lbfgs(guess, monkeypatch):
    """Its iterates are some of those of L-BFGS, bit for bit, from the lower one of the guess and the prediction."""
    monkeypatch.setattr(hybrid_newton, "_SWEEP_FIRST_RATIO", 0.0)
    given = stiff(0.1)
    prepared, lbfgs = HybridNewton().prepare(given.system), Lbfgs(precision="float32").prepare(given.system)
    fall = inertial_prediction(given)
    if guess == "solution":
        given = replace(given, initial_guess=lbfgs.solve(given, StopRule(4)).positions)
    assert (given.value(fall) < given.value(given.initial_guess)) == (guess == "previous")
    start = fall if guess == "previous" else given.initial_guess
    path = [p.copy() for p in islice(lbfgs.iterates(replace(given, initial_guess=start)), 5)]
    numbers = [0]
    for p in prepared.iterates(given):
        numbers.append(next(i for i in range(numbers[-1] + 1, 6) if np.array_equal(path[i - 1], p)))
        if numbers[-1] == len(path):
            break
    assert {4, 5} <= set(numbers)  # where the rule decides


@pytest.mark.parametrize("name", ["current", "target", "prediction"])
@pytest.mark.parametrize("is_compiled", [True, False])
def test_a_solve_from_the_current_positions_starts_at_the_lowest_of_three_points(name, is_compiled):
    """Soft springs let a flat cloth fall; stiff ones resist motion in its plane, but no small one out of it."""
    given = stiff(0.1 if name == "prediction" else 1e4)
    if name != "prediction":
        pull = given.external_force[:, [1, 0, 2]]
        moved = 2.0 * given.inertial_target if name == "current" else given.inertial_target + np.array([0.0, 1e-3, 0.0])
        given = replace(given, external_force=pull, inertial_target=moved)
    prepared = HybridNewton().prepare(given.system)
    assert isinstance(prepared, PreparedHybrid)
    step = StepObjective(prepared.fixed_objective, given)
    points = {
        "current": step.apply_exact_pins(given.current_positions),
        "target": step.inertial_target(),
        "prediction": step.inertial_prediction(),
    }
    assert min(points, key=lambda one: given.value(points[one])) == name
    if is_compiled:
        run, rounds = prepared.method.prepare_lbfgs(given, given.current_positions), prepared.method.init_rounds()
        run.start_lowest(rounds)
        found, decrease = run.start_positions, rounds["earlier_decrease"][0]
    else:
        found, decrease = pick_lowest_positions(step, points["current"], points["target"], points["prediction"])
    np.testing.assert_array_equal(found, points[name])
    assert decrease == pytest.approx(given.value(points["current"]) - given.value(found))


def sweep_with_restarts(given: StepProblem, p: Positions, num_sweeps: int) -> Positions:
    """Sweeps with Nesterov's extrapolation, which restarts where a sweep turns against the last movement."""
    descent = VertexBlockDescent(spectral_radius=0.0).prepare(given.system)
    extrapolated, count = p, 0
    for _ in range(num_sweeps):
        before, p = p, descent.solve(replace(given, initial_guess=extrapolated), StopRule(1)).positions
        count = count + 1 if np.sum((p - extrapolated) * (p - before)) >= 0.0 else 0
        extrapolated = p + count / (count + 1) * (p - before)
    return p


@pytest.mark.parametrize("guess", ["previous", "solution"])
def test_soft_springs_are_first_left_to_sweeps(guess):
    """The first iterate is that of as many sweeps, from the lower one of the guess and the prediction."""
    given = stiff(0.1)
    prepared, descent = HybridNewton().prepare(given.system), VertexBlockDescent().prepare(given.system)
    start = fall = inertial_prediction(given)
    if guess == "solution":
        start = descent.solve(given, StopRule(4)).positions
        given = replace(given, initial_guess=start)
    assert (given.value(fall) < given.value(given.initial_guess)) == (guess == "previous")
    found = next(prepared.iterates(given))
    np.testing.assert_allclose(found, sweep_with_restarts(given, start, ROUND_SWEEPS), rtol=1e-13, atol=1e-15)


def build_rounds_at(**fields):
    """The state of rounds after ten iterations, with a residual of one before the last segment."""
    (rounds,) = descent_rounds.init_rounds(4.0, 0.1, 3, 5e-5).view(np.recarray)
    rounds.num_iterations, rounds.segment_residual = 10, 1.0
    for name, value in fields.items():
        setattr(rounds, name, value)
    return rounds


@pytest.mark.parametrize("earlier_decrease", [0.0, 3.0])
@pytest.mark.parametrize(("last_decrease", "follow"), [(2.1e-4, 0), (1.9e-4, 1)])
def test_sweeps_follow_iterations_near_the_minimum_only(last_decrease, follow, earlier_decrease):
    """The last four iterations decrease the objective by at most 2e-4 of the decrease since the initial guess."""
    last_decrease *= 1.0 + earlier_decrease
    rounds = build_rounds_at(late_start=6, late_decrease=1.0 - last_decrease, earlier_decrease=earlier_decrease)
    descent_rounds._choose_sweeps(rounds, 1.0, 0.5)
    assert rounds.is_sweeping == follow
    assert rounds.late_rate == pytest.approx(last_decrease / 4.0)


@pytest.mark.parametrize(("ratio", "fraction"), [(4990.0, 5e-3), (5010.0, 5e-5)])
def test_sweeps_follow_earlier_in_soft_systems(ratio, fraction):
    """A system is soft up to a ratio of 5000 of the diagonal of Q, 1 + c k dt^2/m, to the inertia."""

    def prepare_method(stiffness: float) -> HybridIteration:
        prepared = HybridNewton().prepare(stiff(stiffness).system)
        assert isinstance(prepared, PreparedHybrid)
        return prepared.method

    method = prepare_method(1.0)
    factor = (method.metric.free_diagonal / method.inertia_diagonal[::3]).max() - 1.0
    assert prepare_method((ratio - 1.0) / factor).init_rounds()["near_fraction"] == fraction


@pytest.mark.parametrize(("mode", "num_rounds"), [(RESIDUAL_LAST, 3), (RESIDUAL_EACH, 1)])
def test_rounds_end_at_a_limit_of_the_residual_that_is_computed_in_each(mode, num_rounds):
    iterate = descent_rounds.build_rounds(
        lambda state, size: size, lambda state, exact_below: 0.1, lambda state: 0.0, lambda state: None
    )
    rounds = descent_rounds.init_rounds(4.0, 0.1).view(np.recarray)
    assert iterate(None, rounds, LoopLimits(3, 0.5, 0.0, mode))[0] == num_rounds


@pytest.mark.parametrize(
    ("residual", "decrease", "late_rate", "follow"),
    [(0.32, 1.1, np.inf, 0), (0.31, 1.1, np.inf, 1), (0.9, 1.31, 0.1, 1), (0.9, 1.29, 0.1, 0)],
)
def test_more_sweeps_follow_if_they_reduce_the_objective_to_a_tenth_or_faster_than_the_last_segment(
    residual, decrease, late_rate, follow
):
    """Residuals are square roots of objectives. A round of sweeps costs three iterations."""
    rounds = build_rounds_at(is_sweeping=1, late_decrease=1.0, late_rate=late_rate)
    descent_rounds._choose_sweeps(rounds, decrease, residual)
    assert rounds.is_sweeping == follow
    assert rounds.late_rate == late_rate
    assert rounds.segment_end == rounds.num_iterations + descent_rounds.SEGMENT_ITERATIONS


def squeeze_cloth(ratio: float) -> StepProblem:
    """A cloth whose edges are moved together by a tenth: its Hessian is indefinite."""
    given = stiff(ratio)
    squeezed = given.current_positions * [0.9, 1.0, 1.0]
    return replace(given, initial_guess=squeezed, inertial_target=squeezed, external_force=given.external_force / 10.0)


@pytest.mark.parametrize(("lbfgs_gain", "num_attempts"), [(np.inf, 2), (0.0, 1)])
def test_predicted_tensions_follow_the_second_hessian_without_a_factor(lbfgs_gain, num_attempts):
    """Or the first one, if L-BFGS has ended."""
    given = squeeze_cloth(1e3)
    prepared = HybridNewton().prepare(given.system)
    assert isinstance(prepared, PreparedHybrid)
    method, step = prepared.method, StepObjective(prepared.fixed_objective, given)
    run = method.start_lbfgs(step, given.initial_guess)
    start = DescentPoint(given.initial_guess, step.gradient(given.initial_guess))
    choice = MethodChoice(method, step, given.initial_guess, run, SolveControl(), method.init_rounds(), start)
    choice._gains |= {"lbfgs": lbfgs_gain, "newton": 1.0}
    for attempt in range(1, num_attempts + 1):
        assert choice._take_exact_steps().positions is given.initial_guess
        assert choice._gains["predicted tensions"] == (np.inf if attempt == num_attempts else 0.0)


def test_lbfgs_retains_its_history_after_an_attempt_without_a_step():
    """After predicted tensions it starts again, with the decrease since the initial guess."""
    given = squeeze_cloth(1e3)
    prepared = HybridNewton().prepare(given.system)
    assert isinstance(prepared, PreparedHybrid)
    method, step, p = prepared.method, StepObjective(prepared.fixed_objective, given), given.initial_guess
    run, rounds = method.start_lbfgs(step, p), method.init_rounds()
    choice = MethodChoice(method, step, p, run, SolveControl(), rounds)
    points = choice.iterate_points()
    assert next(points).positions is not p
    choice._is_trial_due = True
    before, found = rounds["num_iterations"][0], next(points)
    assert choice._control.solver_phases["newton"][0] == 0
    assert choice._run is run
    assert rounds["num_iterations"][0] > before
    choice._gains |= {"lbfgs": 1e-99, "predicted tensions": np.inf}
    found = next(points)
    assert choice._run is None
    choice._gains["lbfgs"] = np.inf
    next(points)
    assert choice._run is not run
    decrease = given.value(p) - given.value(found.positions)
    assert rounds["earlier_decrease"][0] == pytest.approx(decrease, rel=1e-9)


def test_residuals_of_lbfgs_in_float32_are_those_of_the_metric():
    given = stiff(1e3)
    prepared = HybridNewton().prepare(given.system)
    assert isinstance(prepared, PreparedHybrid)
    assert "float32" in prepared.description
    run = prepared.init_state(given, given.initial_guess)
    assert isinstance(run, LbfgsFirstState)
    run.run_iterations(LoopLimits(4, 0.0, 0.0, RESIDUAL_NEVER))
    assert run.residual() == pytest.approx(prepared.metric.residual(given.gradient(run.positions)), rel=1e-6)
    assert not run.solver_phases.keys() - {"lbfgs"}
    found = prepared.solve(given, StopRule(300, 1e-12))
    assert found.termination_reason == "converged"
    assert found.solver_phases is not None
    assert "newton" in found.solver_phases
    assert found.residual == pytest.approx(prepared.metric.residual(given.gradient(found.positions)), rel=1e-3)


def test_sweeps_help_lbfgs_where_springs_are_compressed(monkeypatch):
    """A gap of 1e-6 takes fewer iterations and sweeps."""
    given = squeeze_cloth(1e3)
    lowest = NewtonSolver().prepare(given.system).solve(given, StopRule(300, 1e-10)).positions
    counts = []
    for max_ratio in (hybrid_newton._MAX_SWEEP_RATIO, 0.0):
        monkeypatch.setattr(hybrid_newton, "_MAX_SWEEP_RATIO", max_ratio)
        prepared, start = HybridNewton().prepare(given.system), given.value(given.initial_guess)
        assert isinstance(prepared, PreparedHybrid)
        run: Any = prepared.init_state(given, given.initial_guess)
        while given.value(run.positions) - given.value(lowest) > 1e-6 * (start - given.value(lowest)):
            run.step_state()
        counts.append(int(run._rounds["num_iterations"][0]))
    assert counts[0] < counts[1]


def test_a_solve_by_lbfgs_alone_prepares_nothing_for_the_other_methods(monkeypatch):
    given, prepared = stiff(0.1), HybridNewton().prepare(stiff(0.1).system)
    expected = prepared.residual_at(given, given.current_positions)
    monkeypatch.setattr(hybrid_newton, "StepObjective", None)
    monkeypatch.setattr(hybrid_newton, "MethodChoice", None)
    found = prepared.solve(given, StopRule(50, 1e-3))
    assert found.solver_phases is not None
    assert set(found.solver_phases) == {"lbfgs"}
    assert found.termination_reason == "converged"
    assert found.initial_residual == expected


def test_a_solve_without_iterations_stays_at_the_guess():
    given, prepared = stiff(0.1), HybridNewton().prepare(stiff(0.1).system)
    found = prepared.solve(given, StopRule(0))
    np.testing.assert_array_equal(found.positions, given.initial_guess)
    assert found.residual == pytest.approx(prepared.residual_at(given, given.initial_guess), rel=1e-6)


@pytest.mark.parametrize("check_cost", [0.0, 0.1, 0.5, 20.0])
def test_a_round_costs_a_quarter_more_than_the_least_and_ends_at_decisions(check_cost):
    """n c/s + s/2 for the checks of n iterations, and for those that the last round makes in vain.

    Rounds with cheap checks are also short relative to the iterations before them.
    """
    (rounds,) = descent_rounds.init_rounds(1.0, check_cost, 3).view(np.recarray)
    rounds.segment_end, ends = rounds.group_end, {0}
    while rounds.num_iterations < 200:
        size, n = descent_rounds.round_size(rounds), int(rounds.num_iterations)
        most, left = 1.25 * (2.0 * check_cost * n) ** 0.5, (4 if n < 4 else rounds.group_end) - n
        left = min(left, 1 + n // 16) if check_cost < 1.0 else left
        assert 1 <= size <= left
        assert size in (1, left) or n * check_cost / (size - 1) + (size - 1) / 2.0 <= most
        assert size == left or n * check_cost / (size + 1) + (size + 1) / 2.0 > most
        rounds.num_iterations += size
        ends.add(int(rounds.num_iterations))
        if rounds.num_iterations == rounds.group_end:
            rounds.group_end += descent_rounds.GROUP_ITERATIONS
            rounds.segment_end = rounds.group_end
    assert {4, *range(10, 201, 10)} <= ends


@pytest.mark.parametrize("guess", ["fall", "rest"])
def test_free_flight_is_found_at_once_from_any_guess(guess):
    """Without springs the minimum is free fall."""
    n = 5
    given = build_random_problem(0, n=n, m=1, weights=())
    system = System(given.system.mass, given.system.time_step, (), DirichletPins())
    given = replace(given, system=system)
    fall = inertial_prediction(given)
    given = replace(given, initial_guess=fall if guess == "fall" else given.current_positions)
    found = next(HybridNewton().prepare(system).iterates(given))
    np.testing.assert_allclose(found, fall, rtol=1e-14, atol=1e-14)  # a sum and a quotient, in another order


def test_vertices_without_mass_do_not_fall():
    given = build_random_problem(2, n=20, m=60)
    mass = np.where(np.arange(20) % 2, 0.0, 1.0)
    given = replace(given, system=replace(given.system, mass=mass))
    solution = HybridNewton().prepare(given.system).solve(given, StopRule(200))
    assert np.isfinite(solution.positions).all()
    assert solution.termination_reason == "stalled"


def test_no_iterate_is_higher_than_the_one_before():
    given = stiff(1e6)
    path = [p.copy() for p in islice(HybridNewton().prepare(given.system).iterates(given), 60)]
    values = [given.value(p) for p in (given.initial_guess, *path)]
    # Sums of a thousand terms, each good to round-off over the strain of its spring.
    assert (np.diff(values) <= 1e-12 * given.value_scale(path[0])).all()


@pytest.mark.parametrize(("ratio", "names"), [(0.1, {"lbfgs"}), (1e6, {"lbfgs", "predicted tensions", "newton"})])
def test_the_phases_of_a_solve_add_up_to_its_iterations(ratio, names):
    """Soft springs are left to L-BFGS; for stiff ones all three methods are measured. Two solves decide alike."""
    given, prepared = stiff(ratio), HybridNewton().prepare(stiff(ratio).system)
    one, two = (prepared.solve(given, StopRule(300, 1e-4)) for _ in range(2))
    assert one.solver_phases is not None
    assert set(one.solver_phases) == names
    assert sum(count for count, _, _ in one.solver_phases.values()) == one.num_iterations
    assert all(cost > 0.0 for _, cost, _ in one.solver_phases.values())
    assert one.solver_phases == two.solver_phases
    np.testing.assert_array_equal(one.positions, two.positions)


@pytest.mark.parametrize("ratio", [0.1, 1e6])
def test_the_clock_is_read_where_the_method_changes_and_decides_nothing(ratio):
    """A clock that advances by one at each reading: the times of the phases are all of those between its readings."""
    given, prepared = stiff(ratio), HybridNewton().prepare(stiff(ratio).system)
    unmeasured, readings = prepared.solve(given, StopRule(300, 1e-4)), count()
    with measure_phases(lambda: float(next(readings))):
        found = prepared.solve(given, StopRule(300, 1e-4))
    assert found.solver_phases is not None
    assert unmeasured.solver_phases == {name: (n, cost, 0.0) for name, (n, cost, _) in found.solver_phases.items()}
    np.testing.assert_array_equal(found.positions, unmeasured.positions)
    num_readings = next(readings)
    assert sum(seconds for _, _, seconds in found.solver_phases.values()) == num_readings - 1
    assert all(seconds > 0.0 for _, _, seconds in found.solver_phases.values())
    assert num_readings == len(found.solver_phases) + 1  # none of the methods is used twice


def test_a_solve_ends_at_the_first_of_its_iterates_that_satisfies_the_tolerance():
    """Rounds of L-BFGS are done many at a time, and the rule looks at each."""
    given, prepared = stiff(1.0), HybridNewton().prepare(stiff(1.0).system)
    found = prepared.solve(given, StopRule(300, 1e-6))
    path = [p.copy() for p in islice(prepared.iterates(given), found.num_iterations)]
    np.testing.assert_array_equal(path[-1], found.positions)
    residuals = [prepared.residual_at(given, p) for p in path]
    limit = 1e-6 * found.initial_residual
    assert residuals[-1] <= 1.001 * limit  # a factor of Q in another order of operations
    assert min(residuals[:-1]) > 0.999 * limit


def test_a_failed_factorisation_counts_by_the_operations_before_it_fails():
    prepared = HybridNewton().prepare(stiff(1.0).system)
    assert isinstance(prepared, PreparedHybrid)
    graph = prepared.method.factor
    n = graph.fronts.diagonal_block
    blocks = np.zeros((graph.fronts.block_index.max() + 1, 3, 3))
    assert not graph.factorise(blocks)
    least = graph.num_factorisations
    assert 0.0 < least < 1.0
    blocks[n] = np.eye(3)
    assert graph.factorise(blocks)
    assert graph.num_factorisations == least + 1.0


def test_factorisations_of_an_extended_pattern_are_counted_with_the_others():
    """A step extends the pattern where contact needs more blocks; costs of methods count them all."""
    objective = FixedObjective(stiff(1.0).system)
    base, n = objective.hessian_matrix, len(objective.system.free_vertices)
    extended = objective.matrix_with_blocks(*np.triu_indices(n, 1))
    assert extended.graph.nnz == n * n > base.graph.nnz
    blocks = np.zeros((extended.graph.nnz, 3, 3))
    blocks[extended.graph.indices == np.repeat(np.arange(n), n)] = np.eye(3)
    assert extended.factor.factorise(blocks)
    assert base.factor.num_factorisations == 1.0


def test_the_shift_approaches_the_smallest_one_that_has_a_factor():
    """Where the model is accurate, a smaller shift is tried; a failed attempt brings the next one closer."""
    shift, smallest, attempts = InertiaShift(0.0, 1e3), 1.7, list[float]()

    def attempt(value: float) -> float | None:
        attempts.append(value)
        return value if value >= smallest else None

    for _ in range(30):
        assert shift.find_smallest(attempt) == shift.value
        shift.can_reduce = True
    assert smallest <= shift.value < 1.05 * smallest
    assert len(attempts) < 2.1 * 30


def test_a_shift_beyond_the_largest_one_is_infinite_until_the_model_is_accurate():
    shift = InertiaShift(0.0, 10.0)
    assert shift.find_smallest(lambda value: value if value == np.inf else None) == np.inf
    assert shift.find_smallest(lambda value: value) == np.inf
    shift.can_reduce = True
    assert shift.find_smallest(lambda value: value) == 10.0


@pytest.mark.parametrize(("case", "frames"), [("numbers-micrometres", 8), ("scales-cubes-1e9-m-apart", 2)])
def test_round_off_of_some_vertices_does_not_stop_the_others(case, frames):
    """Stiff pins that cannot move by less than their last digit, and a cube whose last digit is a tenth of a micron."""
    made, found = build_scene(load_scene(CONFIGS / "hard" / f"{case}.yaml"), 0), StationarityEvaluator()
    steps = simulate_scene(
        made, prepare(made, HybridNewton()), StopRule(300, 1e-6), initial_guess="previous", frames=frames
    )
    for step in steps:
        for problem, solution in step.stages:
            assert found(problem, solution.positions).above_roundoff <= 1.1e-6


def test_no_newton_step_is_taken_where_lbfgs_is_sooner_at_the_limit():
    """Without a limit of the residual Newton's method follows L-BFGS, since it is predicted to gain the whole rest."""
    given, prepared = stiff(10.0), HybridNewton().prepare(stiff(10.0).system)
    endless = prepared.solve(given, StopRule(60)).solver_phases
    limited = prepared.solve(given, StopRule(300, 1e-3)).solver_phases
    assert endless is not None
    assert limited is not None
    assert "newton" in endless
    assert set(limited) == {"lbfgs"}


class ShiftedHessian:
    """A Hessian that has a factor with a shift, and without one where it is definite."""

    num_factorisations = 0.0

    def __init__(self, is_definite: bool) -> None:
        self.is_definite = is_definite

    def factorise(self, scale: float = 1.0, shift: Any = 0.0) -> bool:
        self.num_factorisations += 1.0
        return self.is_definite or bool(np.any(shift))

    def solve(self, b: Positions) -> Positions:
        return b


@pytest.mark.parametrize("is_definite", [True, False])
def test_only_a_step_by_the_unmodified_hessian_agrees_with_its_model(is_definite: bool):
    """A step that decreases the objective by half of its slope; by a shifted Hessian it may end at a saddle."""
    given = stiff(10.0)
    step, p, inertia = StepObjective(FixedObjective(given.system), given), given.initial_guess, np.ones(3)
    at, length = DescentPoint(p, step.gradient(p)), 1e-12
    slope = np.vdot(at.gradient, at.gradient)
    while -step.objective_change(p, p - length * at.gradient)[0] > 0.6 * length * slope:
        length *= 1.1
    hessian: Any = ShiftedHessian(is_definite)
    rule = MeasuredRule(inertia, hessian)
    assert rule.factorise_hessian(hessian, at, inertia) == (0 if is_definite else 1)
    rule.record_step(step, hessian, at, DescentPoint(p - length * at.gradient, at.gradient))
    assert rule.agrees_with_model == is_definite


@pytest.mark.parametrize(
    ("agrees", "decrement_ratio", "gain_ratio", "faster"),
    [
        (True, 0.24, 0.5, True),  # 0.5 of the error per group: 0.25 during a step, which costs two groups
        (True, 0.26, 0.5, False),
        (True, 0.26, 1.0, True),  # there are no two groups to compare with
        (False, 0.0, 0.5, False),
    ],
)
def test_newtons_method_continues_if_it_converges_faster_than_lbfgs(agrees, decrement_ratio, gain_ratio, faster):
    choice = object.__new__(MethodChoice)
    measured: Any = SimpleNamespace(agrees_with_model=agrees, decrement_ratio=decrement_ratio)
    method: Any = SimpleNamespace(newton_cost=2.0)
    choice._measured_rule, choice._method = measured, method
    choice._rounds = np.array([(gain_ratio,)], [("gain_ratio", np.float64)])
    assert choice._converges_faster is faster


@pytest.mark.parametrize(
    ("gain", "reason"),
    [(0.74, REASON_ITERATIONS), (0.76, REASON_SWITCH), (0.99, REASON_SWITCH), (1.01, REASON_ITERATIONS)],
)
def test_lbfgs_ends_if_two_newton_steps_cost_less_than_what_is_left(gain, reason):
    """1 / (1 - q) exceeds four groups, the cost of two steps, from q = 3/4 on; growing decreases predict nothing."""
    rounds = build_rounds_at(newton_cost=2.0, gain=1.0, group_start=0.0)
    assert descent_rounds._assess_round(rounds, gain, 1.0, 0.0) == reason
    assert rounds.gain_ratio == gain


def test_the_decrement_ratio_is_that_of_the_hessian_before_the_step():
    """A solve from near the minimum: the ratio of g'H^-1 g after and before a step, with the factor before it."""
    given = stiff(1e3)
    lowest = NewtonSolver().prepare(given.system).solve(given, StopRule(300, 1e-10)).positions
    objective, metric = FixedObjective(given.system), ResidualMetric(given.system)
    step = StepObjective(objective, given)
    p = lowest + 1e-5 * np.sin(np.arange(lowest.size)).reshape(lowest.shape)
    p = step.apply_exact_pins(p)
    at = DescentPoint(p, step.gradient(p))
    inertia = np.repeat(given.system.inertia_diagonal[given.system.free_vertices], 3)
    rule = MeasuredRule(inertia, objective.hessian_matrix.factor)
    to, _ = NewtonIteration(metric).next_point(step, at, 0.0, rule)
    assert rule.agrees_with_model
    hessian = step.hessian(p)
    assert hessian.factorise()
    after, before = (np.sum(g * hessian.solve(g)) for g in (to.gradient, at.gradient))
    assert rule.decrement_ratio == pytest.approx(after / before, rel=1e-6)
    assert 0.0 < rule.decrement_ratio < 0.1


@pytest.mark.parametrize(("ratio", "is_very_stiff"), [(1e3, False), (1e12, True)])
def test_a_very_stiff_system_takes_gradients_from_the_objective(ratio, is_very_stiff):
    given = stiff(ratio)
    prepared = HybridNewton().prepare(given.system)
    assert isinstance(prepared, PreparedHybrid)
    method, step = prepared.method, StepObjective(prepared.fixed_objective, given)
    assert method.is_very_stiff == is_very_stiff
    assert (method.residual_lbfgs is None) == is_very_stiff
    run = method.start_lbfgs(step, given.initial_guess)
    run.step_state()
    expected = step.gradient(run.positions) if is_very_stiff else run.gradient()
    np.testing.assert_array_equal(method.read_point(step, run).gradient, expected)
    solve = prepared.init_state(given, given.initial_guess)
    assert isinstance(solve, LbfgsFirstState)
    solve.step_state()
    expected = step.gradient(solve.positions)
    if is_very_stiff:
        np.testing.assert_array_equal(solve._current_point().gradient, expected)
    else:
        np.testing.assert_allclose(
            solve._current_point().gradient, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max()
        )


def test_a_free_net_conserves_its_momentum():
    # Sweeps change vertices one by one: without a correction the centre moves by 9e-5 m.
    spec = load_scene(CONFIGS / "hard-long" / "long-spinning-net.yaml")
    scene = build_scene(spec, spec.default_size or 0)
    prepared, centres = prepare(scene, HybridNewton()), []
    for step in simulate_scene(scene, prepared, StopRule(50, 1e-6), initial_guess="previous", frames=400):
        centres.append(np.average(step.state.motion.positions, axis=0, weights=scene.system.mass))
    assert np.ptp(centres, axis=0).max() <= 1e-11


@pytest.mark.parametrize("pin_weight", [np.inf, 1.0])
def test_only_components_without_pins_are_free(pin_weight: float):
    graph = csr_array(np.kron(np.eye(3), [[2.0, -1.0], [-1.0, 2.0]]))
    system = System(mass=np.ones(6), time_step=1.0, pins=DirichletPins(np.array([2]), np.array([pin_weight])))
    graph += csr_array(np.diag([0.0, 0.0, 0.0, 0.0, 1.0, 0.0]))  # an energy that holds a vertex of the third component
    found = FreeComponents.from_matrix(system, graph, np.repeat(np.arange(3, dtype=np.int32), 2))
    assert found.starts.tolist() == [0, 2]
    assert found.vertices.tolist() == [0, 1]

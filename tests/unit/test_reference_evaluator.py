"""The reference evaluator of stationarity: round-off is bounded per vertex, and no part of a scene hides another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.reference import reference_evaluator as oracle_module
from springbench.harness.reference.certified_minimum import refine_minimum
from springbench.harness.reference.reference_evaluator import (
    ReferenceEvaluator,
    assemble_stiffness,
    measure_component_sizes,
    measure_graph_components,
)
from springbench.harness.reference.step_verifier import StepVerifier
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.time_loop import MotionState, SimulationStep, build_initial_state, build_problem
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, Solution, StepProblem, StopRule

HARD = Path(__file__).resolve().parents[2] / "configs" / "hard"
SCENES = HARD.with_name("scenes")


def case(name: str) -> tuple[Scene, StepProblem]:
    spec = load_scene(HARD / f"{name}.yaml")
    made = build_scene(spec, spec.default_size or 0)
    return made, build_problem(made, build_initial_state(made), "previous")


def solve_to_roundoff(stated: StepProblem) -> Positions:
    """Where Newton's method leads, and then Newton's steps by the reference, to round-off."""
    return refine_minimum(stated, stated.current_positions, NewtonSolver()).positions.copy()


@pytest.mark.parametrize("name", ["effects-strain-limits-1e13", "effects-strain-limits-1e18"])
def test_limits_that_are_not_reached_do_not_make_a_chain_in_the_air_right(name: str):
    _, stated = case(name)
    oracle = ReferenceEvaluator(stated.system)
    assert oracle.measure_stationarity(stated, stated.current_positions).above_roundoff == pytest.approx(1.0)
    assert oracle.measure_stationarity(stated, stated.current_positions).roundoff_bound < 1e-9
    best = solve_to_roundoff(stated)
    assert oracle.measure_stationarity(stated, best).above_roundoff <= 1e-6
    assert stated.value(best) < stated.value(stated.current_positions) - 1e-3


@pytest.mark.parametrize("name", ["scales-cubes-1e6-m-apart", "scales-cubes-1e9-m-apart"])
def test_a_far_component_does_not_hide_that_a_near_one_is_moved(name: str):
    """At 1e9 m positions are rounded to 1e-7 m, which is 10 N for springs of 1e8 N/m: none of the near cube's."""
    _, stated = case(name)
    oracle, best = ReferenceEvaluator(stated.system), solve_to_roundoff(stated)
    assert oracle.measure_stationarity(stated, best).above_roundoff <= 1e-6
    moved = best.copy()
    moved[0] += 0.087 / 3**0.5
    assert oracle.measure_stationarity(stated, moved).above_roundoff > 1.0


def test_a_distance_counts_by_the_size_of_its_own_component():
    made, stated = case("scales-cubes-1e6-m-apart")
    known = solve_to_roundoff(stated)
    moved = known.copy()
    moved[0, 0] += 0.087
    state = MotionState(Motion(moved, np.zeros_like(moved)), None, 1)
    solution = Solution(moved, 1, 0.0, 0.0, "max-iter")
    step = SimulationStep(stated, solution, state, (1,), ((stated, solution),), StopRule())
    row = StepVerifier(made, known[None], is_minimiser=False)(step)
    assert row["reference_distance"] == pytest.approx(0.087 / 3**0.5)


def test_a_component_is_as_large_as_its_box_and_a_lone_vertex_as_the_others():
    made, _ = case("topology-components")
    found = measure_component_sizes(made.system, made.mesh.rest_positions)
    np.testing.assert_allclose(found, [0.3] * 8 + [0.02**0.5] * 3, rtol=1e-12)
    p = np.array([[0.0, 0, 0], [3.0, 4.0, 0], [7.0, 7, 7]])
    graph = assemble_stiffness(made.system)[:3][:, :3]
    graph[0, 2] = graph[1, 2] = graph[2, 0] = graph[2, 1] = 0.0
    graph.eliminate_zeros()
    np.testing.assert_allclose(measure_graph_components(graph, p), [5.0, 5.0, 5.0])
    np.testing.assert_allclose(measure_graph_components(graph[2:][:, 2:], p[2:]), [1.0])


def test_a_scene_at_rest_is_stationary_by_round_off_alone():
    made, stated = case("topology-components")
    p = solve_to_roundoff(stated)
    at_rest = replace(stated, current_positions=p, initial_guess=p)
    oracle = ReferenceEvaluator(made.system)
    assert oracle.measure_stationarity(at_rest, p).above_roundoff == 0.0
    assert oracle.measure_stationarity(at_rest, p).stationarity <= 1.0


@pytest.mark.parametrize("name", ["geometry-random-stiff-block", "numbers-mass-ratio-1e8", "topology-components"])
def test_of_large_systems_conjugate_gradients_give_nearly_the_same_and_never_more(
    name: str, monkeypatch: pytest.MonkeyPatch
):
    made, stated = case(name)
    exact = ReferenceEvaluator(made.system).compute_residual(stated, stated.current_positions)
    monkeypatch.setattr(oracle_module, "MAX_DIRECT_NNZ", 0)
    assert (
        0.9 * exact
        <= ReferenceEvaluator(made.system).compute_residual(stated, stated.current_positions)
        <= exact * (1 + 1e-9)
    )


@pytest.mark.parametrize(("scene", "size"), [("hanging-cloth", 45), ("flag-in-wind", 55)])
def test_conjugate_gradients_give_four_digits_over_levels_of_multigrid(
    scene: str, size: int, monkeypatch: pytest.MonkeyPatch
):
    made = build_scene(load_scene(SCENES / f"{scene}.yaml"), size)
    stated, far = build_problem(made, build_initial_state(made), "previous"), made.mesh.rest_positions**3
    exact = [ReferenceEvaluator(made.system).compute_residual(stated, p) for p in (stated.current_positions, far)]
    monkeypatch.setattr(oracle_module, "MAX_DIRECT_NNZ", 0)
    oracle = ReferenceEvaluator(made.system)
    found = [oracle.compute_residual(stated, p) for p in (stated.current_positions, far)]
    assert len(oracle._multigrid.level_sizes) > 1, "a mesh of 2,000 vertices is coarsened"  # pyright: ignore[reportPrivateUsage]
    np.testing.assert_allclose(found, exact, rtol=1e-5)  # a pin of 1e8 times what the springs pull costs some digits


def test_what_overflows_is_not_stationary():
    _, stated = case("topology-components")
    found = ReferenceEvaluator(stated.system).measure_stationarity(
        stated, np.full_like(stated.current_positions, 1e200) * np.arange(11)[:, None]
    )
    assert not found.above_roundoff <= 1.0

"""The oracle of stationarity: round-off is told vertex by vertex, and no part of a scene hides another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from harness.config.load import load_scene
from harness.reference import oracle as oracle_module
from harness.reference.judge import Judge
from harness.reference.minimiser import polish
from harness.reference.oracle import Oracle, component_sizes, sizes, stiffness
from harness.scenes.bind import Scene, build
from harness.simulation.step import State, Step, problem, start
from solvers.integrators import Motion
from solvers.methods.newton import Newton
from solvers.problem import Positions, Solution, StepProblem, StopRule

HARD = Path(__file__).resolve().parents[2] / "configs" / "hard"
SCENES = HARD.with_name("scenes")


def case(name: str) -> tuple[Scene, StepProblem]:
    spec = load_scene(HARD / f"{name}.yaml")
    made = build(spec, spec.default_size or 0)
    return made, problem(made, start(made), "current")


def solved(stated: StepProblem) -> Positions:
    """Where Newton's method leads, and then Newton's steps by the oracle, to round-off."""
    return polish(stated, stated.current, Newton()).positions.copy()


@pytest.mark.parametrize("name", ["effects-strain-limits-1e13", "effects-strain-limits-1e18"])
def test_limits_that_are_not_reached_do_not_make_a_chain_in_the_air_right(name: str):
    _, stated = case(name)
    oracle = Oracle(stated.system)
    assert oracle.stationarity(stated, stated.current).beyond == pytest.approx(1.0)
    assert oracle.stationarity(stated, stated.current).attainable < 1e-9
    best = solved(stated)
    assert oracle.stationarity(stated, best).beyond <= 1e-6
    assert stated.value(best) < stated.value(stated.current) - 1e-3


@pytest.mark.parametrize("name", ["scales-cubes-1e6-m-apart", "scales-cubes-1e9-m-apart"])
def test_a_far_component_does_not_hide_that_a_near_one_is_moved(name: str):
    """At 1e9 m positions are rounded to 1e-7 m, which is 10 N for springs of 1e8 N/m: none of the near cube's."""
    _, stated = case(name)
    oracle, best = Oracle(stated.system), solved(stated)
    assert oracle.stationarity(stated, best).beyond <= 1e-6
    moved = best.copy()
    moved[0] += 0.087 / 3**0.5
    assert oracle.stationarity(stated, moved).beyond > 1.0


def test_a_distance_counts_by_the_size_of_its_own_component():
    made, stated = case("scales-cubes-1e6-m-apart")
    known = solved(stated)
    moved = known.copy()
    moved[0, 0] += 0.087
    state = State(Motion(moved, np.zeros_like(moved)), None, 1)
    solution = Solution(moved, 1, 0.0, 0.0, "iterations")
    step = Step(stated, solution, state, (1,), ((stated, solution),), StopRule())
    row = Judge(made, known[None], minimises=False)(step)
    assert row["distance"] == pytest.approx(0.087 / 3**0.5)


def test_a_component_is_as_large_as_its_box_and_a_lone_vertex_as_the_others():
    made, _ = case("topology-components")
    found = sizes(made.system, made.mesh.rest)
    np.testing.assert_allclose(found, [0.3] * 8 + [0.02**0.5] * 3, rtol=1e-12)
    p = np.array([[0.0, 0, 0], [3.0, 4.0, 0], [7.0, 7, 7]])
    graph = stiffness(made.system)[:3][:, :3]
    graph[0, 2] = graph[1, 2] = graph[2, 0] = graph[2, 1] = 0.0
    graph.eliminate_zeros()
    np.testing.assert_allclose(component_sizes(graph, p), [5.0, 5.0, 5.0])
    np.testing.assert_allclose(component_sizes(graph[2:][:, 2:], p[2:]), [1.0])


def test_a_scene_at_rest_is_stationary_by_round_off_alone():
    made, stated = case("topology-components")
    p = solved(stated)
    at_rest = replace(stated, current=p, first_guess=p)
    oracle = Oracle(made.system)
    assert oracle.stationarity(at_rest, p).beyond == 0.0
    assert oracle.stationarity(at_rest, p).reached <= 1.0


@pytest.mark.parametrize("name", ["geometry-random-stiff-block", "numbers-mass-ratio-1e8", "topology-components"])
def test_of_large_systems_conjugate_gradients_give_nearly_the_same_and_never_more(
    name: str, monkeypatch: pytest.MonkeyPatch
):
    made, stated = case(name)
    exact = Oracle(made.system).residual(stated, stated.current)
    monkeypatch.setattr(oracle_module, "LARGEST", 0)
    assert 0.9 * exact <= Oracle(made.system).residual(stated, stated.current) <= exact * (1 + 1e-9)


@pytest.mark.parametrize(("scene", "size"), [("hanging-cloth", 45), ("flag-in-wind", 55)])
def test_conjugate_gradients_give_four_digits_over_levels_of_multigrid(
    scene: str, size: int, monkeypatch: pytest.MonkeyPatch
):
    made = build(load_scene(SCENES / f"{scene}.yaml"), size)
    stated, far = problem(made, start(made), "current"), made.mesh.rest**3
    exact = [Oracle(made.system).residual(stated, p) for p in (stated.current, far)]
    monkeypatch.setattr(oracle_module, "LARGEST", 0)
    oracle = Oracle(made.system)
    found = [oracle.residual(stated, p) for p in (stated.current, far)]
    assert len(oracle._multigrid.sizes) > 1, "a mesh of 2,000 vertices is coarsened"  # pyright: ignore[reportPrivateUsage]
    np.testing.assert_allclose(found, exact, rtol=1e-5)  # a pin of 1e8 times what the springs pull costs some digits


def test_what_overflows_is_not_stationary():
    _, stated = case("topology-components")
    found = Oracle(stated.system).stationarity(stated, np.full_like(stated.current, 1e200) * np.arange(11)[:, None])
    assert not found.beyond <= 1.0

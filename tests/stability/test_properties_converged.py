"""Properties of every network once a step has converged: near its minimum, for every method that tends to one.

On the way there a decision may go either way, and methods differ. Near a minimum, from where the solves below start,
there is one answer. It is known as well as its gradient, each of whose entries is a sum of some ten forces of k times
the coordinates, good to eps each; over the Hessian's smallest eigenvalue that is a displacement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from springbench.harness.reference.certified_minimum import build_free_hessian
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule

from tests.contracts.test_integrators import LAWS, energies
from tests.stability.random_networks import (
    DT,
    EPS,
    MINIMISERS,
    Case,
    Map,
    examples,
    networks,
    renumber_problem,
    rotate_problem,
)

ENOUGH = StopRule(3000)
"""Without a tolerance: until round-off lets nothing descend any more, where a method detects that."""
NEAR = 1e-3
"""How far from the minimum solves start [m]; networks are some metres large."""
CLEAR = 1e-2
"""Of the least inertia, the smallest eigenvalue that a minimum has at least: a flatter one is hardly one."""

SLOW = ("dense", "sparse", "numba", "chebyshev", "admm", "a-jacobi")
"""Take as many iterations as k dt^2/m; `test_properties` tests each of their iterates likewise."""
SOFT = {"vbd": 0.0, "avbd": 0.0, "jgs2": 0.0}
"""Powers of ten of the stiffness number up to which a method converges in time: one vertex at a time is slow, and what
answers to it at rest says little in networks as far out of shape as these."""

converging = pytest.mark.parametrize("name", [name for name in MINIMISERS if name not in SLOW])
EXAMPLES = examples(10)


FEW_SOFT_MODES, ONE_SOFT_MODE = Case(6, 12, 0, 5.0, 0.0, 0), Case(4, 12, 558, 5.0, 0.0, 0)
"""Found by a search: Anderson's method and L-BFGS end 140 and 120 eps k/lambda from the minimum, lambda the smallest
eigenvalue. A sum of ten forces is known to ten eps, not to one."""


@dataclass(frozen=True, eq=False)
class NearMinimum:
    """A problem that starts near a minimum; where that is; how well it can be known [m]."""

    problem: StepProblem
    minimum: Positions
    known: float


def start_near_minimum(case: Case, problem: StepProblem) -> NearMinimum:
    """The problem near the minimum that Newton's method finds; a flat one is left out."""
    p = NewtonSolver().prepare(problem.system).solve(problem, ENOUGH).positions
    least = float(np.linalg.eigvalsh(build_free_hessian(problem, p).toarray()).min(initial=np.inf))
    inertia = float(problem.system.inertia_diagonal.min())
    assume(least >= CLEAR * inertia)
    guess = p + NEAR * np.random.default_rng(case.seed).normal(size=p.shape)
    known = 1000.0 * EPS * case.worst * max(1.0, inertia / least)
    return NearMinimum(replace(problem, initial_guess=guess), p, known)


def solve_converged(name: str, problem: StepProblem) -> Positions:
    return MINIMISERS[name].prepare(problem.system).solve(problem, ENOUGH).positions


def for_method(name: str, case: Case) -> Case:
    """The case, softer where the method needs it."""
    return replace(case, number=min(case.number, SOFT.get(name, np.inf)), spread=case.spread * (name not in SOFT))


@converging
@EXAMPLES
@given(case=networks())
@example(case=FEW_SOFT_MODES)
@example(case=ONE_SOFT_MODE)
def test_all_methods_end_at_the_minimum_that_they_start_near(name: str, case: Case):
    case = for_method(name, case)
    given = start_near_minimum(case, case.problem())
    np.testing.assert_allclose(solve_converged(name, given.problem), given.minimum, rtol=0, atol=given.known)


CHANGES: dict[str, Callable[[StepProblem, int], tuple[StepProblem, Map]]] = {
    "turned and shifted": lambda problem, seed: rotate_problem(problem, seed, mirror=False),
    "mirrored": lambda problem, seed: rotate_problem(problem, seed, mirror=True),
    "renumbered, springs flipped": renumber_problem,
}


@converging
@pytest.mark.parametrize("change", CHANGES)
@EXAMPLES
@given(case=networks(), seed=st.integers(0, 2**16))
def test_equivalent_descriptions_end_at_the_same_minimum(name: str, change: str, case: Case, seed: int):
    case = for_method(name, case)
    given = start_near_minimum(case, case.problem())
    other, moved = CHANGES[change](given.problem, seed)
    here, there = solve_converged(name, given.problem), solve_converged(name, other)
    np.testing.assert_allclose(there, moved(here), rtol=0, atol=2.0 * given.known)


@converging
@EXAMPLES
@given(case=networks(pinned=0))
def test_a_free_body_conserves_momentum(name: str, case: Case):
    case = for_method(name, case)
    free = case.problem()
    free = replace(free, external_force=np.zeros_like(free.external_force))
    mass, begun = free.system.mass[:, None], free.step_start
    moved = (mass * (solve_converged(name, start_near_minimum(case, free).problem) - begun.positions)).sum(axis=0) / DT
    scale = (mass * np.abs(begun.positions)).sum() / DT  # what the differences above are taken of
    expected = (mass * begun.velocity).sum(axis=0)
    np.testing.assert_allclose(moved, expected, rtol=0, atol=100 * EPS * case.worst * scale)


@converging
@EXAMPLES
@given(case=networks())
def test_a_free_body_at_rest_length_moves_uniformly(name: str, case: Case):
    case = for_method(name, case)
    free, expected = case.flying()
    atol = 100 * EPS * case.worst * np.abs(expected).max()
    np.testing.assert_allclose(solve_converged(name, free), expected, rtol=0, atol=atol)


STEPS = 4
integrators = pytest.mark.parametrize("integrator", LAWS)
LAWFUL = examples(20)


def simulate_motions(scene: Scene, state: MotionState) -> list[Motion]:
    """The motions at the start and after each step."""
    run = simulate_scene(
        scene, prepare(scene, NewtonSolver()), ENOUGH, initial_guess="inertial", frames=STEPS, initial_state=state
    )
    return [state.motion, *(step.state.motion for step in run)]


@integrators
@LAWFUL
@given(case=networks())
def test_angular_momentum_obeys_the_integrators_law(integrator: str, case: Case):
    scene, state = case.build_free_scene(integrator)
    path = simulate_motions(scene, state)
    mass = scene.system.mass[:, None]
    reach = max(np.abs(p).max() for p, _ in path)
    # A force that is left, k times the coordinates times eps at each of some ten springs, times an arm and dt.
    left = 100.0 * EPS * case.worst * mass.sum() / DT * reach**2
    np.testing.assert_allclose(LAWS[integrator](mass, path, DT), 0.0, rtol=0, atol=left)


@integrators
@LAWFUL
@given(case=networks(stiffest=3.0))
def test_a_convex_energy_decays_or_stays(integrator: str, case: Case):
    """Springs without rest length have a quadratic energy: midpoint conserves it, implicit Euler loses some each step,
    BDF2 has lost some in the end."""
    scene, state = case.build_free_scene(integrator)
    springs = replace(scene.all_springs, rest_length=np.zeros(case.m))
    scene = replace(scene, system=replace(scene.system, energies=(springs,)))
    path = simulate_motions(scene, state)
    found = energies(scene, path)
    slack = 100.0 * EPS * case.worst * found[0]  # positions are off by eps times that, and energies by as much
    if integrator == "midpoint":
        np.testing.assert_allclose(found, found[0], rtol=0, atol=slack)
    elif integrator == "implicit-euler":
        assert (np.diff(found) <= slack).all()
    else:
        assert found[-1] <= found[0] + slack

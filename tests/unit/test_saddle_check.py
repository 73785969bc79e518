"""The check for saddles: its bound and its search for negative curvature, against dense eigenvalues."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from springbench.harness.reference.hessian_curvature import build_free_hessian
from springbench.solvers.iteration.saddle_check import SaddleCheck
from springbench.solvers.iteration.vertex_terms import compute_anchor_stiffness
from springbench.solvers.kernels import curvature_search
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, StepProblem
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.scene_builders import build_random_problem

ROUNDOFF = 1e-12
"""Relative rounding error of an eigenvalue of a matrix of a hundred rows, by a wide margin."""


def eigenvalues(problem: StepProblem, p: Positions) -> np.ndarray:
    """The Hessian's eigenvalues, relative to the largest."""
    found = np.linalg.eigvalsh(build_free_hessian(problem, p).toarray())
    return found / np.abs(found).max()


def is_bounded(problem: StepProblem, p: Positions) -> bool:
    """Whether the bound rules out negative curvature."""
    system = problem.system
    terms, linear, _, joined, curvature = StepObjective(FixedObjective(system), problem).hessian(p).kernel_arguments
    anchors, scratch = compute_anchor_stiffness(system), np.empty(system.num_vertices)
    return curvature_search.bound_by_elements(terms, linear, joined, curvature, anchors, scratch)


def with_mass(problem: StepProblem, factor: float) -> StepProblem:
    return replace(problem, system=replace(problem.system, mass=factor * problem.system.mass))


def random_steps() -> Iterator[tuple[StepProblem, Positions]]:
    """Networks with pins of both kinds, pressed and stretched, whose inertia weighs from a hundredth to a hundred."""
    for seed in range(80):
        rng = np.random.default_rng(seed)
        problem = with_mass(build_random_problem(seed, n=8, m=14), 10.0 ** rng.uniform(-2, 2))
        p = rng.uniform(0.5, 1.1) * problem.current_positions + 0.02 * rng.normal(size=(8, 3))
        p[problem.system.pins.exact_mask.nonzero()[0]] = problem.pin_targets[problem.system.pins.exact_mask]
        yield problem, p


def effect_steps(name: str) -> Iterator[tuple[StepProblem, Positions]]:
    """A scene with an effect, pressed to different degrees, with masses of different weight."""
    problem = build_moving_problem(EFFECT_SCENES[name]())
    for scale in (0.6, 1.0):
        for factor in (1.0, 1e4):
            heavy, p = with_mass(problem, factor), scale * problem.current_positions
            pins = heavy.system.pins
            p[pins.vertices[pins.exact_mask]] = heavy.pin_targets[pins.exact_mask]
            yield heavy, p


def test_where_the_bound_is_satisfied_no_eigenvalue_is_negative():
    checks = [(eigenvalues(problem, p)[0], is_bounded(problem, p)) for problem, p in random_steps()]
    assert all(least >= -ROUNDOFF for least, bounded in checks if bounded)
    counts = sum(bounded for _, bounded in checks), sum(least < -ROUNDOFF for least, _ in checks)
    assert min(counts) > 20, f"{counts} of each kind are too few to tell"


@pytest.mark.parametrize("name", ["strain limits", "all that are projective", "contact"])
def test_the_bound_includes_elements(name: str):
    checks = [(eigenvalues(problem, p)[0], is_bounded(problem, p)) for problem, p in effect_steps(name)]
    assert all(least >= -ROUNDOFF for least, bounded in checks if bounded)
    assert {bounded for _, bounded in checks} == {True, False}


def test_the_bound_of_an_element_counts_its_vertices():
    """The energy -|x_0 - x_1|^2 / 2 has the eigenvalue -2."""
    problem, p = next(effect_steps("strain limits"))
    terms, linear, _, joined, _ = StepObjective(FixedObjective(problem.system), problem).hessian(p).kernel_arguments
    pair = joined._replace(
        row_starts=np.array([0, 2], joined.row_starts.dtype),
        vertices=np.array([0, 1], joined.vertices.dtype),
        coefficients=np.array([1.0, -1.0]),
    )
    curvature = np.array([[-1.0, 0.0, 0.0, -1.0, 0.0, -1.0]])
    for stiffness, bounded in ((2.0 + 1e-9, True), (2.0 - 1e-9, False)):
        anchors, scratch = np.full((2, len(p)), stiffness)
        assert curvature_search.bound_by_elements(terms, linear[:0], pair, curvature, anchors, scratch) == bounded


@pytest.mark.parametrize(
    ("factor", "bounded"),
    [(1.0 + 1e-9, True), (1.0 - 1e-9, False), ((0.6, 1.5), False), ((1.5, 0.6), False)],
)
def test_the_bound_of_a_single_spring_is_its_buckling_load(factor: float | tuple[float, float], bounded: bool):
    """Two vertices of mass m on a spring of length l: the smallest eigenvalue is m/h^2 - 2 k (r/l - 1).

    The lighter one of two alone may be below the load: each has the whole bound.
    """
    problem = build_random_problem(0, n=2, m=40, weights=())
    springs = problem.system.energies[0]
    assert isinstance(springs, Springs)
    one = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])[:1]
    spring = replace(
        springs,
        edges=springs.edges[one],
        stiffness=springs.stiffness[one],
        rest_length=springs.rest_length[one],
        rest_direction=springs.rest_direction[one],
    )
    load = 2.0 * spring.stiffness[0] * (1.0 / 0.8 - 1.0)
    mass = np.array(factor) * load * problem.system.time_step**2 * np.ones(2)
    problem = replace(problem, system=replace(problem.system, mass=mass, energies=(spring,)))
    p = 0.8 * problem.current_positions
    assert is_bounded(problem, p) == bounded == (eigenvalues(problem, p)[0] > 0.0)


def check_search(problem: StepProblem, p: Positions) -> bool:
    """Search with as many products as there are unknowns; return whether there is something to find."""
    found, least = (
        SaddleCheck(FixedObjective(problem.system)).find_negative_curvature(problem, p, p.size),
        eigenvalues(problem, p)[0],
    )
    if least < -1e-6:  # conjugate gradients resolve no less in as many products as there are unknowns
        assert found is not None
    if found is None:
        return False
    x, curvature = found
    assert np.abs(x).max() == 1.0
    H, x = build_free_hessian(problem, p), x[problem.system.free_vertices].ravel()
    assert curvature == pytest.approx(H.quadratic_form(x), abs=ROUNDOFF * H.absolute_form(x))
    assert curvature < 0.0
    return True


def test_the_search_finds_negative_curvature_where_there_is_some_and_only_there():
    assert {check_search(problem, p) for problem, p in random_steps()} == {True, False}


@pytest.mark.parametrize("name", ["all that are projective", "contact", "gas and all others"])
def test_the_search_includes_all_energies(name: str):
    assert {check_search(problem, p) for problem, p in effect_steps(name)} == {True, False}

"""ADMM for the step problem: what it has in common with local-global, what its weight does, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from springbench.solvers.methods.local_global.admm import Admm
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import DirichletPins, StepProblem, StopRule, Unsupported

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.scene_builders import build_cloth, build_first_problem

HANGING = build_first_problem(build_cloth(8, "exact", stretch=100.0))


def after(solver, problem: StepProblem, count: int):
    *_, last = islice(solver.prepare(problem.system).iterates(problem), count)
    return last.copy()


def test_the_first_iteration_with_the_weight_one_is_local_global():
    one = after(Admm(), HANGING, 1)
    np.testing.assert_allclose(one, after(SparseLocalGlobal(), HANGING, 1), rtol=0, atol=1e-12)
    assert np.abs(after(Admm(), HANGING, 10) - after(SparseLocalGlobal(), HANGING, 10)).max() > 1e-9


@pytest.mark.parametrize("weight", [0.1, 1.0, 3.0])
def test_it_ends_at_the_minimum_whatever_the_weight(weight):
    expected = NewtonSolver().prepare(HANGING.system).solve(HANGING, StopRule(100, 1e-12)).positions
    found = Admm(weight).prepare(HANGING.system).solve(HANGING, StopRule(5000, 1e-8))
    assert found.termination_reason == "converged"
    np.testing.assert_allclose(found.positions, expected, rtol=0, atol=1e-6)


def test_a_small_weight_takes_fewer_iterations_where_springs_hang():
    small, one, great = (
        Admm(weight).prepare(HANGING.system).solve(HANGING, StopRule(5000, 1e-3)).num_iterations
        for weight in (0.1, 1.0, 3)
    )
    assert 2 * small <= one
    assert 2 * one <= great


@pytest.mark.parametrize(("weight", "stays"), [(0.5, False), (1.0, False), (3.0, True)])
def test_a_spring_shorter_than_the_weight_allows_has_no_fixed_point(weight, stays):
    """A spring pressed to 2/5 of its rest length, at a minimum through inertia: 1/(1 + 3) < 2/5 < 1/(1 + 1)."""
    given = build_first_problem(build_cloth(2, "exact"))
    springs = Springs(np.array([[0, 1]]), np.ones(1), np.ones(1), np.array([[1.0, 0.0, 0.0]]))
    p = np.zeros((2, 3))
    p[1, 0] = 0.4
    pins = DirichletPins(np.array([0]), np.array([np.inf]))
    system = replace(given.system, mass=np.full(2, 10.0), time_step=1.0, energies=(springs,), pins=pins)
    force = np.array([[0.0, 0.0, 0.0], [-0.6, 0.0, 0.0]])
    given = replace(
        given,
        system=system,
        inertial_target=p,
        external_force=force,
        current_positions=p,
        initial_guess=p,
        pin_targets=p[:1],
    )
    assert np.abs(given.gradient(p)[1]).max() <= 1e-15
    last = [q.copy() for q in islice(Admm(weight).prepare(system).iterates(given), 300)][-8:]
    moved = np.abs(np.array(last) - p).max()
    assert (moved <= 1e-9) if stays else (moved > 1e-3)


@pytest.mark.parametrize(
    ("scene", "name"), [("dashpots", "Dashpots"), ("contact", "HalfSpaceContact"), ("gas", "Gas")], ids=lambda x: x
)
def test_what_has_no_projection_along_edges_is_refused_by_name(scene, name):
    with pytest.raises(Unsupported, match=f"admm: .*the scene has .*{name}"):
        Admm().prepare(build_moving_problem(EFFECT_SCENES[scene]()).system)


@pytest.mark.parametrize("weight", [0.0, -1.0, np.inf, np.nan])
def test_a_weight_is_positive_and_finite(weight):
    with pytest.raises(ValueError, match="penalty_weight: should be positive and finite"):
        Admm(weight)

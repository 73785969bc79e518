"""Projective dynamics by A-Jacobi: what its matrix stands for, what sweeps do, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.solvers.iteration.descent_method import ResidualMetric
from springbench.solvers.methods.local_global.aggregated_jacobi import AggregatedJacobi, AggregatedSweeps
from springbench.solvers.methods.local_global.prefactored import prepare_local_global, require_projective
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import StopRule, Unsupported

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.effect_scenes import build_effect_cloth as cloth_with
from tests.scene_builders import build_cloth, build_first_problem

HANGING = build_first_problem(build_cloth(8, "exact", stretch=100.0))


def build_matrices(sweeps: int):
    """Q over the free vertices, dense, and the matrix that stands for so many sweeps."""
    found = []
    prepare_local_global(
        HANGING.system,
        require_projective(HANGING.system, ""),
        lambda Q: (found.append(Q) or AggregatedSweeps(Q, sweeps), ""),
    )
    return found[0].toarray(), AggregatedSweeps(found[0], sweeps).matrix.toarray()


@pytest.mark.parametrize("sweeps", [2, 4])
def test_its_matrix_applies_the_given_number_of_jacobi_sweeps(sweeps):
    Q, S = build_matrices(sweeps)
    b = np.random.default_rng(0).normal(size=len(Q))
    x = np.zeros_like(b)
    for _ in range(sweeps):
        x += (b - Q @ x) / np.diag(Q)
    np.testing.assert_allclose(S @ b, x, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("sweeps", [1, 2, 3, 4])
def test_its_inverse_majorises_the_hessian_as_q_does(sweeps):
    Q, S = build_matrices(sweeps)
    products = np.linalg.eigvals(S @ Q)
    assert np.abs(products.imag).max() <= 1e-12
    assert products.real.min() > 0.0
    assert products.real.max() <= 1.0 + 1e-2  # the largest eigenvalue of D^-1 Q is an estimate


@pytest.mark.parametrize("sweeps", [1, 2, 3, 4])
def test_stiff_bending_leaves_its_matrix_positive_definite(sweeps):
    """Eigenvalues of D^-1 Q reach 2.8 there; with D itself two sweeps would have a negative one."""
    Q = ResidualMetric(cloth_with(BendingEffect(stiffness=50.0)).system).free_block
    products = np.linalg.eigvals(AggregatedSweeps(Q, sweeps).matrix @ Q.toarray()).real
    assert 0.0 < products.min() <= products.max() <= 1.0 + 1e-12


@pytest.mark.parametrize("sweeps", [1, 2, 5])
def test_it_ends_at_the_minimum_whatever_the_sweeps(sweeps):
    expected = NewtonSolver().prepare(HANGING.system).solve(HANGING, StopRule(100, 1e-12)).positions
    found = AggregatedJacobi(sweeps).prepare(HANGING.system).solve(HANGING, StopRule(5000, 1e-8))
    assert found.termination_reason == "converged"
    np.testing.assert_allclose(found.positions, expected, rtol=0, atol=1e-6)


def test_more_sweeps_take_fewer_iterations():
    one, two, four = (
        AggregatedJacobi(l).prepare(HANGING.system).solve(HANGING, StopRule(5000, 1e-3)).num_iterations
        for l in (1, 2, 4)
    )
    assert one > two > four


@pytest.mark.parametrize(("scene", "name"), [("contact", "HalfSpaceContact"), ("gas", "Gas")], ids=lambda x: x)
def test_what_has_no_rows_in_q_is_refused_by_name(scene, name):
    with pytest.raises(Unsupported, match=f"a-jacobi: .*{name}"):
        AggregatedJacobi().prepare(build_moving_problem(EFFECT_SCENES[scene]()).system)


@pytest.mark.parametrize("sweeps", [0, -1, 9])
def test_sweeps_are_from_one_to_eight(sweeps):
    with pytest.raises(ValueError, match="jacobi_sweeps: should be from 1 to 8"):
        AggregatedJacobi(sweeps)

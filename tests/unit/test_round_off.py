"""The bound on a gradient's round-off: it is valid in exact arithmetic, and independent of what is elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.solvers.kernels import objective_kernels
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits
from springbench.solvers.model.rounding_bound import (
    EPS,
    RoundingBoundEnergy,
    clip_to_roundoff,
    gradient_roundoff,
    stable_row_norms,
)
from springbench.solvers.model.step_problem import Energy, Positions

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.scene_builders import build_random_problem, join_problems, shift_problem

NUDGES = 20
"""Of the last bit: as many ways to round the positions."""


def perturb_last_bits(p: Positions, seed: int) -> Positions:
    """The positions with each coordinate moved by its last bit, up, down or not at all."""
    return p * (1.0 + EPS * np.random.default_rng(seed).integers(-1, 2, p.shape))


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "midpoint"])
@pytest.mark.parametrize("case", EFFECT_SCENES)
def test_the_rounding_of_positions_moves_the_gradient_by_no_more_than_the_bound(case: str, integrator: str):
    """Another rounding of the same positions is another gradient, and the bound is for what this makes of it: twice,
    for either of the two is off by as much."""
    problem = build_moving_problem(EFFECT_SCENES[case](), integrator)
    for p in (problem.current_positions, problem.inertial_target, problem.current_positions + 1e3):
        bound = 2.0 * gradient_roundoff(problem, p)
        for seed in range(NUDGES):
            change = problem.gradient(perturb_last_bits(p, seed)) - problem.gradient(p)
            assert (stable_row_norms(change) <= bound).all()


@pytest.mark.parametrize("case", EFFECT_SCENES)
def test_the_bound_is_not_slack(case: str):
    """Some rounding of the positions comes within a factor of 300 of it somewhere: of 60 terms, some cancel."""
    problem = build_moving_problem(EFFECT_SCENES[case]())
    p, bound = problem.current_positions, gradient_roundoff(problem, problem.current_positions)
    free = problem.system.free_vertices
    changes = [
        stable_row_norms(problem.gradient(perturb_last_bits(p, seed)) - problem.gradient(p))[free]
        for seed in range(NUDGES)
    ]
    assert (np.max(changes, axis=0) / bound[free]).max() > 1 / 300


@pytest.mark.parametrize(("by", "stiffer"), [(1e6, 1.0), (1e9, 1e8), (0.0, 1e12)])
def test_the_bound_does_not_change_when_another_component_is_added(by: float, stiffer: float):
    problem = build_random_problem(1)
    both, n = join_problems(problem, shift_problem(build_random_problem(2), by, stiffer)), problem.system.num_vertices
    alone = gradient_roundoff(problem, problem.current_positions)
    np.testing.assert_array_equal(gradient_roundoff(both, both.current_positions)[:n], alone)


def test_a_limit_that_is_not_reached_adds_nothing_however_stiff():
    problem = build_random_problem(1)
    (springs,) = problem.system.energies
    assert isinstance(springs, Springs)
    m = len(springs.edges)
    limits = StrainLimits(springs.edges, np.full(m, 1e18), np.zeros(m), np.full(m, 1e3), springs.rest_direction)
    limited = replace(problem, system=replace(problem.system, energies=(springs, limits)))
    p = problem.current_positions
    np.testing.assert_array_equal(gradient_roundoff(limited, p), gradient_roundoff(problem, p))
    reached = replace(limits, max_length=np.zeros(m))
    taut = replace(problem, system=replace(problem.system, energies=(springs, reached)))
    ends = np.setdiff1d(springs.edges, problem.system.pins.vertices[problem.system.pins.exact_mask])
    assert (gradient_roundoff(taut, p)[ends] >= 1e18 * EPS * springs.edge_lengths(p).min()).all()


@dataclass(frozen=True)
class PlainEnergy:
    """An energy that states nothing but what it must."""

    inner: Energy

    def value(self, p: Positions) -> float:
        return self.inner.value(p)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        self.inner.add_gradient(p, out)

    def hessian(self, p: Positions) -> csr_array:
        return self.inner.hessian(p)


@pytest.mark.parametrize("case", EFFECT_SCENES)
def test_an_energy_that_states_no_terms_has_a_sound_bound_by_its_hessian(case: str):
    problem = build_moving_problem(EFFECT_SCENES[case]())
    assert all(isinstance(energy, RoundingBoundEnergy) for energy in problem.energies)
    stated = replace(problem, system=replace(problem.system, energies=tuple(map(PlainEnergy, problem.energies))))
    assert not any(isinstance(energy, RoundingBoundEnergy) for energy in stated.energies)
    p, bound = problem.current_positions, 2.0 * gradient_roundoff(stated, problem.current_positions)
    for seed in range(NUDGES):
        change = problem.gradient(perturb_last_bits(p, seed)) - problem.gradient(p)
        assert (stable_row_norms(change) <= bound).all()


@pytest.mark.parametrize("seed", range(4))
def test_the_compiled_bound_is_the_plain_one(seed: int):
    problem = build_random_problem(seed)
    (springs,) = problem.system.energies
    assert isinstance(springs, Springs)
    p, out = problem.current_positions.copy(), np.empty(problem.system.num_vertices)
    objective_kernels.bound_gradient_roundoff(
        objective_kernels.ObjectiveTerms.from_system(problem.system, springs),
        objective_kernels.StepData.from_problem(problem),
        p,
        out,
    )
    out[problem.system.pins.vertices[problem.system.pins.exact_mask]] = 0.0
    np.testing.assert_allclose(out, gradient_roundoff(problem, p), rtol=1e-14)  # sums in another order


def test_what_overflows_has_no_bound():
    problem = build_random_problem(1)
    huge = np.full_like(problem.current_positions, 1e308)
    assert np.isinf(gradient_roundoff(problem, huge)[problem.system.free_vertices]).all()


def test_what_round_off_explains_of_a_gradient_is_no_longer_than_the_bound():
    gradient = np.array([[3.0, 4.0, 0.0], [0.3, 0.4, 0.0], [0.0, 0.0, 0.0]])
    assert not clip_to_roundoff(gradient, np.full(3, np.inf)).any(), "an infinite bound is none"
    found = clip_to_roundoff(gradient, np.array([1.0, 1.0, 1.0]))
    np.testing.assert_allclose(found, [[0.6, 0.8, 0.0], [0.3, 0.4, 0.0], [0.0, 0.0, 0.0]], rtol=1e-15)

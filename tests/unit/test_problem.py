"""The step's objective: no term is lost, whatever an energy is called."""

from __future__ import annotations

from dataclasses import replace

import pytest
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import StepProblem

from tests.scene_builders import build_random_problem


def add_named_energy(name: str) -> StepProblem:
    """A problem with an energy more, of a class of this name."""
    problem = build_random_problem(3)
    (springs,) = problem.system.energies
    assert isinstance(springs, Springs)
    more = type(name, (Springs,), {})(springs.edges, springs.stiffness, springs.rest_length, springs.rest_direction)
    return replace(problem, system=replace(problem.system, energies=(springs, more)))


@pytest.mark.parametrize("name", ["Inertia", "Force", "Pins", "Springs", "Glue"])
def test_an_energy_counts_whatever_its_class_is_called(name: str):
    plain, problem = build_random_problem(3), add_named_energy(name)
    p, (springs, _) = problem.current_positions + 0.01, problem.system.energies
    assert springs.value(p) > 0.0
    # Sums of a dozen terms in another order.
    assert problem.value(p) == pytest.approx(plain.value(p) + springs.value(p), rel=1e-13)
    assert (
        problem.evaluate_terms(p).items()
        >= {key: plain.evaluate_terms(p)[key] for key in ("inertia", "force", "pins")}.items()
    )

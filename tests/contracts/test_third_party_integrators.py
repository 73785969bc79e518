"""Other libraries' integrators compared with ours: CVODE, where it is installed, and the row where it is not."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.experiments.error_control import third_party_integrators
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget
from springbench.harness.experiments.error_control.method_search import (
    compute_predictability_horizon,
    search_cheapest_method,
)
from springbench.harness.experiments.error_control.third_party_comparison import compare_third_party
from springbench.harness.experiments.error_control.third_party_integrators import (
    THIRD_PARTY_INTEGRATORS,
    InitialValueProblem,
)
from springbench.harness.reference.equations_of_motion import OdeField
from springbench.harness.reference.reference_trajectory import integrate_motion

SPRING = Path(__file__).parents[2] / "configs" / "scenes" / "single-spring.yaml"


@pytest.mark.parametrize("name", ["cvode-adams", "cvode-bdf"])
def test_cvode_follows_the_motion_to_its_tolerance(name):
    error_target = ErrorTarget.from_scene(load_scene(SPRING), 2, 0.5)
    scene, truth = (
        error_target.build_scene(error_target.frame_seconds, "newmark"),
        integrate_motion(error_target.build_scene(error_target.frame_seconds, "substepping"), [0.5]),
    )
    field = OdeField(scene)
    ends = (
        THIRD_PARTY_INTEGRATORS[name].integrate_to_end(
            InitialValueProblem(field, field.initial_state, scene, 0.5, tol, tol)
        )
        for tol in (1e-5, 1e-8)
    )
    coarse, fine = (truth.measure_error(0, field.unpack_state(0.5, end)[0].copy()) for end in ends)
    assert fine < 1e-5
    assert fine < 0.1 * coarse


def test_a_third_party_integrator_that_is_not_installed_is_a_row_that_names_the_command_to_install_it(monkeypatch):
    monkeypatch.setattr(third_party_integrators, "find_spec", lambda name: None)
    error_target = ErrorTarget.from_scene(load_scene(SPRING), 2, 0.1)
    seen = compute_predictability_horizon(error_target, 1e-2, lambda line: None)
    answer = search_cheapest_method(
        error_target, 1e-2, seen, lambda line: None, [("substepping", SolverSpec("velocity-verlet", {}))]
    )
    (peer,) = compare_third_party(error_target, 1e-2, answer, ["cvode-bdf"])
    assert "pip install 'springbench[sundials]'" in peer.reason
    assert not THIRD_PARTY_INTEGRATORS["scipy-radau"].missing_reason

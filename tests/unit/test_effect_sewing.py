"""Threads that are drawn in over time, and stay so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.sewing_effect import SewingEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.vertex_selectors import VertexSelection
from springbench.harness.simulation.instrumentation_pass import count_intersections
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.model.energies.sewing_energy import Sewing as Energy
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.oracles.verify_scene import verify_terms

ROWS = tuple(VertexSelection(indices=tuple(range(first, first + 5))) for first in (0, 25))
SEWING = SewingEffect(
    first_row=ROWS[0], second_row=ROWS[1], stiffness=2e4, start_time=0.02, end_time=0.2, final_length=0.05
)


def spec(*effects) -> SceneSpec:
    given: dict[str, Any] = {"mass": 0.2, "time_step": 0.02, "frames": 20, "path": Path("scene.yaml")}
    return SceneSpec(mesh=StackMesh(layer_spacing=0.2), effects=(SpringsEffect(stretch=100.0), *effects), **given)


def gaps(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p[:5] - p[25:30], axis=1)


@pytest.mark.parametrize("solver", ["newton", "numba", "admm"])
def test_a_seam_closes_when_it_should_and_stays_closed(solver):
    made = build_scene(spec(SEWING), 5)
    steps = simulate_scene(
        made,
        prepare(made, load_target(SOLVERS[solver])()),
        StopRule(300, 1e-6),
        initial_guess="extrapolated",
        frames=14,
    )
    open_ = [float(gaps(step.positions).max()) for step in steps]
    assert open_[0] == pytest.approx(0.2, abs=1e-12)  # they begin at the end of this step
    # At most as long as they may be, but for what inertia and springs, some N, stretch threads of 4e3 N/m by.
    allowed = [0.2 - 0.15 * min(max(0.02 * k, 0.0) / 0.18, 1.0) for k in range(14)]
    assert all(a <= b + 2e-3 for a, b in zip(open_, allowed, strict=True))
    assert open_[-1] < 0.051


def test_with_self_contact_the_panels_meet_and_pass_nowhere():
    made = build_scene(spec(SEWING, SelfContactEffect(min_distance=0.01)), 5)
    last = made.mesh.rest_positions
    for step in simulate_scene(
        made,
        prepare(made, load_target(SOLVERS["newton"])()),
        StopRule(50, 1e-4),
        initial_guess="extrapolated",
        frames=14,
    ):
        assert count_intersections(made, step.positions, 0.0) == 0
        last = step.positions
    assert gaps(last).max() < 0.052


def test_each_vertex_is_sewn_to_what_is_nearest():
    made = build_scene(spec(SEWING.model_copy(update={"second_row": VertexSelection(indices=(25, 29))})), 5)
    (energy,) = (e for e in made.system.energies if isinstance(e, Energy))
    assert energy.edges.tolist() == [[0, 25], [1, 25], [2, 25], [3, 29], [4, 29]]


def test_the_reference_terms_agree():
    assert verify_terms(spec(SEWING), build_scene(spec(SEWING), 5), "implicit-euler") == "agrees"


def test_rows_that_share_a_vertex_and_ends_before_the_beginning_are_refused():
    with pytest.raises(InputError, match="sewing: vertex 0 is in both rows"):
        build_scene(spec(SEWING.model_copy(update={"second_row": VertexSelection(indices=(0,))})), 3)
    with pytest.raises(ValidationError, match="end at 0 s, before they begin at 1 s"):
        SewingEffect(first_row=ROWS[0], second_row=ROWS[1], stiffness=1.0, start_time=1.0, end_time=0.0)

"""The truth of scenes with contact: the limit of the model, how well it is known, and when there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.reference import self_converged_trajectory
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import integrate_motion
from springbench.harness.reference.self_converged_trajectory import CONTACT_MARGIN, NotConverged
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_spec import SceneSpec

END = 0.2
FIRST_PIN = PinsEffect(parts=("first",), weight="exact")


def build_thrown_chain(*effects: Any, velocity: tuple[float, float, float]) -> SceneSpec:
    """A chain of 1 kg."""
    given = {"mesh": ChainMesh(), "effects": (GravityEffect(), *effects), "velocity": velocity, "time_step": END / 4}
    return SceneSpec(mass=1.0, frames=4, path=Path("scene.yaml"), default_size=3, **given)


def floor(y: float) -> ContactEffect:
    return ContactEffect.model_validate({"obstacles": [{"kind": "plane", "point": [0.0, y, 0.0]}]})


def test_where_nothing_touches_it_is_the_motion_that_is_integrated_and_is_found_again(tmp_path, monkeypatch):
    effects, velocity = (SpringsEffect(stretch=40.0), FIRST_PIN), (0.5, 1.0, 2.0)
    other, alone = (
        build_thrown_chain(*effects, floor(-9.0), velocity=velocity),
        build_thrown_chain(*effects, velocity=velocity),
    )
    found = ReferenceStore(tmp_path).load_trajectory(other, 3, [END], error=0.1)
    truth = integrate_motion(build_exact_scene(alone, 3), [END])
    assert (found.reference_kind, truth.reference_kind) == ("self-converged", "integrated")
    # Both integrators err by about what halving their steps moved them, and that is the most that either did.
    assert truth.measure_error(0, found.positions[0]) <= 1.5 * found.disagreement[0] <= 1.5 * CONTACT_MARGIN * 0.05
    monkeypatch.setattr(self_converged_trajectory, "compute_self_converged", None)
    again = ReferenceStore(tmp_path).load_trajectory(other, 3, [END], error=0.2)
    assert (again.positions == found.positions).all()
    with pytest.raises(NotConverged, match=r"halving the steps further takes more than .* use an error of"):
        again.require_accuracy(0.01)
    apart = replace(again, disagreement=np.array([0.3]), last_change=0.01)
    with pytest.raises(NotConverged, match=r"limits of implicit Euler and BDF2 differ.*; no error can be measured"):
        apart.require_accuracy(0.1)


def test_an_impact_that_the_steps_do_not_resolve_has_no_reference():
    """The end is as far off as the chain has moved: what it gave back is the integrator's."""
    bouncing = build_thrown_chain(SpringsEffect(stretch=400.0), floor(-0.05), velocity=(0.0, -2.0, 0.0))
    found = self_converged_trajectory.compute_self_converged(
        lambda h, name: build_exact_scene(bouncing.with_time_step(h), 3, name),
        bouncing.time_step,
        [END],
        0.1,
        seconds=0.5,
    )
    with pytest.raises(NotConverged, match=r"contact has no certified reference, .* no error can be measured"):
        found.require_accuracy(0.1)

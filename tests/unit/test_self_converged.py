"""The truth of scenes with contact: the limit of the model, how well it is known, and when there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.reference import self_converged
from harness.reference.frozen import bind
from harness.reference.self_converged import NotConverged
from harness.reference.store import Store
from harness.reference.trajectory import MARGIN, integrate
from harness.scenes.effects.contact import Contact
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs
from harness.scenes.mesh.chain import Chain
from harness.scenes.spec import SceneSpec

END = 0.2
HELD = Pins(at=("first",), weight="exact")


def thrown(*effects: Any, velocity: tuple[float, float, float]) -> SceneSpec:
    """A chain of 1 kg."""
    given = {"mesh": Chain(), "effects": (Gravity(), *effects), "velocity": velocity, "time_step": END / 4}
    return SceneSpec(mass=1.0, frames=4, path=Path("scene.yaml"), default_size=3, **given)


def floor(y: float) -> Contact:
    return Contact.model_validate({"obstacles": [{"kind": "plane", "point": [0.0, y, 0.0]}]})


def test_where_nothing_touches_it_is_the_motion_that_is_integrated_and_is_found_again(tmp_path, monkeypatch):
    effects, velocity = (Springs(stretch=40.0), HELD), (0.5, 1.0, 2.0)
    beside, alone = thrown(*effects, floor(-9.0), velocity=velocity), thrown(*effects, velocity=velocity)
    found = Store(tmp_path).trajectory(beside, 3, [END], error=0.1)
    truth = integrate(bind(alone, 3), [END])
    assert (found.truth, truth.truth) == ("self-converged", "integrated")
    # Both integrators err by about what halving their steps moved them, and that is the most that either did.
    assert truth.error(0, found.positions[0]) <= 1.5 * found.disagreement[0] <= 1.5 * MARGIN * 0.1
    monkeypatch.setattr(self_converged, "converge", None)
    again = Store(tmp_path).trajectory(beside, 3, [END], error=0.2)
    assert (again.positions == found.positions).all()
    with pytest.raises(NotConverged, match=r"halving the steps further takes more than .* ask for an error of"):
        again.require(0.01)
    apart = replace(again, disagreement=np.array([0.3]), moved_last=0.01)
    with pytest.raises(NotConverged, match=r"limits of implicit Euler and BDF2 differ.*; none can be had"):
        apart.require(0.1)


def test_an_impact_that_the_steps_do_not_resolve_has_no_truth(monkeypatch):
    """The end is as far off as the chain has moved: what it gave back is the integrator's."""
    monkeypatch.setattr(self_converged, "SPENT", 0.3)
    bouncing = thrown(Springs(stretch=400.0), floor(-0.05), velocity=(0.0, -2.0, 0.0))
    found = self_converged.converge(lambda h, name: bind(bouncing.stepped(h), 3, name), bouncing.time_step, [END], 0.1)
    with pytest.raises(NotConverged, match=r"contact has no certified reference, .* none can be had"):
        found.require(0.1)

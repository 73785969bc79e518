"""Other libraries' integrators beside ours: CVODE, where it is installed, and what a row says where it is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.config.load import load_scene
from harness.config.sweep import SolverSpec
from harness.experiments.asked import libraries
from harness.experiments.asked.libraries import LIBRARIES, InitialValueProblem
from harness.experiments.asked.peers import peers
from harness.experiments.asked.search import foresee, search
from harness.experiments.asked.ways import Asked
from harness.reference.motion import Field
from harness.reference.trajectory import integrate

SPRING = Path(__file__).parents[2] / "configs" / "scenes" / "single-spring.yaml"


@pytest.mark.parametrize("name", ["cvode-adams", "cvode-bdf"])
def test_cvode_follows_the_motion_to_its_tolerance(name):
    asked = Asked.of(load_scene(SPRING), 2, 0.5)
    scene, truth = asked.bound(asked.frame, "newmark"), integrate(asked.bound(asked.frame, "own"), [0.5])
    field = Field(scene)
    ends = (LIBRARIES[name].end(InitialValueProblem(field, field.start, scene, 0.5, tol, tol)) for tol in (1e-5, 1e-8))
    coarse, fine = (truth.error(0, field.motion(0.5, end)[0].copy()) for end in ends)
    assert fine < 1e-5
    assert fine < 0.1 * coarse


def test_a_peer_that_is_not_installed_is_a_row_that_says_which_command_installs_it(monkeypatch):
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)
    asked = Asked.of(load_scene(SPRING), 2, 0.1)
    seen = foresee(asked, 1e-2, lambda line: None)
    answer = search(asked, 1e-2, seen, lambda line: None, [("own", SolverSpec("velocity-verlet", {}))])
    (peer,) = peers(asked, 1e-2, answer, ["cvode-bdf"])
    assert "pip install -e '.[sundials]'" in peer.reason
    assert not LIBRARIES["scipy-radau"].missing

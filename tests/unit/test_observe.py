"""What the second pass says of a step's forces, by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harness.config.load import load_any
from harness.scenes.bind import build
from harness.simulation.measure import Settings, steps
from harness.simulation.observe import acting
from harness.simulation.step import prepare
from solvers.methods.newton import Newton
from solvers.problem import StopRule

SCENE = """
mesh: {kind: network, positions: [[0, 0, 0], [1, 0, 0]], springs: [[0, 1]]}
mass: 2
time_step: 1/30
frames: 60
effects:
  - {kind: springs, rule: fixed, stretch: 100}
  - {kind: gravity}
  - {kind: ether-drag, rate: 20}
  - {kind: contact, obstacles: [{kind: plane, point: [0, -0.01, 0], normal: [0, 1, 0]}]}
"""


def test_weight_points_down_and_what_a_plane_answers_points_up(tmp_path: Path):
    """Each of two vertices of 1 kg that rest on a plane weighs 9.81 N, and is pushed up by as much."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    (run,) = load_any(tmp_path / "scene.yaml", solvers=["newton"]).runs()
    scene = build(run.scene, run.size)
    *_, last = steps(scene, prepare(scene, Newton()), Settings(StopRule(50, 1e-10), run.first_guess, 60, 1))
    forces = acting(last)
    np.testing.assert_allclose(forces["external"], [[0, -9.81, 0]] * 2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(forces["contact"], [[0, 9.81, 0]] * 2, rtol=0, atol=1e-3)  # once drag has settled it

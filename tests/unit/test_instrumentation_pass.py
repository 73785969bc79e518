"""What the second pass says of a step's forces, by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from springbench.harness.config.config_loader import load_config
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.instrumentation_pass import collect_forces
from springbench.harness.simulation.time_loop import prepare
from springbench.harness.simulation.timing_pass import SteppingSettings, iterate_steps
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import StopRule

SCENE = """
mesh: {kind: network, positions: [[0, 0, 0], [1, 0, 0]], springs: [[0, 1]]}
mass: 2
time_step: 1/30
frames: 60
effects:
  - {kind: springs, scaling_rule: fixed, stretch: 100}
  - {kind: gravity}
  - {kind: ether-drag, decay_rate: 20}
  - {kind: contact, obstacles: [{kind: plane, point: [0, -0.01, 0], normal: [0, 1, 0]}]}
"""


def test_weight_points_down_and_the_contact_force_of_a_plane_points_up(tmp_path: Path):
    """Each of two vertices of 1 kg that rest on a plane weighs 9.81 N, and is pushed up by as much."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    (run,) = load_config(tmp_path / "scene.yaml", solvers=["newton"]).list_runs()
    scene = build_scene(run.scene, run.size)
    *_, last = iterate_steps(
        scene, prepare(scene, NewtonSolver()), SteppingSettings(StopRule(50, 1e-10), run.initial_guess, 60, 1)
    )
    forces = collect_forces(last)
    np.testing.assert_allclose(forces["external"], [[0, -9.81, 0]] * 2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(forces["contact"], [[0, 9.81, 0]] * 2, rtol=0, atol=1e-3)  # once drag has settled it

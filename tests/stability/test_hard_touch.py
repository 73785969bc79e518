"""Every scene of configs/hard-touch by every solver that claims contact of surfaces: no intersection in any frame."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.instrumentation_pass import count_intersections
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.contact.contact_potential import BarrierContact
from springbench.solvers.contact.obstacle_advancement import NoClearance
from springbench.solvers.model.step_problem import StopRule

from tests.self_contact_scenes import SURFACE_CONTACT_SOLVERS

CASES = {
    path.stem: path for path in sorted((Path(__file__).resolve().parents[2] / "configs/hard-touch").glob("*.yaml"))
}
SOLVE = SURFACE_CONTACT_SOLVERS
QUICK = {"edges-parallel", "vertex-on-face", "needles"}
QUICKLY = {"newton", "newton-cg", "pncg", "lbfgs", "lbfgs float32", "hybrid"}
IMPOSSIBLE = {"slit-closes": "obstacles leave no room"}
MANY = {"newton", "newton-cg", "hybrid"}
FEW = 4
"""Frames of all other solvers, whose iterations are many."""


@pytest.mark.parametrize(
    ("case", "name"),
    [
        pytest.param(case, name, marks=() if case in QUICK and name in QUICKLY else pytest.mark.long)
        for case in CASES
        for name in SOLVE
    ],
)
def test_nothing_passes_through_anything(case: str, name: str):
    spec = load_scene(CASES[case])
    made, touched = build_scene(spec, spec.default_size or 6), 0
    rule, frames = StopRule(60, 1e-4), spec.frames if name in MANY or case in IMPOSSIBLE else FEW
    run = simulate_scene(made, prepare(made, SOLVE[name]), rule, initial_guess="previous", frames=frames)
    if case in IMPOSSIBLE:
        with pytest.raises(NoClearance, match=IMPOSSIBLE[case]):
            list(run)
        return
    for step in run:
        assert count_intersections(made, step.positions, made.compute_time(step.index)) == 0
        energies = [energy for energy in step.problem.energies if isinstance(energy, BarrierContact)]
        assert not any(energy.find_violated_pairs(step.positions) for energy in energies)
        touched += sum(len(energy.hessian_blocks(step.positions).vertices) for energy in energies)
    assert touched or frames < 10

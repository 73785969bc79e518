"""Every scene of configs/touch: no intersection in any frame, and the knot is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.instrumentation_pass import count_intersections
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.contact.contact_potential import BarrierContact
from springbench.solvers.model.step_problem import Solver, StopRule

from tests.knot_invariants import knot_determinant
from tests.self_contact_scenes import SURFACE_CONTACT_SOLVERS

SCENES = {path.stem: path for path in sorted((Path(__file__).resolve().parents[2] / "configs/touch").glob("*.yaml"))}
SMALL = {"knot": 60, "net-on-block": 5}
SOLVE = SURFACE_CONTACT_SOLVERS
FRAMES = {"hybrid": 1000}
OTHERS = {"twisted-cloth": 120}
"""Sixty of all others, where more are not named: by its short steps this cloth first touches itself at frame 79."""


def free(scene: str, solver: Solver, size: int | None, frames: int, tolerance: float = 1e-3) -> np.ndarray:
    """The last positions (n, 3) [m]."""
    spec = load_scene(SCENES[scene])
    made = build_scene(spec, size or spec.default_size or 6)
    p, touched, rule = made.mesh.rest_positions, 0, StopRule(100, tolerance)
    for step in simulate_scene(made, prepare(made, solver), rule, initial_guess="previous", frames=frames):
        p = step.positions
        assert count_intersections(made, p, made.compute_time(step.index)) == 0
        energies = [energy for energy in step.problem.energies if isinstance(energy, BarrierContact)]
        assert not any(energy.find_violated_pairs(p) for energy in energies)
        touched += sum(len(energy.hessian_blocks(p).vertices) for energy in energies)
    assert touched
    return p


@pytest.mark.parametrize("scene", SMALL)
def test_nothing_passes_through_anything_in_small(scene: str):
    free(scene, SOLVE["hybrid"], SMALL[scene], 12)


@pytest.mark.long
@pytest.mark.parametrize("solver", SOLVE)
@pytest.mark.parametrize("scene", SCENES)
def test_nothing_passes_through_anything(scene: str, solver: str):
    free(scene, SOLVE[solver], None, FRAMES.get(solver, OTHERS.get(scene, 60)))


@pytest.mark.long
def test_the_rope_is_tied_in_an_overhand_knot():
    assert knot_determinant(free("knot", SOLVE["hybrid"], None, 240)) == 3


def test_the_determinant_distinguishes_knots():
    t = np.linspace(-2.2, 2.2, 60)
    trefoil = np.stack([t**3 - 3 * t, t**4 - 4 * t**2, 0.12 * (t**5 - 10 * t)], axis=1)
    turned = trefoil @ np.array([[1.0, 0.0, 0.0], [0.0, np.cos(1.0), -np.sin(1.0)], [0.0, np.sin(1.0), np.cos(1.0)]])
    assert knot_determinant(trefoil) == knot_determinant(turned) == 3
    through = trefoil * (1.0, 1.0, 0.0) + np.stack([0 * t, 0 * t, t], axis=1)  # the same curve, always rising
    assert knot_determinant(through) == 1
    assert knot_determinant(np.stack([t, 0 * t, 0 * t], axis=1)) == 1

"""Every scene of configs/touch: no intersection in any frame, and the knot is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.config.load import load_scene
from harness.scenes.bind import build
from harness.simulation.observe import intersections
from harness.simulation.step import prepare, simulate
from solvers.contact.self_contact import PairContact
from solvers.problem import Solver, StopRule
from tests.knots import determinant
from tests.self_contacts import TAKE_SURFACES

SCENES = {path.stem: path for path in sorted((Path(__file__).resolve().parents[2] / "configs/touch").glob("*.yaml"))}
SMALL = {"knot": 60, "net-on-block": 5}
SOLVE = TAKE_SURFACES
FRAMES = {"hybrid": 1000}
OTHERS = {"twisted-cloth": 120}
"""Sixty of all others, where more are not named: by its short steps this cloth first touches itself at frame 79."""


def free(scene: str, solver: Solver, size: int | None, frames: int, tolerance: float = 1e-3) -> np.ndarray:
    """The last positions (n, 3) [m]."""
    spec = load_scene(SCENES[scene])
    made = build(spec, size or spec.default_size or 6)
    p, touched, rule = made.mesh.rest, 0, StopRule(100, tolerance)
    for step in simulate(made, prepare(made, solver), rule, first_guess="current", frames=frames):
        p = step.positions
        assert intersections(made, p, made.time(step.index)) == 0
        energies = [energy for energy in step.problem.energies if isinstance(energy, PairContact)]
        assert not any(energy.closed(p) for energy in energies)
        touched += sum(len(energy.blocks(p).vertices) for energy in energies)
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
    assert determinant(free("knot", SOLVE["hybrid"], None, 240)) == 3


def test_the_determinant_tells_knots():
    t = np.linspace(-2.2, 2.2, 60)
    trefoil = np.stack([t**3 - 3 * t, t**4 - 4 * t**2, 0.12 * (t**5 - 10 * t)], axis=1)
    turned = trefoil @ np.array([[1.0, 0.0, 0.0], [0.0, np.cos(1.0), -np.sin(1.0)], [0.0, np.sin(1.0), np.cos(1.0)]])
    assert determinant(trefoil) == determinant(turned) == 3
    through = trefoil * (1.0, 1.0, 0.0) + np.stack([0 * t, 0 * t, t], axis=1)  # the same curve, always rising
    assert determinant(through) == 1
    assert determinant(np.stack([t, 0 * t, 0 * t], axis=1)) == 1

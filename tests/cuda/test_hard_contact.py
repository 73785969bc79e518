"""Hard cases of contact on a device, as small as the simulator does them: nothing passes through, or it is said why.

NUMBA_ENABLE_CUDASIM=1 .venv/bin/python -m pytest -q -n 0 -m long tests/cuda/test_hard_contact.py
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from harness.base.errors import InputError
from harness.config.load import load_scene
from harness.scenes.bind import Scene, build
from harness.scenes.effects.base import Effect
from harness.scenes.effects.surface_contact import SurfaceContact
from harness.scenes.mesh.surfaces import Balloon
from harness.scenes.obstacles import Sphere
from harness.scenes.shapes import Solid
from harness.simulation.observe import intersections
from harness.simulation.step import prepare, simulate
from solvers.contact.self_contact import PairContact
from solvers.contact.touching import is_contact
from solvers.core.clearing import Blocked
from solvers.methods.vbd import VertexBlockDescent
from solvers.problem import StopRule
from tests.cuda.near import PRECISIONS

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
TOUCH = ("contact", "self-contact", "surface-contact")
CASES = {
    f"{folder}, {path.stem}": path
    for folder in ("hard", "hard-touch")
    for path in sorted((CONFIGS / folder).glob("*.yaml"))
    if any(effect.kind in TOUCH for effect in load_scene(path).effects)
}
QUICK = ("hard-touch, at-the-thickness", "hard-touch, coplanar-sheets")
RULE, FRAMES = StopRule(8), 2
SIZES = 2, 3, 4, 6
COARSER = "range-wide", "thickness-1e-6"
"""Cases of which the ball has as many vertices here as the other cases' balls, 1,002. A thickness of 1e-4 m asks for
36,002, over which an hour in the simulator is too short. What the cases ask, a range of 300 times the thickness, and a
micrometre, asks for no rounder ball."""


def smallest(path: Path) -> Scene:
    """The scene at the smallest size that it can have."""
    spec = load_scene(path)
    if path.stem in COARSER:
        spec = spec.model_copy(update={"effects": tuple(map(coarser, spec.effects))})
    for size in SIZES[:-1]:
        with suppress(InputError):
            return build(spec, size)
    return build(spec, SIZES[-1])


def coarser(effect: Effect) -> Effect:
    """The effect, its one ball in triangles that are larger."""
    if not isinstance(effect, SurfaceContact):
        return effect
    (ball,) = effect.obstacles
    assert isinstance(ball, Sphere)
    return effect.model_copy(
        update={"obstacles": (Solid(mesh=Balloon(radius=ball.radius), size=10, offset=ball.center),)}
    )


@pytest.mark.parametrize(
    "case", [name if name in QUICK else pytest.param(name, marks=pytest.mark.long) for name in CASES]
)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_nothing_passes_through_on_a_device(case: str, precision: Literal["float64", "float32"]) -> None:
    made = smallest(CASES[case])
    surfaces = [energy for energy in made.system.energies if isinstance(energy, PairContact)]
    assert surfaces or any(map(is_contact, made.system.energies))
    prepared = prepare(made, VertexBlockDescent(device="cuda", precision=precision))
    with suppress(*((Blocked,) if "slit-closes" in case else ())):
        for step in simulate(made, prepared, RULE, first_guess="current", frames=FRAMES):
            assert np.isfinite(step.positions).all()
            assert not intersections(made, step.positions, made.time(step.index))
            for energy in step.problem.energies:
                assert not (isinstance(energy, PairContact) and energy.closed(step.positions))

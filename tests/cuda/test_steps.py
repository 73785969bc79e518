"""Steps that stay on a device: the processor's motion, with no look at it and the same bits; and what cannot stay."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from harness.scenes.bind import Scene
from harness.scenes.effects.air_drag import AirDrag
from harness.scenes.effects.ether_drag import EtherDrag
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs
from harness.scenes.effects.wind import Wind
from harness.scenes.mesh.grid import Grid
from harness.simulation.clock import Clock, Watch
from harness.simulation.measure import Settings, steps
from harness.simulation.on_device import Replayed, Staying, on_device
from harness.simulation.step import prepare
from solvers.cuda.run import Stream
from solvers.methods.newton_cg import NewtonCG
from solvers.methods.pncg import NonlinearCG
from solvers.methods.vbd import VertexBlockDescent
from solvers.problem import StopRule
from tests.effects import ATTACHED, BEND, DASHPOTS, MOVES, RAYLEIGH, integrated
from tests.scenes import scene

STOP, FRAMES = StopRule(3), 2
"""So many iterations that the processor does the same, whatever residuals say."""

METHODS: dict[str, Callable[..., Any]] = {
    "vbd": VertexBlockDescent,
    "newton-cg": lambda **more: NewtonCG(preconditioner="block-jacobi", **more),
    "pncg": lambda **more: NonlinearCG(preconditioner="block-jacobi", **more),
}

DRAGS = EtherDrag(rate=0.5), AirDrag(coefficient=0.3), AirDrag(law="quadratic", coefficient=0.3)


def cloth(*effects: Any) -> Scene:
    """Held at two corners, which move."""
    pins = Pins(at=("top_corners",), motion=MOVES)
    return scene(Grid(), Springs(stretch=300.0, shear=60.0), Gravity(), pins, *effects, size=4)


def staying(made: Scene, solver: Any, first_guess: str = "current") -> Staying:
    found = on_device(made, prepare(made, solver), first_guess)
    assert isinstance(found, Staying)
    return found


@pytest.mark.parametrize(
    ("method", "effects", "first_guess"),
    [
        ("vbd", DRAGS, "inertial"),
        ("newton-cg", (*DRAGS, DASHPOTS), "current"),
        ("pncg", (BEND, *DRAGS), "assignment"),
    ],
)
def test_steps_are_those_of_the_processor_and_timed_ones_copy_nothing(
    method: str, effects: tuple[Any, ...], first_guess: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, settings = cloth(*effects), Settings(STOP, first_guess, FRAMES, 1)
    on_it = staying(made, METHODS[method](device="cuda", precision="float64"), first_guess)
    there = list[Any]()
    for step in steps(made, on_it, settings):
        on_it.keep(step)
        there.append(step.positions)
    here = [step.positions for step in steps(made, prepare(made, METHODS[method]()), settings)]
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-10)
    on_it.upload()
    seen, large = list[int](), Stream.download

    def counted(self: Stream, array: Any) -> Any:
        seen.append(array.size)
        return large(self, array)

    with monkeypatch.context() as patch:
        patch.setattr(Stream, "download", counted)
        assert len(list(on_it.timed(Clock(Watch())))) == FRAMES
    assert max(seen, default=0) <= 8, "sums alone are looked at"
    assert method != "vbd" or not seen, "not even those"
    np.testing.assert_array_equal(on_it.download(), there[-1])


@pytest.mark.parametrize(
    ("make", "first_guess", "why"),
    [
        (lambda: cloth(Wind(field="gusts")), "current", r"computes a force before each step.*\(wind\)"),
        (lambda: cloth(ATTACHED), "current", "states .* before each step"),
        (lambda: cloth(RAYLEIGH, BEND), "current", "RayleighDamping .* couples"),
        (lambda: cloth(), "motion", "makes first_guess: motion"),
        (lambda: integrated(cloth(), "bdf2"), "current", "integrators other than implicit-euler"),
    ],
    ids=["a force in Python", "what moves", "damping of edges", "the guess", "the integrator"],
)
def test_what_the_host_has_to_do_is_said(make: Callable[[], Scene], first_guess: str, why: str) -> None:
    made = make()
    found = on_device(made, prepare(made, METHODS["pncg"](device="cuda")), first_guess)
    assert isinstance(found, Replayed)
    assert found.through_host is not None
    assert re.search(why, found.through_host), found.through_host


def test_on_the_processor_there_is_nothing_to_say() -> None:
    made = cloth()
    assert on_device(made, prepare(made, METHODS["pncg"]()), "current") is None

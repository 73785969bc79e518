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
from solvers.methods.explicit import Tsitouras5
from solvers.methods.xpbd import Xpbd
from solvers.problem import StopRule
from tests.contacts import contact
from tests.cuda import hard
from tests.cuda.near import PRECISIONS
from tests.effects import ATTACHED, BEND, DASHPOTS, MOVES, RAYLEIGH, integrated
from tests.scenes import scene

STOP, FRAMES = StopRule(3), 3
"""So many iterations that the processor does the same, whatever residuals say; BDF2's third step recalls its own."""

METHODS = {**hard.METHODS, "tsitouras-5": lambda **more: Tsitouras5(error=1e-4, **more)}
OWN = {"xpbd-small-steps", "symplectic-euler", "velocity-verlet", "runge-kutta-4", "tsitouras-5"}
"""Methods that have a velocity of their own."""
ASKED = {"newton-cg", "pncg", "lbfgs", "tsitouras-5"}
"""Methods of which a few numbers go to the host and back within a step, of a search or of steps that are chosen."""

UP = {"keys": [{"time": 0}, {"time": 1, "offset": (0, 3, 0)}]}
RISING = contact({"kind": "sphere", "center": (0.0, -0.46, 0.2), "radius": 0.43, "motion": UP}, friction=0.0)
"""Without friction: a host states steps that iterate it."""
FILTERS = EtherDrag(rate=0.5), AirDrag(law="quadratic", coefficient=0.3)
DRAGS = *FILTERS, AirDrag(coefficient=0.3)


def cloth(*effects: Any, moves: Any = MOVES) -> Scene:
    """Held at two corners, which move."""
    pins = Pins(at=("top_corners",), motion=moves)
    return scene(Grid(), Springs(stretch=300.0, shear=60.0), Gravity(), pins, *effects, size=3)


def staying(made: Scene, solver: Any, first_guess: str = "current") -> Staying:
    found = on_device(made, prepare(made, solver), first_guess)
    assert isinstance(found, Staying)
    return found


def kept(made: Scene, on_it: Any, first_guess: str = "current") -> list[Any]:
    """Where its steps end, which are looked at."""
    there = list[Any]()
    for step in steps(made, on_it, Settings(STOP, first_guess, FRAMES, 1)):
        on_it.keep(step)
        there.append(step.positions)
    return there


COPIES = "upload", "put", "download"


@pytest.fixture
def moved(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[int]]:
    """Bytes of each copy between host and device, from now on, by what copies."""
    seen: dict[str, list[int]] = {name: [] for name in COPIES}

    def counting(name: str, usual: Callable[..., Any]) -> Callable[..., Any]:
        def copied(self: Stream, array: Any, *more: Any) -> Any:
            seen[name].append(array.nbytes)
            return usual(self, array, *more)

        return copied

    for name in COPIES:
        monkeypatch.setattr(Stream, name, counting(name, getattr(Stream, name)))
    return seen


def timed(on_it: Staying, moved: dict[str, list[int]]) -> list[int]:
    """What its timed steps move."""
    on_it.upload()
    for each in moved.values():
        each.clear()
    assert len(list(on_it.timed(Clock(Watch())))) == FRAMES
    return [n for each in moved.values() for n in each]


@pytest.mark.parametrize(
    ("method", "effects", "first_guess", "integrator"),
    [
        ("vbd", DRAGS, "inertial", "midpoint"),
        ("vbd", (RISING,), "current", "bdf2"),
        ("newton-cg", (*DRAGS, DASHPOTS), "current", "bdf2"),
        ("newton-cg", (*DRAGS, DASHPOTS), "current", "midpoint"),
        ("pncg", (BEND, *DRAGS), "assignment", "implicit-euler"),
        ("lbfgs", (BEND, *DRAGS), "assignment", "bdf2"),
        ("xpbd", FILTERS, "current", "implicit-euler"),
        ("xpbd", FILTERS, "current", "midpoint"),
        ("xpbd-small-steps", FILTERS, "current", "implicit-euler"),
        ("xpbd-small-steps", (), "current", "own"),
        ("symplectic-euler", FILTERS, "current", "implicit-euler"),
        ("velocity-verlet", (BEND, *DRAGS), "current", "own"),
        ("runge-kutta-4", FILTERS, "current", "implicit-euler"),
        ("tsitouras-5", (BEND, *DRAGS), "current", "implicit-euler"),
    ],
)
def test_steps_are_those_of_the_processor(
    method: str, effects: tuple[Any, ...], first_guess: str, integrator: str
) -> None:
    made = integrated(cloth(*effects), integrator)
    here = [
        step.positions for step in steps(made, prepare(made, METHODS[method]()), Settings(STOP, first_guess, FRAMES, 1))
    ]
    spacing = float(made.springs.rest_length.mean())
    for precision, close in zip(PRECISIONS, (1e-10, 1e-5 * spacing), strict=True):
        on_it = staying(made, METHODS[method](device="cuda", precision=precision), first_guess)
        np.testing.assert_allclose(kept(made, on_it, first_guess), here, rtol=0, atol=close, err_msg=precision)


@pytest.mark.parametrize("method", METHODS)
def test_timed_steps_copy_nothing_of_a_meshs_size_and_end_at_the_same_bits(
    method: str, moved: dict[str, list[int]]
) -> None:
    """However many they are; of steps that are looked at each end is copied, once."""
    made = cloth(moves=None)
    on_it, size = staying(made, METHODS[method](device="cuda")), made.mesh.rest.nbytes
    last = kept(made, on_it)[-1]
    assert [n for n in moved["download"] if n >= size] == FRAMES * (1 + (method in OWN)) * [size]
    copied = timed(on_it, moved)
    assert max(copied, default=0) < size, "a few numbers"
    assert (method in ASKED) == bool(copied), "or none at all"
    np.testing.assert_array_equal(on_it.download(), last)


def test_of_pins_that_move_the_targets_alone_go_to_the_device(moved: dict[str, list[int]]) -> None:
    made = integrated(cloth(), "midpoint")
    on_it = staying(made, Xpbd(device="cuda"))
    kept(made, on_it)
    assert timed(on_it, moved) == FRAMES * [made.pin_targets.nbytes]


@pytest.mark.parametrize(
    ("make", "first_guess", "why"),
    [
        (lambda: cloth(Wind(field="gusts")), "current", r"computes a force before each step.*\(wind\)"),
        (lambda: cloth(ATTACHED), "current", "states .* before each step"),
        (lambda: cloth(RAYLEIGH, BEND), "current", "RayleighDamping .* couples"),
        (lambda: cloth(), "motion", "makes first_guess: motion"),
        (lambda: integrated(cloth(), "sdirk-2"), "current", "integrators that have several a step"),
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

"""What an absent effect allocates: nothing, neither when a scene is bound and a solver prepared nor in a step."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from harness.scenes.bind import Scene
from harness.scenes.effects.base import Effect
from harness.scenes.effects.constant_force import ConstantForce
from harness.scenes.effects.ether_drag import EtherDrag
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs
from harness.scenes.effects.wind import Wind
from harness.scenes.mesh.grid import Grid
from harness.simulation.step import prepare, simulate
from solvers.methods.local_global import SparseLocalGlobal
from solvers.problem import Prepared, StopRule
from tests.effects import ATTACHED, BEND, DASHPOTS, DRAG, LIMITS, RAYLEIGH
from tests.scenes import scene

SIDE = 20
PRESENT: tuple[Effect, ...] = (BEND, LIMITS, DASHPOTS, RAYLEIGH, DRAG, ATTACHED, Wind(per="triangle"))
IDLE: dict[str, Effect] = {
    "bending": BEND.model_copy(update={"stiffness": 0.0}),
    "strain limits": LIMITS.model_copy(update={"stiffness": 0.0}),
    "dashpots": DASHPOTS.model_copy(update={"stretch": 0.0}),
    "rayleigh": RAYLEIGH.model_copy(update={"mass": 0.0, "stiffness": 0.0}),
    "air drag": DRAG.model_copy(update={"coefficient": 0.0}),
    "attachments": ATTACHED.model_copy(update={"stiffness": 0.0}),
    "wind": Wind(per="triangle", strength=0.0),
    "constant force": ConstantForce(force=(0.0, 0.0, 0.0)),
    "ether drag": EtherDrag(rate=0.0),
}


def arrays(*roots: object) -> int:
    """How many NumPy arrays can be reached from some objects, modules and classes apart."""
    seen: set[int] = set()
    waiting: list[object] = list(roots)
    found = 0
    while waiting:
        one = waiting.pop()
        if id(one) in seen or isinstance(one, type) or type(one).__name__ == "module":
            continue
        seen.add(id(one))
        found += isinstance(one, np.ndarray)
        waiting += _referents(one)
    return found


def _referents(one: object) -> Iterable[object]:
    """What an object holds; of a function what it closes over, and not the globals of its module."""
    if hasattr(one, "__code__"):
        return [cell.cell_contents for cell in getattr(one, "__closure__", None) or ()]
    return gc.get_referents(one)


def bound(*effects: Effect) -> tuple[Scene, Prepared]:
    pins = Pins(at=("top_corners",))
    made = scene(Grid(), Springs(stretch=300.0), Gravity(), pins, *effects, size=SIDE)
    made = replace(made, halved=None)  # a recipe, which holds what the effects were described by
    return made, prepare(made, SparseLocalGlobal())


@cache
def plain() -> tuple[int, int]:
    """The arrays of a scene without the effect, and the most bytes of a step."""
    made, prepared = bound()
    return arrays(made, prepared), most_in_a_step(made, prepared)


def most_in_a_step(made: Scene, prepared: Prepared) -> int:
    """The most bytes that a step which is not the first allocates at once; the least of some runs, for Python itself
    allocates now and then."""
    most = []
    for _turn in range(4):
        run = simulate(made, prepared, StopRule(5), first_guess="current", frames=3)
        for _ in range(2):
            next(run)
        gc.collect()
        tracemalloc.start()
        next(run)
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return min(most)


@pytest.mark.parametrize("effect", IDLE.values(), ids=IDLE)
def test_an_effect_that_does_nothing_has_no_array(effect: Effect):
    assert arrays(*bound(effect)) == plain()[0]


@pytest.mark.parametrize("effect", PRESENT, ids=lambda effect: effect.kind)
def test_an_effect_that_does_something_has_arrays(effect: Effect):
    assert arrays(*bound(effect)) > plain()[0]


@pytest.mark.parametrize("effect", IDLE.values(), ids=IDLE)
def test_a_step_allocates_nothing_for_an_effect_that_does_nothing(effect: Effect):
    # An array of one number at each vertex has 3200 bytes; what Python itself allocates differs by some hundreds.
    assert abs(most_in_a_step(*bound(effect)) - plain()[1]) < 8 * SIDE**2

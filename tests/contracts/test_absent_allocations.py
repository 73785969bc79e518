"""What an absent effect allocates: nothing, neither when a scene is bound and a solver prepared nor in a step."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from springbench.harness.scenes.effects.constant_force_effect import ConstantForceEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.wind_effect import WindEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import PreparedSolver, StopRule

from tests.effect_scenes import (
    AIR_DRAG_EFFECT,
    ATTACHMENT_EFFECT,
    BENDING_EFFECT,
    DASHPOT_EFFECT,
    RAYLEIGH_EFFECT,
    STRAIN_LIMIT_EFFECT,
)
from tests.scene_builders import build_test_scene

SIDE = 20
PRESENT: tuple[SceneEffect, ...] = (
    BENDING_EFFECT,
    STRAIN_LIMIT_EFFECT,
    DASHPOT_EFFECT,
    RAYLEIGH_EFFECT,
    AIR_DRAG_EFFECT,
    ATTACHMENT_EFFECT,
    WindEffect(acts_on="triangle"),
)
IDLE: dict[str, SceneEffect] = {
    "bending": BENDING_EFFECT.model_copy(update={"stiffness": 0.0}),
    "strain limits": STRAIN_LIMIT_EFFECT.model_copy(update={"stiffness": 0.0}),
    "dashpots": DASHPOT_EFFECT.model_copy(update={"stretch": 0.0}),
    "rayleigh": RAYLEIGH_EFFECT.model_copy(update={"mass_coefficient": 0.0, "stiffness_coefficient": 0.0}),
    "air drag": AIR_DRAG_EFFECT.model_copy(update={"coefficient": 0.0}),
    "attachments": ATTACHMENT_EFFECT.model_copy(update={"stiffness": 0.0}),
    "wind": WindEffect(acts_on="triangle", strength=0.0),
    "constant force": ConstantForceEffect(force=(0.0, 0.0, 0.0)),
    "ether drag": EtherDragEffect(decay_rate=0.0),
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
    """Objects that an object refers to; of a function what it closes over, and not the globals of its module."""
    if hasattr(one, "__code__"):
        return [cell.cell_contents for cell in getattr(one, "__closure__", None) or ()]
    return gc.get_referents(one)


def build_prepared_scene(*effects: SceneEffect) -> tuple[Scene, PreparedSolver]:
    pins = PinsEffect(parts=("top_corners",))
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), GravityEffect(), pins, *effects, size=SIDE)
    made = replace(made, build_coarser=None)  # a recipe, which contains what the effects were described by
    return made, prepare(made, SparseLocalGlobal())


@cache
def plain() -> tuple[int, int]:
    """The arrays of a scene without the effect, and the most bytes of a step."""
    made, prepared = build_prepared_scene()
    return arrays(made, prepared), most_in_a_step(made, prepared)


def most_in_a_step(made: Scene, prepared: PreparedSolver) -> int:
    """The most bytes that a step which is not the first allocates at once; the least of some runs, for Python itself
    allocates now and then. Memory from before the trace is not counted, so garbage need not be collected."""
    most = []
    for _turn in range(4):
        run = simulate_scene(made, prepared, StopRule(5), initial_guess="previous", frames=3)
        for _ in range(2):
            next(run)
        tracemalloc.start()
        next(run)
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return min(most)


@pytest.mark.parametrize("effect", IDLE.values(), ids=IDLE)
def test_an_effect_that_does_nothing_has_no_array(effect: SceneEffect):
    assert arrays(*build_prepared_scene(effect)) == plain()[0]


@pytest.mark.parametrize("effect", PRESENT, ids=lambda effect: effect.kind)
def test_an_effect_that_does_something_has_arrays(effect: SceneEffect):
    assert arrays(*build_prepared_scene(effect)) > plain()[0]


@pytest.mark.parametrize("effect", IDLE.values(), ids=IDLE)
def test_a_step_allocates_nothing_for_an_effect_that_does_nothing(effect: SceneEffect):
    # An array of one number at each vertex has 3200 bytes; what Python itself allocates differs by some hundreds.
    assert abs(most_in_a_step(*build_prepared_scene(effect)) - plain()[1]) < 8 * SIDE**2

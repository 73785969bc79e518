"""Gates on what effects cost: an iteration with each effect over one without, by each solver that has a goal."""

from __future__ import annotations

import pytest

from harness.base.machine import pinned_threads
from harness.config.load import load_scene
from harness.experiments.ablation.prices import price, ready
from solvers.registry import SOLVERS, load
from tests.bench.effects import GATES, KINDS, PRICES, SOLVED, STOP


@pytest.mark.long
@pytest.mark.parametrize("effect", KINDS)
@pytest.mark.parametrize("solver", SOLVED)
def test_an_effect_stays_below_its_limit(solver: str, effect: str):
    """By the lower end of the interval: a price that is beyond the limit for sure fails, noise does not."""
    made, scene = load(SOLVERS[solver])(), load_scene(PRICES)
    with pinned_threads(1):
        both = ready(scene, 33, made, effect), ready(scene, 33, made)
        found = price(effect, *both, STOP, frames=3, rounds=5)
    assert found.price.low <= GATES[solver][KINDS[effect]]
    assert found.price.middle >= 1.0 / 3.0  # what tells so much less has not done the work

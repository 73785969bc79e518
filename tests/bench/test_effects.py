"""Gates on the overhead of effects: the time of an iteration with an effect over one without, by solver."""

from __future__ import annotations

import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.ablation.iteration_overhead import measure_overhead, prepare_scene
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.effects import DEFAULT_SOLVERS, GATES, KINDS, PRICES, SINGLE_EFFECTS, STOP


@pytest.mark.long
@pytest.mark.parametrize("effect", [*SINGLE_EFFECTS, "all"])
@pytest.mark.parametrize("solver", DEFAULT_SOLVERS)
def test_an_effect_stays_below_its_limit(solver: str, effect: str):
    """The lower end of the interval is compared, so that noise does not cause a failure."""
    made, scene = load_target(SOLVERS[solver])(), load_scene(PRICES)
    with limit_threads(1):
        both = prepare_scene(scene, 33, made, effect), prepare_scene(scene, 33, made)
        found = measure_overhead(effect, *both, STOP, initial_guess="previous", frames=3, max_rounds=5)
    assert found.ratio_interval.low <= GATES[solver][KINDS[effect]]
    assert found.ratio_interval.estimate >= 1.0 / 3.0  # a much smaller ratio means that work is missing

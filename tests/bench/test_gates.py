"""Gates on ratios of times. Without `--benchmark-only` nothing is timed: candidate and yardstick must agree."""

from dataclasses import asdict
from functools import partial

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from harness.base.machine import pinned_threads
from tests.bench.accuracy import ACCURACY
from tests.bench.contact import CONTACT
from tests.bench.gates import GATES, THREADS, Gate
from tests.bench.ratio import measure_ratio
from tests.bench.solves import SOLVES


@pytest.mark.parametrize(
    "gate",
    [
        pytest.param(gate, id=gate.name, marks=pytest.mark.benchmark(timer=gate.clock))
        for gate in (*GATES, *SOLVES, *CONTACT, *ACCURACY)
    ],
)
def test_the_gate_holds(gate: Gate, benchmark: BenchmarkFixture):
    with pinned_threads(THREADS):
        candidate = gate.candidate()
        answer = (candidate if benchmark.enabled else partial(benchmark.pedantic, candidate))()
        if gate.tolerance is None and not benchmark.enabled:
            return  # nothing to compare
        yardstick = gate.yardstick()
        wanted = yardstick()
        if gate.tolerance is not None:
            np.testing.assert_allclose(answer, wanted, rtol=0, atol=gate.tolerance)
        if benchmark.enabled:
            ratio = measure_ratio(benchmark, candidate, yardstick, turns=gate.turns, clock=gate.clock)
            benchmark.extra_info |= {key: getattr(gate, key) for key in ("limit", "goal", "why")} | {
                "ratio": asdict(ratio)
            }
            assert not ratio.exceeds(gate.limit), f"{ratio} lies above {gate.limit}: {gate.why}"

"""Gates on ratios of times. Without `--benchmark-only` they only check that candidate and baseline agree."""

import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.regression.program_pair import CLOCK_FUNCTIONS
from springbench.harness.experiments.regression.pytest_plugin import PairedBenchmark

from tests.bench import test_exact
from tests.bench.accuracy import ACCURACY
from tests.bench.contact import CONTACT
from tests.bench.gates import GATES, THREADS, Gate
from tests.bench.solves import SOLVES

ALL = (*GATES, *SOLVES, *CONTACT, *ACCURACY)


def list_marks(gate: Gate) -> list[pytest.MarkDecorator]:
    """Return the marks of a gate's test: the clock of pytest-benchmark, and `short` for the short set."""
    return [pytest.mark.benchmark(timer=CLOCK_FUNCTIONS[gate.clock]), *([pytest.mark.short] if gate.short else [])]


@pytest.mark.parametrize("gate", [pytest.param(gate, id=gate.name, marks=list_marks(gate)) for gate in ALL])
def test_the_gate_passes(gate: Gate, benchmark: BenchmarkFixture, paired_benchmark: PairedBenchmark):
    with limit_threads(THREADS):
        candidate = gate.candidate()
        if gate.tolerance is None and benchmark.disabled:
            benchmark.pedantic(candidate)
            return  # nothing to compare
        extra_info = {key: getattr(gate, key) for key in ("goal", "why", "guards")}
        paired_benchmark(
            candidate,
            gate.baseline(),
            max_ratio=gate.limit,
            clock=gate.clock,
            agreement_rtol=gate.tolerance,
            budget=gate.budget,
            alpha=gate.error,
            **extra_info,
        )


@pytest.mark.parametrize("gate", ALL, ids=lambda gate: gate.name)
def test_a_timed_gate_names_exact_ones_that_guard_it(gate: Gate):
    assert gate.guards
    assert [name for name in gate.guards if not callable(getattr(test_exact, name, None))] == []

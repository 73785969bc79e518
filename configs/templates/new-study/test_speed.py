"""A performance test. `pytest` compares answers and times; `pytest --benchmark-disable` compares the answers only."""

from own_solver import HeavyBall


def test_momentum_is_no_slower(paired_benchmark):
    """Compare the solver with the same iteration without momentum."""
    options = {"size": 6, "frames": 3, "rtol": 1e-3, "max_iterations": 500}
    paired_benchmark.compare_solvers(
        "cloth.yaml", HeavyBall(momentum=0.3), HeavyBall(momentum=0.0), max_ratio=1.0, agreement_rtol=1e-2, **options
    )

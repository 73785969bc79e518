"""What the speed report says of times that are known: limits, ratios, growth."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import pytest
from springbench.harness.report.speed.operation_counts import count_operations
from springbench.harness.report.speed.speed_figures import MachineLimits, SpeedFigures, compute_speed_figures
from springbench.harness.report.speed.speed_table import describe_speed, fit_exponents
from springbench.harness.results.run_schema import RUN_SCHEMA


def machine_row(phase: str, seconds: float, *, bytes: float = 0.0, flops: float = 0.0, working_set: float = 0.0):
    """A row of the machine's own limits, one thread."""
    return {
        "run_id": "m",
        "scene": "cloth",
        "size": 4,
        "solver": "machine",
        "parameters": "{}",
        "threads": 1,
        "phase": phase,
        "seconds": seconds,
        "bytes_moved": bytes,
        "flops": flops,
        "working_set_bytes": working_set,
        "status": "ok",
    }


LIMITS = [
    machine_row("read", 1.0, bytes=100.0, working_set=1e2),
    machine_row("read", 2.0, bytes=100.0, working_set=1e2),  # a disturbed round
    machine_row("read", 1.0, bytes=1.0, working_set=1e8),
    machine_row("fma float64", 1.0, flops=1000.0),
    machine_row("fma float32", 1.0, flops=2000.0),
]


def test_bandwidth_is_read_off_between_the_measured_working_sets():
    machine = MachineLimits(LIMITS)
    # 100 bytes a second at 1e2 and 1 at 1e8: on logarithmic scales a straight line, level beyond its ends.
    assert machine.measured_bandwidth(1, 1e5) == pytest.approx(10.0, rel=1e-12)
    assert machine.measured_bandwidth(1, 1.0) == pytest.approx(100.0, rel=1e-12)
    assert machine.measured_flops(1, "float16") == machine.measured_flops(1, "float32") == 2000.0


def build_candidate_rows(solver: str, parameters: str, seconds: list[float], **columns: Any) -> list[dict[str, Any]]:
    """Rows of a candidate on the cloth, with these seconds in each of its phases."""
    shared = {
        "run_id": solver + parameters,
        "scene": "cloth",
        "size": 4,
        "solver": solver,
        "parameters": parameters,
        "threads": 1,
        "vertices": 16,
        "springs": 42,
        "status": "ok",
        "load_average": 0.5,
    }
    done = {"step": 10, "local": 1, "global": 1}
    return [
        shared | columns | {"phase": phase, "seconds": s * done.get(phase, 1), "num_iterations": done.get(phase)}
        for phase in ("prepare", "local", "global", "step")
        for s in seconds
    ]


def test_figures_state_how_near_the_binding_limit_is():
    rows = [
        *LIMITS,
        *build_candidate_rows("eigen", '{"temporaries": "default"}', [9.0, 8.0, 8.0]),
        *build_candidate_rows("eigen", '{"temporaries": "cheap"}', [4.0, 4.0, 4.0]),
        *build_candidate_rows("cholmod", "{}", [2.0, 2.0, 2.0]),
        *build_candidate_rows("numba", '{"linear_solver": "cholespy"}', [3.0, 3.0, 3.0]),
        *build_candidate_rows(
            "numba", '{"linear_solver": "supernodal"}', [1.0, 2.0, 1.0], nnz_factor=100, flops_per_solve=2400
        ),
    ]
    found = {f.label: f for f in compute_speed_figures(pa.Table.from_pylist(rows, schema=RUN_SCHEMA))}
    assert list(found) == ["eigen default", "eigen cheap", "cholmod", "numba cholespy", "numba supernodal"]
    ours = found["numba supernodal"]
    assert ours.iterations == 10
    # 1 s an iteration in the median, so a step of 50 takes 50 s.
    assert (ours.cold, ours.warm, ours.local, ours.step) == (1e3, 1.5e3, 1e3, 5e4)
    assert ours.speedup is not None
    assert ours.speedup.estimate == 8.0
    assert ours.speedup_over_cheap is not None
    assert ours.speedup_over_cheap.estimate == 4.0
    assert ours.speedup_over_cholmod is not None
    assert ours.speedup_over_cholmod.estimate == 2.0
    assert ours.solve_speedup_over_cholespy is not None
    assert ours.solve_speedup_over_cholespy.estimate == 3.0
    work = count_operations({"nnz_factor": 100, "flops_per_solve": 2400}, 16, 42)["iteration"]
    bandwidth = MachineLimits(LIMITS).measured_bandwidth(1, work.working_set_bytes)
    assert (ours.binding_limit, ours.achieved_bandwidth) == ("bandwidth", work.bytes_moved)
    # At best each byte comes from afar once, 1 s an iteration, and the others at 100 bytes a second.
    at_best = work.working_set_bytes / bandwidth + (work.bytes_moved - work.working_set_bytes) / 100
    assert ours.roofline_fraction == pytest.approx(at_best, rel=1e-12)
    bare = count_operations({"nnz_factor": 100}, 16, 42)["iteration"]
    assert ours.two_pass_fraction == pytest.approx(
        bare.bytes_moved / MachineLimits(LIMITS).measured_bandwidth(1, bare.working_set_bytes), rel=1e-12
    )
    assert found["numba cholespy"].roofline_fraction is None


def test_the_growth_of_a_solve_is_the_power_in_its_times():
    rows = []
    for size in (100, 200, 400):
        for row in build_candidate_rows("sparse", "{}", [1e-9 * size ** (2 * 1.25)]):
            rows.append(row | {"run_id": f"s{size}", "size": size, "vertices": size**2})
    found = compute_speed_figures(pa.Table.from_pylist(rows, schema=RUN_SCHEMA))
    assert fit_exponents(found) == {("cloth", "sparse"): pytest.approx(1.25, rel=1e-9)}  # the fit's round-off


def test_the_growth_of_a_factor_is_shown_with_that_of_its_solve():
    found = [
        SpeedFigures(
            "cloth", size, size**2, "a", 1, "ok", None, None, global_=float(size) ** 2.6, factor_entries=size**2 * size
        )
        for size in (100, 200)
    ]
    assert "a: from 10,000 vertices of cloth on a solve costs n^1.30, its factor has n^1.50 entries" in describe_speed(
        found
    )
    bare = [f._replace(factor_entries=None) for f in found]
    assert "a: from 10,000 vertices of cloth on a solve costs n^1.30" in describe_speed(bare)

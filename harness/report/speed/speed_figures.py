"""Figures of a speed report, computed from its rows.

These are times, bandwidth, the binding limit and its reached share, and speedups.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from springbench.harness.report.speed.operation_counts import OperationCount, count_operations
from springbench.harness.report.varying_settings import find_varying_by_solver
from springbench.harness.results.bootstrap_statistics import ConfidenceInterval, estimate_ratio

MACHINE_SOLVER, CPP_BASELINE = "machine", "eigen"
"""Solver column of rows of candidates that are not solvers."""

OPTIMISED_BASELINE = "cholmod"
"""The solver that represents carefully written C++."""

STEP_ITERATIONS = 50
"""Number of iterations to which all step times are scaled, whatever their actual number."""

ResultRow = dict[str, Any]


class RooflineLimit(NamedTuple):
    """The binding resource, `bandwidth` or `arithmetic`, and the minimum time of some work [s]."""

    resource: str
    seconds: float


class SpeedFigures(NamedTuple):
    """One candidate at one size.

    Times are medians over the rounds [ms]; None: not measured or unknown.

    Attributes:
        step: time of STEP_ITERATIONS iterations.
        factor_entries: number of entries of the factor L.
        achieved_bandwidth: bytes per second of an iteration, from `count_operations`.
        binding_limit: resource that binds.
        roofline_fraction: share of the binding limit that an iteration reaches, by those bytes and flops.
        two_pass_fraction: time of two passes over the entries of L, all loaded from the location of the working set,
            over the measured time; above 1 if entries are used twice while they are in the cache.
        speedup: of a step, over the C++ baseline.
        speedup_over_cheap: of a step, over the C++ baseline with cheap temporaries.
        speedup_over_cholmod: of a step, over carefully written C++.
        solve_speedup_over_cholespy: of a global step.
        precision_error: distance from the converged positions in float64, relative to the scene's size.
        source_fingerprint, commit: code that measured the candidate.
        cpu, cores: machine of the measurement.
    """

    scene: str
    size: int
    vertices: int
    label: str
    threads: int
    status: str
    reason: str | None
    solver_description: str | None
    iterations: int | None = None
    cold: float | None = None
    warm: float | None = None
    local: float | None = None
    global_: float | None = None
    step: float | None = None
    factor_entries: int | None = None
    bytes_moved: float | None = None
    achieved_bandwidth: float | None = None
    binding_limit: str | None = None
    roofline_fraction: float | None = None
    two_pass_fraction: float | None = None
    speedup: ConfidenceInterval | None = None
    speedup_over_cheap: ConfidenceInterval | None = None
    speedup_over_cholmod: ConfidenceInterval | None = None
    solve_speedup_over_cholespy: ConfidenceInterval | None = None
    precision_error: float | None = None
    load_average: float | None = None
    solver: str = ""
    source_fingerprint: str = ""
    cpu: str = ""
    cores: int | None = None
    commit: str = ""


class MachineLimits:
    """Measured limits of the machine, from the rounds of one size.

    These are bandwidth by working set, and flops, each by number of threads.
    """

    def __init__(self, rows: Sequence[ResultRow]) -> None:
        best: dict[tuple[int, str], dict[float, float]] = defaultdict(dict)
        for row in rows:
            rate = (row["bytes_moved"] or row["flops"]) / row["seconds"]
            at = best[row["threads"], row["phase"]]
            at[row["working_set_bytes"]] = max(rate, at.get(row["working_set_bytes"], 0.0))
        self._best = best

    def measured_bandwidth(self, threads: int, working_set: float, kernel: str = "read") -> float:
        """Return the bandwidth for a working set, interpolated on logarithmic scales.

        Args:
            threads: number of threads.
            working_set: size [bytes].
            kernel: name of the microbenchmark.

        Returns:
            Bytes per second.
        """
        at = sorted(self._best[threads, kernel].items())
        known, rates = np.log(np.array(at)).T
        return float(np.exp(cast(float, np.interp(np.log(working_set), known, rates))))

    def measured_flops(self, threads: int, precision: str) -> float:
        """Return flops per second; precisions below float32 compute in float32.

        Args:
            threads: number of threads, one that was measured.
            precision: number format; all but float64 count as float32.
        """
        kind = "float64" if precision == "float64" else "float32"
        return self._best[threads, f"fma {kind}"][0.0]

    def compute_limit(self, operations: OperationCount, threads: int, precision: str) -> RooflineLimit:
        """Compute the lower bound of the time for any order of access.

        Each byte is loaded once from the location of the working set, and repeated accesses come from the fastest
        cache.

        Args:
            operations: bytes and flops of one execution.
            threads: number of threads, one that was measured.
            precision: number format of the arithmetic.

        Returns:
            The limit that binds, bandwidth or arithmetic, and its time [s].
        """
        again = (operations.bytes_moved - operations.working_set_bytes) / max(self._best[threads, "read"].values())
        far = operations.working_set_bytes / self.measured_bandwidth(threads, operations.working_set_bytes)
        return self._binding_limit(far + again, operations, threads, precision)

    def compute_pass_limit(self, operations: OperationCount, threads: int, precision: str) -> RooflineLimit:
        """Compute the time if all moved bytes are loaded from the working set.

        Each access is then as slow as the location of the working set.

        Args:
            operations: bytes and flops of one execution.
            threads: number of threads, one that was measured.
            precision: number format of the arithmetic.

        Returns:
            The limit that binds, bandwidth or arithmetic, and its time [s].
        """
        far = operations.bytes_moved / self.measured_bandwidth(threads, operations.working_set_bytes)
        return self._binding_limit(far, operations, threads, precision)

    def _binding_limit(self, moving: float, operations: OperationCount, threads: int, precision: str) -> RooflineLimit:
        seconds = {"bandwidth": moving, "arithmetic": operations.flop_count / self.measured_flops(threads, precision)}
        binds = max(seconds, key=seconds.__getitem__)
        return RooflineLimit(binds, seconds[binds])


def has_machine_limits(table: pa.Table) -> bool:
    """Return whether rows belong to a speed report, which contains the machine's own limits."""
    return MACHINE_SOLVER in table["solver"].unique().to_pylist()


def compute_speed_figures(table: pa.Table) -> list[SpeedFigures]:
    """Compute the figures of all candidates in the rows, in their order.

    They are relative to the machine's own rows.
    """
    runs: dict[str, list[ResultRow]] = defaultdict(list)
    for row in table.to_pylist():
        runs[row["run_id"]].append(row)
    labels = _label_candidates([found[0] for found in runs.values()])
    groups: dict[tuple[str, int], dict[str, list[ResultRow]]] = defaultdict(dict)
    for found in runs.values():
        groups[found[0]["scene"], found[0]["size"]][labels[found[0]["run_id"]]] = found
    out: list[SpeedFigures] = []
    for group in groups.values():
        limits = MachineLimits(
            [
                row
                for found in group.values()
                for row in found
                if row["solver"] == MACHINE_SOLVER and row["status"] == "ok"
            ]
        )
        for label, found in group.items():
            if found[0]["solver"] != MACHINE_SOLVER:
                out.append(_compute_candidate(label, found, group, limits))
    return out


def _label_candidates(first_rows: Sequence[ResultRow]) -> dict[str, str]:
    """Label candidates by run id.

    A label has the solver, its varying parameters, and its threads if several.
    """
    varying = find_varying_by_solver((row["solver"], json.loads(row["parameters"])) for row in first_rows)
    return {
        row["run_id"]: " ".join(
            [row["solver"]]
            + [str(value) for key, value in json.loads(row["parameters"]).items() if key in varying[row["solver"]]]
            + ([f"x{row['threads']}"] if row["threads"] > 1 else [])
        )
        for row in first_rows
    }


def _compute_candidate(
    label: str, run_rows: Sequence[ResultRow], group: Mapping[str, list[ResultRow]], limits: MachineLimits
) -> SpeedFigures:
    first = run_rows[0]
    known = SpeedFigures(
        *(first["scene"], first["size"], first["vertices"], label, first["threads"]),
        *(first["status"], first["reason"], first["solver_description"]),
        solver=first["solver"],
        source_fingerprint=first["source_fingerprint"] or "",
        cpu=first["cpu"] or "",
        cores=first["cores"],
        commit=first["commit"] or "",
    )
    if first["status"] != "ok":
        return known
    times = {phase: _phase_seconds(run_rows, phase) for phase in ("prepare", "local", "global", "step")}
    known = known._replace(
        iterations=next(row["num_iterations"] for row in run_rows if row["phase"] == "step"),
        cold=1e3 * times["prepare"][0],
        warm=1e3 * float(np.median(times["prepare"][1:])) if len(times["prepare"]) > 1 else None,
        local=1e3 * float(np.median(times["local"])),
        global_=1e3 * float(np.median(times["global"])),
        step=1e3 * STEP_ITERATIONS * float(np.median(times["step"])),
        speedup=_compute_speedup(group, f"{CPP_BASELINE} default", "step", times),
        speedup_over_cheap=_compute_speedup(group, f"{CPP_BASELINE} cheap", "step", times),
        speedup_over_cholmod=_compute_speedup(
            group, _single_thread_label(group, lambda row: row["solver"] == OPTIMISED_BASELINE), "step", times
        ),
        solve_speedup_over_cholespy=_compute_speedup(
            group, _single_thread_label(group, _uses_cholespy), "global", times
        ),
        precision_error=first["precision_error"],
        load_average=max(row["load_average"] for row in run_rows),
    )
    facts = {name: first[name] for name in ("nnz_factor", "factor_bytes", "flops_per_solve") if first[name] is not None}
    if "nnz_factor" not in facts:
        return known
    precision = json.loads(first["parameters"]).get("precision", "float64")
    counts, how = (first["vertices"], first["springs"], precision), (first["threads"], precision)
    touched = count_operations(facts, *counts)["iteration"]
    bare = count_operations({"nnz_factor": facts["nnz_factor"]}, *counts)["iteration"]
    limit, seconds = limits.compute_limit(touched, *how), float(np.median(times["step"]))
    return known._replace(
        factor_entries=facts["nnz_factor"],
        bytes_moved=touched.bytes_moved,
        achieved_bandwidth=touched.bytes_moved / seconds,
        binding_limit=limit.resource,
        roofline_fraction=limit.seconds / seconds,
        two_pass_fraction=limits.compute_pass_limit(bare, *how).seconds / seconds,
    )


def _phase_seconds(run_rows: Sequence[ResultRow], phase: str) -> NDArray[np.float64]:
    """Return the seconds of a phase by round; for a step, those of one iteration."""
    return np.array(
        [
            row["seconds"] / (row["num_iterations"] if phase == "step" else 1)
            for row in run_rows
            if row["phase"] == phase
        ]
    )


def _single_thread_label(group: Mapping[str, list[ResultRow]], predicate: Callable[[ResultRow], bool]) -> str:
    """Return the label of the single-threaded candidate whose rows satisfy the predicate."""
    return next((label for label, found in group.items() if found[0]["threads"] == 1 and predicate(found[0])), "")


def _uses_cholespy(row: ResultRow) -> bool:
    """Return whether a candidate solves with cholespy."""
    return json.loads(row["parameters"]).get("linear_solver") == "cholespy"


def _compute_speedup(
    group: Mapping[str, list[ResultRow]], baseline: str, phase: str, times: Mapping[str, NDArray[np.float64]]
) -> ConfidenceInterval | None:
    """Compute the speedup over a baseline in the same rounds.

    The result is None if the baseline has no times.
    """
    theirs = _phase_seconds(group.get(baseline, ()), phase)
    rounds = min(len(theirs), len(times[phase]))
    return estimate_ratio(theirs[:rounds], times[phase][:rounds]) if rounds else None

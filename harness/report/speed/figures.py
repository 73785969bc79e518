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

from harness.base import machine
from harness.base.statistics import Interval, ratio
from harness.report.speed.counts import Counted, count

MACHINE, YARDSTICK = "machine", "eigen"
"""Solver column of rows of candidates that are not solvers."""

CAREFUL = "cholmod"
"""The solver that represents carefully written C++."""

STEP = 50
"""Number of iterations to which all step times are scaled, whatever their actual number."""

Row = dict[str, Any]


class Limit(NamedTuple):
    """The binding resource, `bandwidth` or `arithmetic`, and the minimum time of some work [s]."""

    binds: str
    seconds: float


class Figures(NamedTuple):
    """One candidate at one size.

    Times are medians over the rounds [ms]; None: not measured or unknown.

    Attributes:
        step: time of STEP iterations.
        entries: number of entries of the factor L.
        touched: bytes per second of an iteration, by the size of the factor's panels.
        binds: resource that binds.
        reached: share of the binding limit that an iteration reaches, by those bytes and flops.
        passes: share of the time that two passes over the entries of L would take, both from the location of
            the working set; a program that uses entries twice while they are in the cache exceeds it.
        faster: of a step, over the C++ baseline.
        careful_faster: of a step, over carefully written C++.
        solves_faster: of a global step.
        apart: distance from the converged positions in float64, relative to the scene's size.
        code, commit: code that the candidate was measured by.
        cpu, cores: machine of the measurement.
    """

    scene: str
    size: int
    vertices: int
    label: str
    threads: int
    status: str
    reason: str | None
    choice: str | None
    iterations: int | None = None
    cold: float | None = None
    warm: float | None = None
    local: float | None = None
    global_: float | None = None
    step: float | None = None
    entries: int | None = None
    bytes: float | None = None
    touched: float | None = None
    binds: str | None = None
    reached: float | None = None
    passes: float | None = None
    faster: Interval | None = None
    cheap_faster: Interval | None = None
    careful_faster: Interval | None = None
    solves_faster: Interval | None = None
    apart: float | None = None
    load: float | None = None
    solver: str = ""
    code: str = ""
    cpu: str = ""
    cores: int | None = None
    commit: str = ""

    @property
    def older(self) -> bool:
        """Whether other code than the current version measured it.

        Rows without a fingerprint count as current.
        """
        return self.code not in ("", machine.code_hash())


class MachineLimits:
    """Measured limits of the machine, from the rounds of one size.

    These are bandwidth by working set, and flops, each by number of threads.
    """

    def __init__(self, rows: Sequence[Row]) -> None:
        best: dict[tuple[int, str], dict[float, float]] = defaultdict(dict)
        for row in rows:
            rate = (row["bytes"] or row["flops"]) / row["seconds"]
            at = best[row["threads"], row["phase"]]
            at[row["working_set"]] = max(rate, at.get(row["working_set"], 0.0))
        self._best = best

    def bandwidth(self, threads: int, working_set: float, kernel: str = "read") -> float:
        """Return the bandwidth for a working set, interpolated on logarithmic scales.

        Args:
            threads: number of threads.
            working_set: size [bytes].
            kernel: name of the microbenchmark.
        Returns: bytes per second.
        """
        at = sorted(self._best[threads, kernel].items())
        known, rates = np.log(np.array(at)).T
        return float(np.exp(cast(float, np.interp(np.log(working_set), known, rates))))

    def flops(self, threads: int, precision: str) -> float:
        """Return flops per second; precisions below float32 compute in float32."""
        kind = "float64" if precision == "float64" else "float32"
        return self._best[threads, f"fma {kind}"][0.0]

    def limit(self, counted: Counted, threads: int, precision: str) -> Limit:
        """Compute the lower bound of the time for any order of access.

        Each byte is loaded once from the location of the working set, and repeated accesses come from the fastest
        cache.
        """
        again = (counted.bytes - counted.working_set) / max(self._best[threads, "read"].values())
        far = counted.working_set / self.bandwidth(threads, counted.working_set)
        return self._binding(far + again, counted, threads, precision)

    def passes(self, counted: Counted, threads: int, precision: str) -> Limit:
        """Compute the time if all moved bytes are loaded from the working set.

        Each access is then as slow as the location of the working set.
        """
        far = counted.bytes / self.bandwidth(threads, counted.working_set)
        return self._binding(far, counted, threads, precision)

    def _binding(self, moving: float, counted: Counted, threads: int, precision: str) -> Limit:
        seconds = {"bandwidth": moving, "arithmetic": counted.flops / self.flops(threads, precision)}
        binds = max(seconds, key=seconds.__getitem__)
        return Limit(binds, seconds[binds])


def figures(table: pa.Table) -> list[Figures]:
    """Compute the figures of all candidates in the rows, in their order.

    They are relative to the machine's own rows.
    """
    runs: dict[str, list[Row]] = defaultdict(list)
    for row in table.to_pylist():
        runs[row["run_id"]].append(row)
    labels = _labels([found[0] for found in runs.values()])
    groups: dict[tuple[str, int], dict[str, list[Row]]] = defaultdict(dict)
    for found in runs.values():
        groups[found[0]["scene"], found[0]["size"]][labels[found[0]["run_id"]]] = found
    out: list[Figures] = []
    for group in groups.values():
        limits = MachineLimits([row for found in group.values() for row in found if row["solver"] == MACHINE])
        for label, found in group.items():
            if found[0]["solver"] != MACHINE:
                out.append(_figures(label, found, group, limits))
    return out


def _labels(firsts: Sequence[Row]) -> dict[str, str]:
    """Label candidates by run id.

    A label has the solver, its varying parameters, and its threads if several.
    """
    values: dict[tuple[str, str], set[str]] = defaultdict(set)
    for row in firsts:
        for key, value in json.loads(row["parameters"]).items():
            values[row["solver"], key].add(str(value))
    return {
        row["run_id"]: " ".join(
            [row["solver"]]
            + [str(v) for key, v in json.loads(row["parameters"]).items() if len(values[row["solver"], key]) > 1]
            + ([f"x{row['threads']}"] if row["threads"] > 1 else [])
        )
        for row in firsts
    }


def _figures(label: str, found: Sequence[Row], group: Mapping[str, list[Row]], limits: MachineLimits) -> Figures:
    first = found[0]
    known = Figures(
        *(first["scene"], first["size"], first["vertices"], label, first["threads"]),
        *(first["status"], first["reason"], first["choice"]),
        solver=first["solver"],
        code=first["code"] or "",
        cpu=first["cpu"] or "",
        cores=first["cores"],
        commit=first["commit"] or "",
    )
    if first["status"] != "ok":
        return known
    times = {phase: _times(found, phase) for phase in ("prepare", "local", "global", "step")}
    known = known._replace(
        iterations=next(row["iterations"] for row in found if row["phase"] == "step"),
        cold=1e3 * times["prepare"][0],
        warm=1e3 * float(np.median(times["prepare"][1:])) if len(times["prepare"]) > 1 else None,
        local=1e3 * float(np.median(times["local"])),
        global_=1e3 * float(np.median(times["global"])),
        step=1e3 * STEP * float(np.median(times["step"])),
        faster=_against(group, f"{YARDSTICK} default", "step", times),
        cheap_faster=_against(group, f"{YARDSTICK} cheap", "step", times),
        careful_faster=_against(group, _on_one(group, lambda row: row["solver"] == CAREFUL), "step", times),
        solves_faster=_against(group, _on_one(group, _by_cholespy), "global", times),
        apart=first["apart"],
        load=max(row["load"] for row in found),
    )
    facts = {name: first[name] for name in ("nnz_factor", "panel_bytes", "flops_per_solve") if first[name] is not None}
    if "nnz_factor" not in facts:
        return known
    precision = json.loads(first["parameters"]).get("precision", "float64")
    counts, how = (first["vertices"], first["springs"], precision), (first["threads"], precision)
    touched = count(facts, *counts)["iteration"]
    bare = count({"nnz_factor": facts["nnz_factor"]}, *counts)["iteration"]
    limit, seconds = limits.limit(touched, *how), float(np.median(times["step"]))
    return known._replace(
        entries=facts["nnz_factor"],
        bytes=touched.bytes,
        touched=touched.bytes / seconds,
        binds=limit.binds,
        reached=limit.seconds / seconds,
        passes=limits.passes(bare, *how).seconds / seconds,
    )


def _times(found: Sequence[Row], phase: str) -> NDArray[np.float64]:
    """Return the seconds of a phase by round; for a step, those of one iteration."""
    return np.array(
        [row["seconds"] / (row["iterations"] if phase == "step" else 1) for row in found if row["phase"] == phase]
    )


def _on_one(group: Mapping[str, list[Row]], those: Callable[[Row], bool]) -> str:
    """Return the label of the single-threaded candidate whose rows satisfy the predicate."""
    return next((label for label, found in group.items() if found[0]["threads"] == 1 and those(found[0])), "")


def _by_cholespy(row: Row) -> bool:
    """Return whether a candidate solves with cholespy."""
    return json.loads(row["parameters"]).get("linear") == "cholespy"


def _against(
    group: Mapping[str, list[Row]], yardstick: str, phase: str, times: Mapping[str, NDArray[np.float64]]
) -> Interval | None:
    """Compute the speedup over a baseline in the same rounds.

    The result is None if the baseline has no times.
    """
    theirs = _times(group.get(yardstick, ()), phase)
    rounds = min(len(theirs), len(times[phase]))
    return ratio(theirs[:rounds], times[phase][:rounds]) if rounds else None

"""What the rows of a speed report say: milliseconds, bytes a second, which limit binds and how near it is, ratios."""

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
"""What rows of candidates that are no solvers have as their solver."""

CAREFUL = "cholmod"
"""The solver that is a careful program in C++."""

STEP = 50
"""Iterations of the step that all steps are stated as, however many were done."""

Row = dict[str, Any]


class Limit(NamedTuple):
    """What binds, `bandwidth` or `arithmetic`, and the seconds that some work takes at least."""

    binds: str
    seconds: float


class Figures(NamedTuple):
    """One candidate at one size. Times [ms]: the median over the rounds; None: not measured or not known.

    step: of STEP iterations; entries: of the factor L; touched: bytes a second of an iteration, by what the
    factor's panels hold; binds: the limit that binds; reached: the part of it that an iteration reaches, by those
    bytes and flops; passes: the part of the time that two passes over the entries of L alone take, both from where
    they lie, which a program that uses entries twice while they are in the cache exceeds; faster: than the yardstick a
    step; careful_faster: than a careful program; solves_faster: than cholespy a global step; apart: from float64's
    converged positions, in the scene's size; code, commit, cpu, cores: by which it was
    measured, and where.
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
        """Whether other code than today's measured it; of rows that do not say by which code nobody can tell."""
        return self.code not in ("", machine.code_hash())


class MachineLimits:
    """The measured limits of one size's turns: bandwidth by working set, and flops, by number of threads."""

    def __init__(self, rows: Sequence[Row]) -> None:
        best: dict[tuple[int, str], dict[float, float]] = defaultdict(dict)
        for row in rows:
            rate = (row["bytes"] or row["flops"]) / row["seconds"]
            at = best[row["threads"], row["phase"]]
            at[row["working_set"]] = max(rate, at.get(row["working_set"], 0.0))
        self._best = best

    def bandwidth(self, threads: int, working_set: float, kernel: str = "read") -> float:
        """Bytes a second from a working set [bytes], between the measured ones by logarithms."""
        at = sorted(self._best[threads, kernel].items())
        known, rates = np.log(np.array(at)).T
        return float(np.exp(cast(float, np.interp(np.log(working_set), known, rates))))

    def flops(self, threads: int, precision: str) -> float:
        """Flops a second; below float32 there is no arithmetic."""
        kind = "float64" if precision == "float64" else "float32"
        return self._best[threads, f"fma {kind}"][0.0]

    def limit(self, counted: Counted, threads: int, precision: str) -> Limit:
        """What no order of reading goes below: each byte comes once from where the working set lies, and as often as
        it is moved besides from the nearest cache."""
        again = (counted.bytes - counted.working_set) / max(self._best[threads, "read"].values())
        far = counted.working_set / self.bandwidth(threads, counted.working_set)
        return self._binding(far + again, counted, threads, precision)

    def passes(self, counted: Counted, threads: int, precision: str) -> Limit:
        """The same where all that is moved comes from where the working set lies, each time."""
        far = counted.bytes / self.bandwidth(threads, counted.working_set)
        return self._binding(far, counted, threads, precision)

    def _binding(self, moving: float, counted: Counted, threads: int, precision: str) -> Limit:
        seconds = {"bandwidth": moving, "arithmetic": counted.flops / self.flops(threads, precision)}
        binds = max(seconds, key=seconds.__getitem__)
        return Limit(binds, seconds[binds])


def figures(table: pa.Table) -> list[Figures]:
    """The figures of all candidates in the rows, in their order; the machine's own rows are what they refer to."""
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
    """By run id, the solver with those of its parameters that vary, and its threads where there are several."""
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
    """The seconds of a phase by round; of a step, an iteration's."""
    return np.array(
        [row["seconds"] / (row["iterations"] if phase == "step" else 1) for row in found if row["phase"] == phase]
    )


def _on_one(group: Mapping[str, list[Row]], those: Callable[[Row], bool]) -> str:
    """The label of the candidate of those rows that ran on one thread."""
    return next((label for label, found in group.items() if found[0]["threads"] == 1 and those(found[0])), "")


def _by_cholespy(row: Row) -> bool:
    """Whether a candidate solves with cholespy."""
    return json.loads(row["parameters"]).get("linear") == "cholespy"


def _against(
    group: Mapping[str, list[Row]], yardstick: str, phase: str, times: Mapping[str, NDArray[np.float64]]
) -> Interval | None:
    """How many times faster than a yardstick in the same rounds; None where that has no times."""
    theirs = _times(group.get(yardstick, ()), phase)
    rounds = min(len(theirs), len(times[phase]))
    return ratio(theirs[:rounds], times[phase][:rounds]) if rounds else None

"""Comparison of repeated runs with published ones: outcome, iterations, residuals, and ratios of times.

A run whose columns are bitwise equal is `IDENTICAL`. It is `CLOSE` if its outcome is the same and its iterations and
residuals are within the tolerances below, and `DIFFERENT` otherwise. Absolute times are never compared. A ratio of
times that the load of a machine disturbed is `UNDECIDED`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple

from springbench.harness.results import parquet_rows
from springbench.harness.results.published_set import RUN_KEYS
from springbench.harness.results.time_ratios import MAX_PREEMPTED_SHARE, MethodTimes, compute_time_ratios

ITERATION_TOLERANCE, ITERATION_SLACK = 0.1, 3
"""Largest relative and absolute difference of a step's iterations: near round-off a few of them are arbitrary."""
RESIDUAL_FACTOR = 2.0
"""Largest factor between the residuals of two solves that did not converge; round-off affects these, too."""
MAX_DIFFERING_SHARE = 0.02
"""Largest share of runs that may differ between processors.

Where a step has two possible outcomes, the last bit decides. Between an EPYC and a Xeon, one run in a thousand of the
hard cases differed. A quick reproduction repeats only a tenth of the runs, so two per cent are allowed.
"""

CURVE_LEVELS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
"""Stationarities at which the iterations of a convergence curve are compared."""

RunRows = Sequence[Mapping[str, Any]]


class AgreementLevel(Enum):
    """How well a repeated run agrees with the published one."""

    IDENTICAL = "identical"
    CLOSE = "within tolerance"
    UNDECIDED = "undecided"
    DIFFERENT = "differs"


class RunAgreement(NamedTuple):
    """A repeated run, how well it agrees, and where it differs."""

    title: str
    level: AgreementLevel
    explanation: str = ""


def group_runs(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Group the rows with results of runs by `RUN_KEYS` and the number of frames.

    Each run is sorted by frame (`springbench.harness.results.parquet_rows.group_result_rows`).
    """
    runs = parquet_rows.group_result_rows(rows).values()
    return {build_run_key(run): sorted(run, key=lambda row: row["frame"] or 0) for run in runs}


def build_run_key(run: RunRows) -> tuple[Any, ...]:
    """Build the key that identifies a run on any machine.

    It consists of the values of `RUN_KEYS`, and the number of frames of a completed run.
    """
    frames = max(row["frame"] or 0 for row in run) if run[0]["status"] == "ok" else 0
    return (*(run[0][name] for name in RUN_KEYS), frames)


def compare_repeated_run(
    published: RunRows, repeated: RunRows, classify_outcome: Callable[[RunRows], str]
) -> RunAgreement:
    """Compare a repeated run with the published one.

    Args:
        published, repeated: rows of the first round, sorted by frame.
        classify_outcome: returns the outcome of a run in words.
    """
    first = published[0]
    title = " ".join(str(part) for part in (first["scene"], first["size"] or "", first["solver"]) if part)
    was, now = classify_outcome(published), classify_outcome(repeated)
    if was != now:
        return RunAgreement(title, AgreementLevel.DIFFERENT, f"published as {was!r}, here {now!r}")
    if len(published) != len(repeated):
        return RunAgreement(title, AgreementLevel.DIFFERENT, f"{len(published)} steps, here {len(repeated)}")
    if all(_is_identical(old, new) for old, new in zip(published, repeated, strict=True)):
        return RunAgreement(title, AgreementLevel.IDENTICAL)
    for old, new in zip(published, repeated, strict=True):
        if why := _describe_difference(old, new):
            return RunAgreement(title, AgreementLevel.DIFFERENT, why)
    return RunAgreement(title, AgreementLevel.CLOSE)


_COMPARED_COLUMNS = ("num_iterations", "termination_reason", "residual", "residual_initial", "stationarity")


def _is_identical(old: Mapping[str, Any], new: Mapping[str, Any]) -> bool:
    return all(_is_same_value(old.get(name), new.get(name)) for name in _COMPARED_COLUMNS)


def _is_same_value(old: Any, new: Any) -> bool:
    return old == new or (isinstance(old, float) and isinstance(new, float) and math.isnan(old) and math.isnan(new))


def _describe_difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Describe the difference of two steps beyond the tolerances; empty if there is none."""
    was, now = old["num_iterations"], new["num_iterations"]
    if was is not None and now is not None and abs(now - was) > max(ITERATION_SLACK, ITERATION_TOLERANCE * was):
        return f"step {old['frame']} took {was} iterations, here {now}"
    was, now = old["residual"], new["residual"]
    if was is None or now is None or _meets_tolerance(old) or _meets_tolerance(new):
        return ""
    if not was / RESIDUAL_FACTOR <= now <= was * RESIDUAL_FACTOR:
        return f"step {old['frame']} left a residual of {was:.2g}, here {now:.2g}"
    return ""


def _meets_tolerance(row: Mapping[str, Any]) -> bool:
    return row["termination_reason"] in ("converged", "roundoff")


CURVE_KEYS = (
    "scene",
    "size",
    "snapshot",
    "initial_guess",
    "solver",
    "parameters",
    "integrator",
    "time_step",
    "threads",
)
"""Columns that identify a convergence curve on any machine."""


def group_curves(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Group the rows of convergence curves by `CURVE_KEYS`; other rows are omitted."""
    curves: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["kind"] == "curve":
            curves.setdefault(tuple(row.get(name) for name in CURVE_KEYS), []).append(row)
    return curves


def compare_repeated_curve(published: RunRows, repeated: RunRows) -> RunAgreement:
    """Compare the convergence of a solver on a step snapshot with the published one.

    A curve is close if it reaches each of `CURVE_LEVELS` after as many iterations, within the tolerances and one
    sample. Levels that a curve did not reach before its time limit are not compared, because they depend on the
    machine.

    Args:
        published: rows of the published curve, at least one.
        repeated: rows of the same curve in the repetition, at least one.
    """
    first = published[0]
    title = f"{first['scene']} {first['size']} {first['snapshot']} {first['solver']}"
    statuses = first["status"], repeated[0]["status"]
    if statuses[0] != statuses[1] and "time-limit" not in statuses:
        why = f"published as {statuses[0]!r}, here {statuses[1]!r}"
        return RunAgreement(title, AgreementLevel.DIFFERENT, why)
    old, new = _read_curve(published), _read_curve(repeated)
    if old == new:
        return RunAgreement(title, AgreementLevel.IDENTICAL)
    lowest = [min(curve.values(), default=math.inf) for curve in (old, new)]
    for level in CURVE_LEVELS:
        if any(level / RESIDUAL_FACTOR <= end <= level * RESIDUAL_FACTOR for end in lowest):
            continue  # round-off decides whether such a curve reaches the level
        (was, sample), (now, _) = (_find_first_iteration(curve, level) for curve in (old, new))
        if "time-limit" in statuses and math.inf in (was, now):
            continue
        if was != now and abs(now - was) > max(ITERATION_SLACK, ITERATION_TOLERANCE * min(was, now), sample):
            why = f"a stationarity of {level:g} took {was:g} iterations, here {now:g}"
            return RunAgreement(title, AgreementLevel.DIFFERENT, why)
    return RunAgreement(title, AgreementLevel.CLOSE)


def _read_curve(rows: RunRows) -> dict[int, float]:
    """Return the stationarity by iteration, in ascending order."""
    known = {row["iteration"]: row["stationarity"] for row in rows}
    return {k: known[k] for k in sorted(k for k, value in known.items() if k is not None and value is not None)}


def _find_first_iteration(curve: Mapping[int, float], level: float) -> tuple[float, float]:
    """Find the first iteration at or below `level`, and its distance to the previous sample.

    The iteration is infinite if the curve does not reach the level.
    """
    before = 0
    for iteration, stationarity in curve.items():
        if stationarity <= level:
            return iteration, iteration - before
        before = iteration
    return math.inf, 0.0


def compare_time_ratios(published: Sequence[MethodTimes], repeated: Sequence[MethodTimes]) -> list[RunAgreement]:
    """Compare the ratios of times to a reference method that both sides have.

    A ratio is close within the accepted interval of the published one. Outside that interval it is undecided in three
    cases: the load of a machine delayed one of its times, or more than MAX_PREEMPTED_SHARE of all times, or its own
    interval overlaps the accepted one. A busy machine also slows what it does not interrupt.

    Args:
        published: times of the published study.
        repeated: times of its repetition.

    Returns:
        The outcomes, one for each ratio that both sides have.
    """
    common = {(one.task, one.method) for one in published} & {(one.task, one.method) for one in repeated}
    before, after = (
        {(one.task, one.method, one.reference): one for one in compute_time_ratios(side)}
        for side in ([one for one in times if (one.task, one.method) in common] for times in (published, repeated))
    )
    delayed = sum(one.is_preempted for one in repeated)
    found: list[RunAgreement] = []
    for key, new in after.items():
        if old := before.get(key):
            low, high = old.accepted_interval
            why = f"{old.ratio:.3g} published, in [{low:.3g}, {high:.3g}]; here {new.ratio:.3g}"
            level = AgreementLevel.DIFFERENT
            if low <= new.ratio <= high:
                level = AgreementLevel.CLOSE
            elif old.is_preempted or new.is_preempted:
                level, why = AgreementLevel.UNDECIDED, f"{why}; other processes interrupted it"
            elif delayed > MAX_PREEMPTED_SHARE * len(repeated):
                why += f"; other processes interrupted {delayed} of {len(repeated)} times"
                level = AgreementLevel.UNDECIDED
            elif new.low <= high and new.high >= low:
                level, why = AgreementLevel.UNDECIDED, f"{why}, [{new.low:.3g}, {new.high:.3g}] over its rounds"
            found.append(RunAgreement(new.title, level, why))
    return found

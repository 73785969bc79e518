"""Reader of the rows of an accuracy measurement, as objects of `springbench.harness.report.accuracy.accuracy_data`."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.accuracy.accuracy_data import (
    AccuracyData,
    ConvergenceCurve,
    FloatArray,
    SnapshotProblem,
    WorkPoint,
)
from springbench.harness.report.provenance_words import describe_commits, describe_processors
from springbench.harness.report.varying_settings import find_varying_by_solver
from springbench.harness.results import row_store
from springbench.harness.results.parquet_rows import read_rows

ROUNDOFF_FACTOR = 100 * float(np.finfo(np.float64).eps)
"""Energy difference, relative to the terms' magnitude, beyond which a value below g* is a lower minimum.

Smaller differences are round-off: sums of up to 1e5 terms have errors of some tens of eps.
"""

LIU2013_SWEEP = "liu2013"
"""The config that reproduces Liu et al. 2013; its g0 is taken at the inertial target."""

_ResultRow = dict[str, Any]
_RowLabeller = Callable[[_ResultRow], str]


def read_accuracy(
    folder: Path, files: Iterable[Path] | None = None, on_invalid: Callable[[InputMistake], None] | None = None
) -> AccuracyData:
    """Read the rows of an accuracy measurement.

    Args:
        folder: folder of the results.
        files: files of rows; None for all under `folder`/accuracy.
        on_invalid: called for each unit with an invalid value, which is then omitted.

    Raises:
        InputError: if there are no rows.
    """
    units = row_store.list_units(folder / "accuracy") if files is None else sorted(files)
    if not units:
        raise InputError(InputMistake("contains no accuracy rows; run `springbench accuracy CONFIG` first", folder))
    kinds: dict[str, list[_ResultRow]] = defaultdict(list)
    # Columns that older rows and published ones do not have.
    missing = dict.fromkeys(
        (
            *("family", "citation", "is_minimiser", "is_substepping", "source_fingerprint", "started_at", "commit"),
            *("recording_path", "reason", "preempted", "cold_seconds", "minimum_index", "minimum_id"),
        )
    )
    table = read_rows(units, pa.schema([]), required_columns=("kind",), promote="permissive", on_invalid=on_invalid)
    for row in table.to_pylist():
        kinds[row["kind"]].append(missing | row)
    for rows in kinds.values():  # files are sorted by name, size 122 before size 22
        rows.sort(key=lambda row: (row["scene"], row["size"]))
    label = _build_row_labeller(kinds["curve"] + kinds["work"])
    problems = _build_snapshots(kinds, folder.name)
    return AccuracyData(
        tuple(problems.values()),
        tuple(_build_curves(kinds, problems, label)),
        tuple(_build_work_point(row, label) for row in kinds["work"]),
        _describe_machine(kinds["curve"] + kinds["work"]),
        max(
            ((row["started_at"] or "", row["source_fingerprint"] or "") for row in kinds["curve"] + kinds["work"]),
            default=("", ""),
        )[1],
    )


def _build_snapshots(kinds: dict[str, list[_ResultRow]], study: str) -> dict[str, SnapshotProblem]:
    """Build the snapshots by digest.

    An energy below all certified minima shows that they are not the lowest. Rows of a published study state no sweep.
    """
    lowest: dict[str, float] = {}
    for row in kinds["curve"]:
        if row["objective"] is not None and row["objective"] < lowest.get(row["problem_digest"], np.inf):
            lowest[row["problem_digest"]] = row["objective"]
    minima: dict[str, list[_ResultRow]] = defaultdict(list)
    for row in kinds["minimum"]:
        if row["objective"] is not None:
            minima[row["problem_digest"]].append(row)
    found: dict[str, SnapshotProblem] = {}
    for row in kinds["snapshot"]:
        digest = row["problem_digest"]
        if digest is None or row["objective_initial"] is None:
            continue
        known = sorted(minima[digest], key=lambda m: m["objective"])
        energies, names = [m["objective"] for m in known], [m["minimum_id"] for m in known]
        noise = ROUNDOFF_FACTOR * (row["objective_magnitude"] or 0.0)
        doubt = "" if known and known[0]["is_certified"] else "the lowest known minimum is not certified"
        seen = lowest.get(digest, np.inf)
        if not known:
            doubt = "no minimum is known; gaps refer to the lowest energy that a solver reached"
        elif seen < energies[0] - noise:
            doubt = "a solver's energy is below the lowest certified minimum; gaps refer to that energy"
        if doubt and seen < (energies or [np.inf])[0] - noise:
            energies.insert(0, seen)
            names.insert(0, "")
        paper = row.get("sweep", study) == LIU2013_SWEEP
        found[digest] = SnapshotProblem(
            scene=row["scene"],
            size=row["size"],
            vertices=row["vertices"],
            snapshot=row["snapshot"],
            integrator=row["integrator"],
            time_step=row["time_step"],
            stiffness_ratio=_float_or_nan(row["stiffness_ratio"]),
            mean_rest_length=_float_or_nan(row["mean_rest_length"]),
            objective_magnitude=_float_or_nan(row["objective_magnitude"]),
            problem_digest=digest,
            frame=row["frame"] or 0,
            objective_initial=_float_or_nan(row["objective_inertial" if paper else "objective_initial"]),
            minima=tuple(energies),
            minimum_ids=tuple(names),
            uncertified_reason=doubt,
            is_liu2013=paper,
        )
    return found


_SOLVE_COLUMNS = ("problem_digest", "solver", "parameters", "threads")


def _build_curves(
    kinds: dict[str, list[_ResultRow]], problems: dict[str, SnapshotProblem], label: _RowLabeller
) -> Iterable[ConvergenceCurve]:
    prepared = {tuple(row[key] for key in _SOLVE_COLUMNS): row for row in kinds["prepare"]}
    groups: dict[tuple[Any, ...], list[_ResultRow]] = defaultdict(list)
    for row in kinds["curve"]:
        groups[*(row[key] for key in _SOLVE_COLUMNS), row["initial_guess"]].append(row)
    for key, rows in groups.items():
        problem = problems.get(key[0])
        if problem is not None:
            yield _build_curve(problem, rows, prepared.get(key[:-1], {}), label(rows[0]))


def _build_curve(
    problem: SnapshotProblem, rows: Sequence[_ResultRow], prepared: _ResultRow, label: str
) -> ConvergenceCurve:
    points = sorted((row for row in rows if row["iteration"] is not None), key=lambda row: row["iteration"])
    bad = next((row for row in rows if row["status"] != "ok"), rows[0])

    def column(name: str) -> FloatArray:
        return np.array([_float_or_nan(row[name]) for row in points], float)

    rounds = min((len(row["seconds"] or ()) for row in points), default=0)
    seconds = np.array([row["seconds"][:rounds] for row in points], float).reshape(len(points), rounds).T
    warm = prepared.get("seconds") or [np.nan]
    return ConvergenceCurve(
        problem=problem,
        solver=rows[0]["solver"],
        family=rows[0]["family"] or "",
        citation=rows[0]["citation"] or "",
        label=label,
        parameters=rows[0]["parameters"] or "{}",
        initial_guess=rows[0]["initial_guess"] or "",
        threads=rows[0]["threads"] or 1,
        iterations=column("iteration"),
        gap=problem.compute_gap(column("objective")),
        max_vertex_error=column("position_error_max_m") / problem.mean_rest_length,
        stationarity=column("stationarity"),
        seconds=seconds if rounds else np.full((1, len(points)), np.nan),
        warm_seconds=float(np.median(warm)),
        cold_seconds=_float_or_nan(prepared.get("cold_seconds")),
        minimum_index=problem.minimum_index(rows[0]["minimum_id"]) if rows[0]["minimum_index"] is not None else None,
        status=bad["status"],
        reason=bad["reason"] or "",
        is_preempted=any(row["preempted"] for row in rows),
        recording_path=next((row["recording_path"] for row in rows if row["recording_path"]), ""),
        source_fingerprint=rows[0]["source_fingerprint"] or "",
    )


def _build_work_point(row: _ResultRow, label: _RowLabeller) -> WorkPoint:
    same_names = ("scene", "size", "solver", "parameters", "integrator", "time_step", "status")
    return WorkPoint(
        **{name: row[name] for name in same_names},
        residual_rtol=row["residual_rtol"],
        max_iterations=row["max_iterations"],
        initial_guess=row["initial_guess"],
        family=row["family"] or "",
        citation=row["citation"] or "",
        is_minimiser=row["is_minimiser"] is not False,
        is_substepping=bool(row["is_substepping"]),
        label=label(row),
        t_end=_float_or_nan(row["t_end"]),
        error=_float_or_nan(row["error"]),
        reference_kind=row["reference_kind"] or "",
        seconds_per_simulated_second=_float_or_nan(row["seconds_per_simulated_second"]),
        cpu_seconds_per_simulated_second=_float_or_nan(row["cpu_seconds"]) / _float_or_nan(row["t_end"]),
        round_seconds=tuple(row["seconds"] or ()),
        is_preempted=bool(row["preempted"]),
        vertices=row["vertices"] or 0,
        stiffness=_float_or_nan(row["stiffness_ratio"]) / row["time_step"] ** 2,
        reason=row["reason"] or "",
        source_fingerprint=row["source_fingerprint"] or "",
    )


def _build_row_labeller(rows: Sequence[_ResultRow]) -> _RowLabeller:
    """Return a function that labels a row by its solver and varying settings.

    These are the parameters and threads in which the solver's rows differ.
    """

    def settings(row: _ResultRow) -> _ResultRow:
        return {**json.loads(row["parameters"] or "{}"), "threads": row["threads"]}

    varying = find_varying_by_solver((row["solver"], settings(row)) for row in rows)

    def label(row: _ResultRow) -> str:
        shown = [f"{key} {value}" for key, value in settings(row).items() if key in varying[row["solver"]]]
        return ", ".join([row["solver"], *shown])

    return label


def _describe_machine(rows: Sequence[_ResultRow]) -> tuple[str, ...]:
    threads = sorted({row["threads"] for row in rows if row["threads"] is not None})
    count = [f"{', '.join(map(str, threads))} thread{'s' if threads != [1] else ''}"] if threads else []
    return (*describe_processors(row["cpu"] for row in rows), *count, *describe_commits(row["commit"] for row in rows))


def _float_or_nan(value: Any) -> float:
    return np.nan if value is None else float(value)

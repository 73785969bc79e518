"""Reader of the rows of an accuracy measurement, as objects of `harness.report.accuracy.measured`."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from harness.base import shelf
from harness.base.errors import InputError, Mistake
from harness.base.rows import read as read_rows
from harness.report.accuracy.measured import Curve, Measurements, Problem, Values, WorkPoint
from harness.report.origin import commits, processors

ROUND_OFF = 100 * float(np.finfo(np.float64).eps)
"""Energy difference, relative to the terms' magnitude, beyond which a value below g* is a lower minimum.

Smaller differences are round-off: sums of up to 1e5 terms have errors of some tens of eps.
"""

PAPER = "liu2013"
"""The config that reproduces Liu et al. 2013; its g0 is taken at the inertial target."""

_Row = dict[str, Any]
_Label = Callable[[_Row], str]


def read(
    folder: Path, files: Iterable[Path] | None = None, left_out: Callable[[Mistake], None] | None = None
) -> Measurements:
    """Read the rows of an accuracy measurement.

    Args:
        folder: folder of the results.
        files: files of rows; None for all under `folder`/accuracy.
        left_out: called for each invalid unit, see `harness.base.rows.read_rows`.
    Raises:
        InputError: if there are no rows.
    """
    units = shelf.units(folder / "accuracy") if files is None else sorted(files)
    if not units:
        raise InputError(Mistake("holds no accuracy rows; run `springbench accuracy CONFIG` first", folder))
    kinds: dict[str, list[_Row]] = defaultdict(list)
    # Columns that older rows do not have.
    missing = dict.fromkeys(("family", "reference", "minimises", "own_steps", "code", "started", "commit"))
    table = read_rows(units, pa.schema([]), needed=("kind",), promote="permissive", left_out=left_out)
    for row in table.to_pylist():
        kinds[row["kind"]].append(missing | row)
    for rows in kinds.values():  # files come by their names, 122 before 22
        rows.sort(key=lambda row: (row["scene"], row["size"]))
    label = _labels(kinds["curve"] + kinds["work"])
    problems = _problems(kinds)
    return Measurements(
        tuple(problems.values()),
        tuple(_curves(kinds, problems, label)),
        tuple(_work(row, label) for row in kinds["work"]),
        _machine(kinds["curve"] + kinds["work"]),
        max(((row["started"] or "", row["code"] or "") for row in kinds["curve"] + kinds["work"]), default=("", ""))[1],
    )


def _problems(kinds: dict[str, list[_Row]]) -> dict[str, Problem]:
    """Build the snapshots by digest.

    An energy below all certified minima shows that they are not the lowest.
    """
    lowest: dict[str, float] = {}
    for row in kinds["curve"]:
        if row["g"] is not None and row["g"] < lowest.get(row["problem"], np.inf):
            lowest[row["problem"]] = row["g"]
    minima: dict[str, list[_Row]] = defaultdict(list)
    for row in kinds["minimum"]:
        if row["g"] is not None:
            minima[row["problem"]].append(row)
    found: dict[str, Problem] = {}
    for row in kinds["problem"]:
        digest = row["problem"]
        if digest is None or row["g0"] is None:
            continue
        known = sorted(minima[digest], key=lambda m: m["g"])
        energies, names = [m["g"] for m in known], [m["minimum"] for m in known]
        noise = ROUND_OFF * (row["magnitude"] or 0.0)
        doubt = "" if known and known[0]["certified"] else "the lowest known minimum is not certified"
        seen = lowest.get(digest, np.inf)
        if not known:
            doubt = "no minimum is known; gaps refer to the lowest energy that a solver reached"
        elif seen < energies[0] - noise:
            doubt = "a solver went below the lowest minimum that is certified; gaps refer to what it reached"
        if doubt and seen < (energies or [np.inf])[0] - noise:
            energies.insert(0, seen)
            names.insert(0, "")
        paper = row["sweep"] == PAPER
        found[digest] = Problem(
            scene=row["scene"],
            size=row["size"],
            vertices=row["vertices"],
            moment=row["moment"],
            integrator=row["integrator"],
            time_step=row["time_step"],
            stiffness_ratio=_number(row["stiffness_ratio"]),
            mean_rest_length=_number(row["mean_rest_length"]),
            magnitude=_number(row["magnitude"]),
            digest=digest,
            frame=row["frame"] or 0,
            g0=_number(row["g0_inertial" if paper else "g0"]),
            minima=tuple(energies),
            names=tuple(names),
            doubt=doubt,
            paper=paper,
        )
    return found


_WHO = ("problem", "solver", "parameters", "threads")


def _curves(kinds: dict[str, list[_Row]], problems: dict[str, Problem], label: _Label) -> Iterable[Curve]:
    prepared = {tuple(row[key] for key in _WHO): row for row in kinds["prepare"]}
    groups: dict[tuple[Any, ...], list[_Row]] = defaultdict(list)
    for row in kinds["curve"]:
        groups[*(row[key] for key in _WHO), row["first_guess"]].append(row)
    for key, rows in groups.items():
        problem = problems.get(key[0])
        if problem is not None:
            yield _curve(problem, rows, prepared.get(key[:-1], {}), label(rows[0]))


def _curve(problem: Problem, rows: Sequence[_Row], prepared: _Row, label: str) -> Curve:
    points = sorted((row for row in rows if row["iteration"] is not None), key=lambda row: row["iteration"])
    bad = next((row for row in rows if row["status"] != "ok"), rows[0])

    def column(name: str) -> Values:
        return np.array([_number(row[name]) for row in points], float)

    rounds = min((len(row["seconds"] or ()) for row in points), default=0)
    seconds = np.array([row["seconds"][:rounds] for row in points], float).reshape(len(points), rounds).T
    warm = prepared.get("seconds") or [np.nan]
    return Curve(
        problem=problem,
        solver=rows[0]["solver"],
        family=rows[0]["family"] or "",
        reference=rows[0]["reference"] or "",
        label=label,
        parameters=rows[0]["parameters"] or "{}",
        first_guess=rows[0]["first_guess"] or "",
        threads=rows[0]["threads"] or 1,
        iterations=column("iteration"),
        gap=problem.gap(column("g")),
        largest=column("largest_error") / problem.mean_rest_length,
        stationarity=column("stationarity"),
        seconds=seconds if rounds else np.full((1, len(points)), np.nan),
        warm=float(np.median(warm)),
        cold=_number(prepared.get("cold")),
        branch=problem.branch(rows[0]["minimum"]) if rows[0]["branch"] is not None else None,
        status=bad["status"],
        reason=bad["reason"] or "",
        recording=next((row["recording"] for row in rows if row["recording"]), ""),
        code=rows[0]["code"] or "",
    )


def _work(row: _Row, label: _Label) -> WorkPoint:
    names = ("scene", "size", "solver", "parameters", "integrator", "time_step", "tolerance", "iterations")
    return WorkPoint(
        **{name: row[name] for name in (*names, "first_guess", "status")},
        family=row["family"] or "",
        reference=row["reference"] or "",
        minimises=row["minimises"] is not False,
        own_steps=bool(row["own_steps"]),
        label=label(row),
        horizon=_number(row["horizon"]),
        error=_number(row["error"]),
        truth=row["truth"] or "",
        error_rms=_number(row["error_rms_m"]),
        seconds=_number(row["seconds_per_simulated"]),
        cpu=_number(row["cpu_seconds"]) / _number(row["horizon"]),
        vertices=row["vertices"] or 0,
        stiffness=_number(row["stiffness_ratio"]) / row["time_step"] ** 2,
        reason=row["reason"] or "",
        code=row["code"] or "",
    )


def _labels(rows: Sequence[_Row]) -> _Label:
    """Return a function that labels a row by its solver and varying settings.

    These are the parameters and threads in which the solver's rows differ.
    """
    values: dict[tuple[str, str], set[str]] = defaultdict(set)

    def settings(row: _Row) -> _Row:
        return {**json.loads(row["parameters"] or "{}"), "threads": row["threads"]}

    stated: dict[str, set[str]] = defaultdict(set)
    for row in rows:
        stated[row["solver"]] |= settings(row).keys()
    for row in rows:
        own = settings(row)
        for key in stated[row["solver"]]:  # some state what others leave out, for they have it as usual
            values[row["solver"], key].add(str(own.get(key)))

    def label(row: _Row) -> str:
        told = [f"{key} {value}" for key, value in settings(row).items() if len(values[row["solver"], key]) > 1]
        return ", ".join([row["solver"], *told])

    return label


def _machine(rows: Sequence[_Row]) -> tuple[str, ...]:
    threads = sorted({row["threads"] for row in rows if row["threads"] is not None})
    count = [f"{', '.join(map(str, threads))} thread{'s' if threads != [1] else ''}"] if threads else []
    return (*processors(row["cpu"] for row in rows), *count, *commits(row["commit"] for row in rows))


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)

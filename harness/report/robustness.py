"""Robustness of solvers: the outcome of each verified run of a sweep.

Outcomes follow from the rows only. A run of a minimising solver is correct if, in every step, the result is stationary
to the requested tolerance, up to round-off at each vertex, and a certified minimum, and if the motion matches the
reference in every frame. All three are checked by the reference evaluator, never by the solver's own report. That
report is compared: if a step ended because its residual met the tolerance, but the evaluator finds it not stationary,
the run is falsely converged instead of merely unconverged. A method that does not minimise is scored by its motion
only. If the independent implementation of the formulas disagrees with the steps themselves, no run of them is correct.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from harness.base import rows, shelf
from harness.base.errors import InputError
from harness.config.options import OPTIONS
from solvers.registry import OPTIONAL, SOLVERS

SLACK = 1.1
"""Factor on the tolerance, because the reference evaluator and a solver factorise the same matrix differently.

Of 1372 runs of configs/hard none changes its outcome at 1.0, and 8 become correct at 2.2. All 7902 steps that their
solver reported as converged were converged.
"""
ASKED = 1e-6
"""Tolerance that scores a run for which none was requested."""
SAME = 1e-2
"""Share of the rest shape's size: a motion within this distance of the reference counts as the same.

Steps are solved to 1e-6 of their displacement, and instability amplifies that error. The limit lies in a gap: of 670
runs of configs/hard that end at minima, 595 stay within 0.5 % and 71 deviate by more than 2 %. Half the limit would
remove 2 of the correct runs, twice the limit would add 2.
"""
CLOSE = 0.05
"""Share of the rest shape's size: required distance of a method that does not minimise, roughly what is visible.

A convention: of its 240 runs of configs/hard, 97 are within it, 73 within half of it and 104 within twice.
"""


class Outcome(NamedTuple):
    """The outcome of a run: label, colour and description."""

    words: str
    color: str
    meaning: str


RIGHT = Outcome("right", "#3a9e72", "stationary to the tolerance, a certified minimum, and the motion of the reference")
OTHER = Outcome(
    "another minimum", "#8fcbad", "a certified minimum in every step, and another motion than the reference, or none"
)
VALLEY = Outcome(
    "in a valley", "#c9c27a", "stationary, where some curvature cannot be told from zero: minima that are a continuum"
)
SADDLE = Outcome("no minimum", "#b9a3d6", "stationary, but where the objective falls some way: a saddle")
SHORT = Outcome("not converged", "#f2c45f", "finite, and not yet stationary, or not close to the reference")
WRONG = Outcome("silently wrong", "#e0683c", "said of a step that it had converged, which the oracle finds untrue")
DIVERGED = Outcome("diverged", "#d1495b", "not finite any more, or far beyond the energy of its scene")
GROWN = Outcome("energy growth", "#c98ba6", "finite, with more energy than the scene can have given it")
LATE = Outcome("too slow", "#7b7f87", "did not end within its time limit")
FAILED = Outcome("failed", "#23262b", "ended with an error")
DISPUTED = Outcome("disputed", "#8a6d4b", "the second opinion finds the formulas of the steps themselves wrong")
REFUSED = Outcome("refused", "#d9d9d6", "refused before it began, with a reason")
OUTCOMES = (RIGHT, OTHER, VALLEY, SADDLE, SHORT, WRONG, GROWN, DIVERGED, LATE, FAILED, DISPUTED, REFUSED)

_CLAIMS = ("tolerance", "floor")
"""Termination reasons with which a solver claims convergence."""
_ENDED = {
    "time-limit": LATE,
    "unsupported": REFUSED,
    "diverged": DIVERGED,
    "energy-growth": GROWN,
    "failed": FAILED,
    "killed": FAILED,
    "disputed": DISPUTED,
}

_WHOLE = ("disputed", "energy-growth")
"""Statuses of runs that were completed and have a row for each step."""


@dataclass(frozen=True, slots=True)
class Judged:
    """The outcome of one verified run.

    Attributes:
        case: scene, with the options in which its runs differ.
        solver: solver, with the parameters in which its runs differ.
        outcome: outcome of the run.
        worst: largest `beyond` of a step, or, if `graded` is "distance", the largest distance from the
            reference; None if unknown.
        graded: "stationarity" or "distance".
        reason: why the run is not correct.
        reference: reference of the solver as in the rows.
        run_id: id of the run.
        cpu: processor that executed the run.
        commit: version of the code that executed the run.
        name: name of the solver without its parameters; it may contain spaces.
    """

    case: str
    solver: str
    outcome: Outcome
    worst: float | None
    graded: str
    reason: str
    reference: str = ""
    run_id: str = ""
    cpu: str = ""
    commit: str = ""
    name: str = ""

    @property
    def figure(self) -> str:
        """The worst error: a power of ten, or a percentage of the scene's size."""
        if self.worst is None:
            return ""
        if self.graded == "distance":
            return f"{100 * self.worst:.0f} %" if self.worst < 9.99 else ">999 %"
        if not math.isfinite(self.worst):
            return str(self.worst)
        return "0" if self.worst == 0.0 else f"1e{round(math.log10(self.worst))}"


def read_cells(folder: Path) -> list[Judged]:
    """Read the outcomes of the runs in a sweep's folder.

    They are ordered by case and solver; of repeated runs the newest counts. Units with invalid values are omitted; the
    results page lists them.

    Raises:
        InputError: if no run was verified.
    """
    files = shelf.units(folder / "rows")
    needed = "run_id", "scene", "size", "solver", "phase", "status", "started"
    table = rows.read(files, needed=needed, left_out=lambda mistake: None).to_pylist()
    runs: dict[str, list[dict[str, Any]]] = {}
    for row in table:
        if row["phase"] == "run" or (row["phase"] == "step" and row["round"] == 0):
            runs.setdefault(row["run_id"], []).append(row)
    if not any(row["stationarity"] is not None or row["distance"] is not None for row in table):
        raise InputError(f"{folder}: holds no runs that were judged; run a sweep with `judge: true`")
    if any(row["stationarity"] is not None and row["beyond"] is None for row in table):
        raise InputError(f"{folder}: holds runs that another version judged; run the sweep again")
    firsts = [run[0] for run in runs.values()]
    cells: dict[tuple[str, str], Judged] = {}
    for run in sorted(runs.values(), key=lambda run: run[0]["started"]):
        case, solver = _case(run[0], firsts), _solver(run[0], firsts)
        outcome, worst, graded, reason = judged(run)
        run_id, reference = run[0]["run_id"], run[0]["reference"] or ""
        made = run[0]["cpu"] or "", run[0]["commit"] or ""
        named = *made, run[0]["solver"]
        cells[case, solver] = Judged(case, solver, outcome, worst, graded, reason, reference, run_id, *named)
    order = {name: k for k, name in enumerate(dict.fromkeys([*SOLVERS, *OPTIONAL, *(r["solver"] for r in firsts)]))}
    return sorted(cells.values(), key=lambda cell: (_numbered(cell.case), order[cell.name], cell.solver))


def _numbered(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names with numbers naturally, 8 before 16."""
    return [(len(part.lstrip("0")) if k % 2 else 0, part) for k, part in enumerate(re.split(r"([0-9]+)", name))]


def judged(run: Sequence[dict[str, Any]]) -> tuple[Outcome, float | None, str, str]:
    """Classify a run from its rows, one per step.

    Returns: outcome, worst error, kind of that error, and the reason why the run is not correct.
    """
    first = run[0]
    if first["status"] != "ok":
        where = f"frame {first['frame']}: " if first["frame"] and first["status"] not in _WHOLE else ""
        return _ENDED.get(first["status"], FAILED), None, "", where + (first["reason"] or first["status"])
    farthest = max((away for row in run if (away := row["distance"]) is not None), default=None)
    lost = any(row["distance"] is None for row in run)
    if all(row["stationarity"] is None for row in run):
        near = farthest is not None and not lost and farthest <= CLOSE
        why = "" if near else "there is no reference" if lost else "away from the reference"
        return (RIGHT if near else SHORT), farthest, "distance", why
    beyond = [math.nan if row["beyond"] is None else row["beyond"] for row in run]
    worst = max(beyond, key=lambda value: (math.isnan(value), value))
    missed = [row for row, by in zip(run, beyond, strict=True) if not by <= SLACK * (row["tolerance"] or ASKED)]
    if missed:
        claimed = sum(row["stopped"] in _CLAIMS for row in missed)
        said = f", {claimed} of which said they had met it" if claimed else ""
        why = f"{len(missed)} of {len(run)} steps missed the tolerance{said}"
        return (WRONG if claimed else SHORT), worst, "stationarity", why
    none = [row for row in run if not row["minimum"]]
    if none:
        if all(row["flat"] for row in none):
            return VALLEY, worst, "stationarity", f"in {len(none)} of {len(run)} steps some curvature is round-off"
        return SADDLE, worst, "stationarity", "the Hessian is not positive definite"
    if lost or farthest is None:
        return OTHER, worst, "stationarity", "there is no reference to compare the motion with"
    if farthest > SAME:
        return OTHER, worst, "stationarity", f"up to {100 * farthest:.2g} % of the size from the reference"
    return RIGHT, worst, "stationarity", ""


_OPTIONS = ("size", *(option.column for option in OPTIONS.values() if option.column))


def _case(row: dict[str, Any], runs: Sequence[dict[str, Any]]) -> str:
    """Return the scene with the options in which the runs of that scene differ."""
    own = [other for other in runs if other["scene"] == row["scene"]]
    varied = [str(row[key]) for key in _OPTIONS if any(other[key] != row[key] for other in own)]
    return " ".join([row["scene"], *varied])


def _solver(row: dict[str, Any], runs: Sequence[dict[str, Any]]) -> str:
    """Return the solver's name with the parameters in which its runs differ."""
    stated = {run["parameters"] or "{}" for run in runs if run["solver"] == row["solver"]}
    others = [json.loads(text) for text in stated]
    own = json.loads(row["parameters"] or "{}")  # what a solver from outside was not given is not among them
    varied = [str(v) for key, v in own.items() if any(other.get(key) != v for other in others)]
    return " ".join([row["solver"], *varied])


@dataclass(frozen=True, slots=True)
class Score:
    """Score of one solver over all cases.

    Attributes:
        counts: number of runs with each outcome, in the order of OUTCOMES.
        right: share of correct runs among supported cases; None if no case is supported.
        finite: share of runs that stayed finite, likewise.
        worst: run with the largest error.
    """

    solver: str
    counts: tuple[int, ...]
    right: float | None
    finite: float | None
    worst: Judged


def scores(cells: Sequence[Judged]) -> list[Score]:
    """Compute a score for each solver, in the order of the cells."""
    found: list[Score] = []
    for solver in dict.fromkeys(cell.solver for cell in cells):
        own = [cell for cell in cells if cell.solver == solver]
        of = {outcome: sum(cell.outcome == outcome for cell in own) for outcome in OUTCOMES}
        claimed = len(own) - of[REFUSED]
        right, broken = of[RIGHT], of[DIVERGED] + of[FAILED]
        shares = (right / claimed, 1.0 - broken / claimed) if claimed else (None, None)
        worst = max(
            own, key=lambda cell: -1.0 if cell.worst is None else math.inf if math.isnan(cell.worst) else cell.worst
        )
        found.append(Score(solver, tuple(of.values()), *shares, worst))
    return found


def percent(share: float | None) -> str:
    """Format a share in percent; empty for None."""
    return "" if share is None else f"{share:.0%}"


def summary(cells: Sequence[Judged]) -> Table:
    """Build a table of scores with one row per solver.

    Columns are counts of the outcomes that occur, shares, and the worst error.
    """
    found = scores(cells)
    there = [k for k, _ in enumerate(OUTCOMES) if any(score.counts[k] for score in found)]
    table = Table(box=SIMPLE_HEAD, caption_justify="left")
    table.caption = "none of these are times: they may be compared across machines"
    table.add_column("solver", vertical="bottom")
    for words in (*(OUTCOMES[k].words for k in there), "part right", "part finite", "worst residual"):
        table.add_column("\n".join(words.rsplit(" ", 1)), justify="right", vertical="bottom")
    for score in found:
        worst = "" if score.worst.worst is None else f"{score.worst.worst:.1e}"
        counts = (str(score.counts[k]) for k in there)
        table.add_row(escape(score.solver), *counts, percent(score.right), percent(score.finite), worst)
    return table

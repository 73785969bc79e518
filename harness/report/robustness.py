"""Robustness of solvers: the outcome of each verified run of a sweep.

Outcomes follow from the rows only. A run of a minimising solver is correct if, in every step, the result is stationary
to the requested tolerance, up to round-off at each vertex, and a certified minimum. Both are checked by the reference
evaluator, never by the solver's own report. That report is compared: if a step ended because its residual met the
tolerance, but the evaluator finds it not stationary, the run is silently wrong instead of merely unconverged. A method
that does not minimise is scored by its motion only.

A step may have several minima. Which of them a run reaches does not affect its outcome. It is stated separately:
whether the motion is that of the reference, and by how much the objective after the first step, which has the same
start in all runs of a case, exceeds the lowest one of these runs.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table
from springbench.harness.config.run_options import RUN_OPTIONS
from springbench.harness.errors import InputError
from springbench.harness.report.varying_settings import find_varying_keys
from springbench.harness.results import parquet_rows, row_store
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS

TOLERANCE_SLACK = 1.1
"""Factor on the tolerance, because the reference evaluator and a solver factorise the same matrix differently.

Of 1372 runs of configs/hard none changes its outcome at 1.0, and 8 become correct at 2.2. All 7902 steps that their
solver reported as converged were converged.
"""
DEFAULT_RTOL = 1e-6
"""Tolerance that scores a run for which none was requested."""
SAME_MOTION_DISTANCE = 1e-2
"""Share of the rest shape's size: a motion within this distance of the reference counts as the same.

Steps are solved to 1e-6 of their displacement, and instability amplifies that error. The limit lies in a gap: of 670
runs of configs/hard that end at minima, 595 stay within 0.5 % and 71 deviate by more than 2 %. Half the limit would
remove 2 of these runs, twice the limit would add 2.
"""
SAME_ENERGY_RTOL = 1e-9
"""Excess of the objective, over its magnitude, up to which it counts as the lowest: steps are solved to residuals of
1e-6, and the objective is flat to second order at its minimum."""
CLOSE_MOTION_DISTANCE = 0.05
"""Share of the rest shape's size: required distance of a method that does not minimise, roughly what is visible.

A convention: of its 240 runs of configs/hard, 97 are within it, 73 within half of it and 104 within twice.
"""


class RunOutcome(NamedTuple):
    """The outcome of a run: label, colour and description.

    Example:
        >>> springbench.RunOutcome("right", "#3a9e72", "a certified minimum in every step").label
        'right'
    """

    label: str
    color: str
    description: str


CORRECT = RunOutcome(
    "right",
    "#3a9e72",
    "a certified minimum in every step; of methods that do not minimise, the motion of the reference",
)
DEGENERATE_MINIMUM = RunOutcome(
    "degenerate minimum", "#c9c27a", "stationary, with a curvature that is zero up to round-off: a continuum of minima"
)
SADDLE_POINT = RunOutcome("saddle point", "#b9a3d6", "stationary, with a direction of negative curvature")
NOT_CONVERGED = RunOutcome("not converged", "#f2c45f", "finite, and not yet stationary, or not close to the reference")
SILENTLY_WRONG = RunOutcome(
    "silently wrong", "#e0683c", "reported a step as converged, which the reference evaluator contradicts"
)
DIVERGED = RunOutcome("diverged", "#d1495b", "not finite any more, or far beyond the energy of its scene")
ENERGY_GROWTH = RunOutcome("energy growth", "#c98ba6", "finite, with more energy than the scene provides")
TIMED_OUT = RunOutcome("too slow", "#7b7f87", "did not end within its time limit")
FAILED = RunOutcome("failed", "#23262b", "ended with an error")
WRONG_GRADIENT = RunOutcome(
    "wrong gradient", "#8a6d4b", "an energy from user code whose gradient is not the derivative of its value"
)
UNSUPPORTED = RunOutcome("refused", "#d9d9d6", "refused before it began, with a reason")
RUN_OUTCOMES = (
    CORRECT,
    DEGENERATE_MINIMUM,
    SADDLE_POINT,
    NOT_CONVERGED,
    SILENTLY_WRONG,
    ENERGY_GROWTH,
    DIVERGED,
    TIMED_OUT,
    FAILED,
    WRONG_GRADIENT,
    UNSUPPORTED,
)

MOTION_MARK = "\u2248"
"""Mark of runs that are correct by another motion than the reference."""
MAP_NOTE = (
    "Numbers: the largest final residual |Q\u207b\u00b9 grad g|_Q of a step, over its value at the start of the step "
    "(or round-off); for methods that do not minimise, the largest distance from a converged run, in percent of the "
    "scene's size. Shares: of the cases that a solver supports."
)

_CONVERGED_REASONS = ("converged", "roundoff")
"""Termination reasons with which a solver claims convergence."""
_OUTCOME_OF_STATUS = {
    "time-limit": TIMED_OUT,
    "unsupported": UNSUPPORTED,
    "diverged": DIVERGED,
    "energy-growth": ENERGY_GROWTH,
    "failed": FAILED,
    "killed": FAILED,
    "wrong-gradient": WRONG_GRADIENT,
}

_COMPLETED_STATUSES = ("wrong-gradient", "energy-growth")
"""Statuses of runs that were completed and have a row for each step."""


@dataclass(frozen=True, slots=True)
class VerifiedRun:
    """The outcome of one verified run.

    Attributes:
        case: scene, with the options in which its runs differ.
        solver: solver, with the parameters in which its runs differ.
        outcome: outcome of the run.
        worst_error: largest `stationarity_above_roundoff` of a step, or, if `error_kind` is "distance", the largest
            distance from the reference; None if unknown.
        error_kind: "stationarity" or "distance".
        reason: why the run is not correct, or how its motion differs from the reference.
        same_motion: whether the motion is that of the reference; None without a reference, and for methods that do
            not minimise, which are scored by their motion.
        energy_excess: objective after the first step less the lowest of all runs of the case, over the largest
            magnitude of these; None if unknown or if the solver does not minimise.
        citation: reference of the solver as in the rows.
        run_id: id of the run.
        cpu: processor that executed the run.
        commit: version of the code that executed the run.
        solver_name: name of the solver without its parameters; it may contain spaces.

    Example:
        >>> outcome = springbench.RunOutcome("right", "#3a9e72", "a certified minimum in every step")
        >>> springbench.VerifiedRun("net", "newton", outcome, 3e-8, "stationarity", reason="").error_text
        '1e-8'
    """

    case: str
    solver: str
    outcome: RunOutcome
    worst_error: float | None
    error_kind: str
    reason: str
    same_motion: bool | None = None
    energy_excess: float | None = None
    citation: str = ""
    run_id: str = ""
    cpu: str = ""
    commit: str = ""
    solver_name: str = ""

    @property
    def has_other_motion(self) -> bool:
        """Whether the run is correct, by other minima than the reference."""
        return self.outcome is CORRECT and self.same_motion is False

    @property
    def has_lowest_energy(self) -> bool:
        """Whether the run is correct, and its objective after the first step is the lowest."""
        return self.outcome is CORRECT and self.energy_excess is not None and self.energy_excess <= SAME_ENERGY_RTOL

    @property
    def error_text(self) -> str:
        """The worst error: a power of ten, or a percentage of the scene's size."""
        if self.worst_error is None:
            return ""
        if self.error_kind == "distance":
            return f"{100 * self.worst_error:.0f} %" if self.worst_error < 9.99 else ">999 %"
        if not math.isfinite(self.worst_error):
            return str(self.worst_error)
        return "0" if self.worst_error == 0.0 else f"1e{round(math.log10(self.worst_error))}"


def read_verified_runs(folder: Path) -> list[VerifiedRun]:
    """Read the outcomes of the runs in a sweep's folder.

    They are ordered by case and solver; of repeated runs the newest counts. Units with invalid values are omitted; the
    results page lists them.

    Raises:
        InputError: if no run was verified, or if some runs were verified by an incompatible version.

    Example:
        >>> [(run.case, run.solver) for run in springbench.read_verified_runs(Path("results/small"))]
        [('chain', 'sparse'), ('chain', 'newton')]
    """
    files = row_store.list_units(folder / "rows")
    needed = "run_id", "scene", "size", "solver", "phase", "status", "started_at"
    table = parquet_rows.read_rows(files, required_columns=needed, on_invalid=lambda mistake: None).to_pylist()
    runs = parquet_rows.group_result_rows(table)
    if not any(row["stationarity"] is not None or row["reference_distance"] is not None for row in table):
        raise InputError(f"{folder}: contains no verified runs; run a sweep with `verify: true`")
    if any(row["stationarity"] is not None and row["stationarity_above_roundoff"] is None for row in table):
        raise InputError(f"{folder}: contains runs that another version of springbench verified; run the sweep again")
    firsts = [run[0] for run in runs.values()]
    of_scene: dict[str, list[Mapping[str, Any]]] = {}
    of_solver: dict[str, list[Mapping[str, Any]]] = {}
    for first in firsts:
        of_scene.setdefault(first["scene"], []).append(first)
        of_solver.setdefault(first["solver"], []).append(first)
    cells: dict[tuple[str, str], VerifiedRun] = {}
    energies: dict[str, dict[str, float]] = {}
    for run in sorted(runs.values(), key=lambda run: run[0]["started_at"]):
        first = run[0]
        case, solver = _case_name(first, of_scene[first["scene"]]), _solver_label(first, of_solver[first["solver"]])
        cells[case, solver] = VerifiedRun(
            case,
            solver,
            *classify_run(run),
            citation=first["citation"] or "",
            run_id=first["run_id"],
            cpu=first["cpu"] or "",
            commit=first["commit"] or "",
            solver_name=first["solver"],
        )
        energy = min(run, key=lambda row: row["frame"] or 0).get("objective")
        if first.get("is_minimiser") and energy is not None and math.isfinite(energy):
            energies.setdefault(case, {})[solver] = energy
    for case, found in energies.items():
        lowest, scale = min(found.values()), max(map(abs, found.values()))
        for solver, energy in found.items():
            excess = (energy - lowest) / scale if scale else 0.0
            cells[case, solver] = replace(cells[case, solver], energy_excess=excess)
    order = {
        name: k for k, name in enumerate(dict.fromkeys([*SOLVERS, *OPTIONAL_SOLVERS, *(r["solver"] for r in firsts)]))
    }
    return sorted(cells.values(), key=lambda cell: (_natural_sort_key(cell.case), order[cell.solver_name], cell.solver))


def _natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names with numbers naturally, 8 before 16."""
    return [(len(part.lstrip("0")) if k % 2 else 0, part) for k, part in enumerate(re.split(r"([0-9]+)", name))]


def has_verification(table: pa.Table) -> bool:
    """Return whether any of these rows was verified."""
    columns = [table[name] for name in ("stationarity", "reference_distance") if name in table.column_names]
    return any(column.null_count < len(column) for column in columns)


class RunVerdict(NamedTuple):
    """Outcome of a run, and its reasons; the fields are those of `VerifiedRun`."""

    outcome: RunOutcome
    worst_error: float | None
    error_kind: str
    reason: str
    same_motion: bool | None = None


def classify_run(run: Sequence[Mapping[str, Any]]) -> RunVerdict:
    """Classify a run from its rows, one per step."""
    first = run[0]
    if first["status"] != "ok":
        where = f"frame {first['frame']}: " if first["frame"] and first["status"] not in _COMPLETED_STATUSES else ""
        return RunVerdict(
            _OUTCOME_OF_STATUS.get(first["status"], FAILED), None, "", where + (first["reason"] or first["status"])
        )
    farthest = max((away for row in run if (away := row["reference_distance"]) is not None), default=None)
    lost = any(row["reference_distance"] is None for row in run)
    same = None if lost or farthest is None else farthest <= SAME_MOTION_DISTANCE
    if all(row["stationarity"] is None for row in run):
        near = farthest is not None and not lost and farthest <= CLOSE_MOTION_DISTANCE
        why = "" if near else "there is no reference" if lost else "away from the reference"
        return RunVerdict(CORRECT if near else NOT_CONVERGED, farthest, "distance", why)
    beyond = [
        math.nan if row["stationarity_above_roundoff"] is None else row["stationarity_above_roundoff"] for row in run
    ]
    worst = max(beyond, key=lambda value: (math.isnan(value), value))
    missed = [
        row
        for row, by in zip(run, beyond, strict=True)
        if not by <= TOLERANCE_SLACK * (row["residual_rtol"] or DEFAULT_RTOL)
    ]
    if missed:
        claimed = sum(row["termination_reason"] in _CONVERGED_REASONS for row in missed)
        claims = f", {claimed} of which said they had met it" if claimed else ""
        why = f"{len(missed)} of {len(run)} steps missed the tolerance{claims}"
        return RunVerdict(SILENTLY_WRONG if claimed else NOT_CONVERGED, worst, "stationarity", why, same)
    none = [row for row in run if not row["is_local_minimum"]]
    if none:
        if all(row["is_degenerate"] for row in none):
            why = f"in {len(none)} of {len(run)} steps some curvature is round-off"
            return RunVerdict(DEGENERATE_MINIMUM, worst, "stationarity", why, same)
        return RunVerdict(SADDLE_POINT, worst, "stationarity", "the Hessian is not positive definite", same)
    why = ""
    if same is None:
        why = "certified minima; there is no reference to compare the motion with"
    elif not same:
        why = (
            f"certified minima, by another motion: up to {100 * (farthest or 0.0):.2g} % of the size from the reference"
        )
    return RunVerdict(CORRECT, worst, "stationarity", why, same)


_OPTION_COLUMNS = ("size", *(option.column for option in RUN_OPTIONS.values() if option.column))


def _case_name(row: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> str:
    """Return the scene with the options in which its runs differ."""
    varied = [str(row[key]) for key in _OPTION_COLUMNS if any(other[key] != row[key] for other in runs)]
    return " ".join([row["scene"], *varied])


def _solver_label(row: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> str:
    """Return the solver's name with the parameters in which its runs differ."""
    varying = find_varying_keys(json.loads(text) for text in {run["parameters"] or "{}" for run in runs})
    own = json.loads(row["parameters"] or "{}")
    return " ".join([row["solver"], *(str(value) for key, value in own.items() if key in varying)])


@dataclass(frozen=True, slots=True)
class SolverScore:
    """Score of one solver over all cases.

    Attributes:
        outcome_counts: number of runs with each outcome, in the order of RUN_OUTCOMES.
        correct_share: share of correct runs among supported cases; None if no case is supported.
        finite_share: share of runs that neither diverged nor failed, likewise.
        other_motion_count: number of correct runs with another motion than the reference.
        lowest_energy_count: number of correct runs whose first step has the lowest objective of all solvers.
        worst_run: run with the largest error.
    """

    solver: str
    outcome_counts: tuple[int, ...]
    correct_share: float | None
    finite_share: float | None
    other_motion_count: int
    lowest_energy_count: int
    worst_run: VerifiedRun


def score_solvers(cells: Sequence[VerifiedRun]) -> list[SolverScore]:
    """Compute a score for each solver, in the order of the cells."""
    found: list[SolverScore] = []
    for solver in dict.fromkeys(cell.solver for cell in cells):
        own = [cell for cell in cells if cell.solver == solver]
        of = {outcome: sum(cell.outcome == outcome for cell in own) for outcome in RUN_OUTCOMES}
        claimed = len(own) - of[UNSUPPORTED]
        right, broken = of[CORRECT], of[DIVERGED] + of[FAILED]
        shares = (right / claimed, 1.0 - broken / claimed) if claimed else (None, None)
        worst = max(
            own,
            key=lambda cell: (
                -1.0 if cell.worst_error is None else math.inf if math.isnan(cell.worst_error) else cell.worst_error
            ),
        )
        motions = sum(cell.has_other_motion for cell in own), sum(cell.has_lowest_energy for cell in own)
        found.append(SolverScore(solver, tuple(of.values()), *shares, *motions, worst))
    return found


def format_share(share: float | None) -> str:
    """Format a share in percent; empty for None."""
    return "" if share is None else f"{share:.0%}"


def build_map_headline(cells: Sequence[VerifiedRun], name: str) -> str:
    """Return the headline of the map: counts of the main outcomes.

    Args:
        cells: verified runs of the map.
        name: name of the sweep, with which the headline begins.
    """
    of = {outcome: sum(cell.outcome == outcome for cell in cells) for outcome in RUN_OUTCOMES}
    broken = of[DIVERGED] + of[FAILED]
    return (
        f"{name}: {of[CORRECT]} of {len(cells)} runs right, {of[SILENTLY_WRONG]} "
        f"silently wrong, {broken} diverged or failed"
    )


def build_score_table(cells: Sequence[VerifiedRun]) -> Table:
    """Build a table of scores with one row per solver.

    Columns are counts of the outcomes that occur, shares, and the worst error.
    """
    found = score_solvers(cells)
    there = [k for k, _ in enumerate(RUN_OUTCOMES) if any(score.outcome_counts[k] for score in found)]
    table = Table(box=SIMPLE_HEAD, caption_justify="left")
    table.caption = "none of these are times: they may be compared across machines"
    table.add_column("solver", vertical="bottom")
    motions = ("by another_motion", "at lowest_energy")
    for words in (*(RUN_OUTCOMES[k].label for k in there), *motions, "part right", "part finite", "worst residual"):
        table.add_column("\n".join(words.rsplit(" ", 1)).replace("_", " "), justify="right", vertical="bottom")
    for score in found:
        worst = "" if score.worst_run.worst_error is None else f"{score.worst_run.worst_error:.1e}"
        counts = [str(score.outcome_counts[k]) for k in there]
        counts += [str(score.other_motion_count), str(score.lowest_energy_count)]
        table.add_row(
            escape(score.solver), *counts, format_share(score.correct_share), format_share(score.finite_share), worst
        )
    return table

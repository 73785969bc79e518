"""Grades as text, tables and CSV: of one submission, and of a folder of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

import numpy as np
from springbench.harness.errors import InputError
from springbench.harness.execution.progress_display import UNIT_COST, RemainingTime, append_remaining
from springbench.harness.execution.progress_events import ProgressCallback
from springbench.harness.experiments.grading.grading import PositionGrade, SceneGrader, format_fit
from springbench.harness.experiments.grading.motion_error import SMALLEST_ERROR
from springbench.harness.experiments.grading.position_files import is_submission
from springbench.harness.experiments.grading.step_verdicts import spread_order

SHOWN_STEPS = 12
"""Number of steps in the printed table; the CSV has all."""

STEP_COLUMNS = (
    "step",
    "time",
    "residual",
    "residual_floor",
    "is_minimum",
    "energy_gap",
    "minimum_distance",
    "energy",
    "kinetic_energy",
    "max_strain",
    "momentum_error",
    "intersections",
)
"""Columns of the steps of one submission."""

CLASS_COLUMNS = (
    "submission",
    "verdict",
    "mistake",
    "fit",
    "program",
    "steps",
    "minima",
    "median_residual",
    "median_gap",
    "max_strain",
    "error",
    "reason",
)
"""Columns of a folder of submissions."""


@dataclass(frozen=True, slots=True, eq=False)
class ClassRow:
    """Grade of one submission in a folder, or the reason why there is none."""

    name: str
    grade: PositionGrade | None
    reason: str = ""

    def list_cells(self) -> list[str]:
        """List the cells of CLASS_COLUMNS."""
        grade = self.grade
        if grade is None:
            return [self.name, "not graded", *[""] * (len(CLASS_COLUMNS) - 3), self.reason]
        found = grade.fingerprint
        mistake = found.mistake if found else None
        error = grade.shares[-1].total if grade.shares else None
        return [
            self.name,
            grade.kind,
            mistake.name if mistake else "",
            f"{mistake.fit:.6f}" if mistake else "",
            found.correct_program if found and not mistake and found.is_correct else "",
            str(len(grade.steps)),
            str(grade.num_minima),
            f"{grade.median_residual:.2e}",
            _format(grade.median_gap),
            f"{grade.quantities.max_strain.max():.3g}",
            _format(error),
            grade.verdict,
        ]


def grade_folder(
    grader: SceneGrader, folder: Path, report_progress: ProgressCallback = lambda line: None
) -> list[ClassRow]:
    """Grade each file and folder of positions in a folder.

    Args:
        grader: grader of the scene.
        folder: folder with a file or a folder of positions for each submission.
        report_progress: called with a line before each submission.

    Returns:
        Rows by increasing name; those of submissions that cannot be read have a reason.

    Raises:
        InputError: the folder has no submissions.
    """
    found = sorted(one for one in folder.iterdir() if not one.name.startswith(".") and is_submission(one))
    inner = {one: _find_inner(one) for one in sorted(folder.iterdir()) if one.is_dir() and not is_submission(one)}
    paths = {one.stem if one.is_file() else one.name: one for one in found}
    if len(paths) < len(found):
        paths = {one.name: one for one in found}
    paths |= {one.name: there for one, there in inner.items() if there}
    if not paths:
        raise InputError(f"{folder}: has no files of positions and no folders of them")
    rows, pace = list[ClassRow](), RemainingTime([UNIT_COST] * len(paths))
    for name, path in sorted(paths.items()):
        report_progress(append_remaining(f"[{len(rows)}/{len(paths)}] grading {name}", pace.estimate_seconds()))
        began = monotonic()
        try:
            rows.append(ClassRow(name, grader.grade_file(path)))
        except InputError as error:
            rows.append(ClassRow(name, None, str(error)))
        pace.record_run(UNIT_COST, monotonic() - began)
    return rows


def _find_inner(folder: Path) -> Path | None:
    """Find the only file or folder of positions in a student's folder."""
    found = [one for one in sorted(folder.iterdir()) if not one.name.startswith(".") and is_submission(one)]
    return found[0] if len(found) == 1 else None


def list_class_table(rows: Sequence[ClassRow]) -> list[tuple[str, ...]]:
    """List the lines of the printed table of a folder, the first with the headings."""
    shown = ("submission", "verdict", "mistake", "fit", "minima", "median_residual", "max_strain", "error")
    keep = [CLASS_COLUMNS.index(name) for name in shown]
    lines = list[tuple[str, ...]]()
    for row in rows:
        cells = row.list_cells()
        line = [cells[k] for k in keep]
        if row.grade:
            line[4] = f"{line[4]} of {len(row.grade.steps)}"
            line[3] = format_fit(float(line[3])) if line[3] else ""
        lines.append(tuple(line))
    return [tuple(name.replace("_", " ") for name in shown), *lines]


def list_step_lines(grade: PositionGrade) -> list[list[str]]:
    """List the lines of the CSV of one submission, the first with the headings."""
    steps = range(1, len(grade.steps) + 1)
    return [list(STEP_COLUMNS), *(_list_step_cells(grade, step, digits=9) for step in steps)]


def _list_step_cells(grade: PositionGrade, step: int, digits: int = 3) -> list[str]:
    """List the cells of STEP_COLUMNS of a step."""
    one, q = grade.steps[step - 1], grade.quantities
    momentum = None if q.momentum_error is None else float(q.momentum_error[step - 1])
    values = (
        one.residual,
        one.residual_floor,
        "yes" if one.is_minimum else "no",
        one.gap,
        one.distance,
        float(q.energy[step]),
        float(q.kinetic_energy[step]),
        float(q.max_strain[step]),
        momentum,
        q.intersections.get(step),
    )
    time_of_step = grade.submission.time_step * step
    return [str(step), f"{time_of_step:.6g}", *(_format(value, digits) for value in values)]


def _format(value: float | str | None, digits: int = 3) -> str:
    """Format a cell; empty for None."""
    return "" if value is None else value if isinstance(value, str) else f"{value:.{digits}g}"


def select_shown_steps(count: int) -> list[int]:
    """Select up to SHOWN_STEPS steps, spread evenly."""
    return sorted(step for step, _ in zip(spread_order(count), range(SHOWN_STEPS), strict=False))


def list_step_table(grade: PositionGrade) -> list[tuple[str, ...]]:
    """List the lines of the printed table of steps, the first with the headings."""
    names = {"residual_floor": "by digits", "is_minimum": "minimum", "minimum_distance": "distance"}
    keep = [k for k, name in enumerate(STEP_COLUMNS) if name not in ("time", "kinetic_energy")]
    cells = [_list_step_cells(grade, step) for step in select_shown_steps(len(grade.steps))]
    keep = [k for k in keep if any(line[k] for line in cells)]
    headings = tuple(names.get(STEP_COLUMNS[k], STEP_COLUMNS[k].replace("_", " ")) for k in keep)
    return [headings, *(tuple(line[k] for k in keep) for line in cells)]


def format_grade(grade: PositionGrade) -> Iterator[str]:
    """Yield the grade of one submission as sentences, without the table of steps."""
    q, steps = grade.quantities, grade.steps
    yield f"{grade.kind}: {grade.verdict}"
    yield ""
    yield from grade.submission.notes
    residuals = f"median {grade.median_residual:.1e}, largest {grade.max_residual:.1e}"
    yield f"steps: {len(steps)}, of which {grade.num_minima} minimise their objective; residuals: {residuals}"
    if grade.max_gap is not None:
        computed = sum(one.gap is not None for one in steps)
        yield (
            f"energy gap to the minimum, relative to the step's start: median {grade.median_gap:.1e}, largest "
            f"{grade.max_gap:.1e} ({computed} of {len(steps)} minima computed)"
        )
    flaws = [one for one in steps if one.flaw]
    if flaws:
        yield f"{len(flaws)} minima are not certified, as that of step {flaws[0].step}: {flaws[0].flaw}"
    tiny = 1e-9 * float(np.abs(q.energy).max(initial=0.0))
    first, last, highest = (0.0 if abs(x) < tiny else float(x) for x in (q.energy[0], q.energy[-1], np.max(q.energy)))
    yield f"energy: {first:.4g} J at the start, {last:.4g} J at the end, at most {highest:.4g} J"
    at = int(np.argmax(q.max_strain))
    yield f"largest strain: {100.0 * float(q.max_strain[at]):.3g} %, after step {at}"
    if q.momentum_error is not None and len(q.momentum_error):
        yield f"momentum: its balance is violated by {float(q.momentum_error.max()):.1e} at most"
    if q.intersections:
        counts = ", ".join(f"{count} after step {step}" for step, count in q.intersections.items())
        yield f"intersections of edges with triangles: {counts}"
    yield from _format_shares(grade)
    yield from _format_fingerprint(grade)


def _format_shares(grade: PositionGrade) -> Iterator[str]:
    for one in grade.shares:
        known = f" (itself known to {100 * one.reference_error:.2g} %)" if one.reference_error > SMALLEST_ERROR else ""
        yield (
            f"error against the {one.reference_kind} motion{known} after {one.time:.4g} s: {100 * one.total:.3g} % of "
            f"the displacement; the time step alone gives {100 * one.time_step_share:.3g} %, the solver "
            f"{100 * one.solver_share:.3g} %"
        )
    if grade.shares_note:
        yield grade.shares_note


def _format_fingerprint(grade: PositionGrade) -> Iterator[str]:
    found = grade.fingerprint
    if found is None:
        yield grade.fingerprint_note
        return
    yield (
        f"closest correct program: {found.correct_program}, whose steps differ by {found.deviation:.1e} of their "
        f"length (stored digits: {found.noise:.0e})"
    )
    for one in found.closest[:3]:
        yield f"  mistake `{one.name}`: explains {100 * one.fit:.4g} %, leaves {one.deviation:.1e}"
    if found.invisible:
        yield f"mistakes that this scene cannot show: {', '.join(found.invisible)}"

"""Command `springbench grade`: grade positions that another program computed."""

from __future__ import annotations

import csv as csv_format
import sys
from functools import partial
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from springbench.harness.cli.shared_options import SCENE_HELP, describe_config, require_output_file
from springbench.harness.console import (
    format_plain_table,
    get_output_console,
    print_message,
    show_activity,
    split_wide_table,
)
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.isolated_call import run_isolated

if TYPE_CHECKING:
    from springbench.harness.execution.worker_process import ProgressCallback
    from springbench.harness.experiments.grading.grading import GradeRequest


def grade(
    positions: Annotated[
        Path, typer.Argument(help="Positions: .npz, .npy, .csv, .rrd, or a folder of OBJ or PLY files, one a frame.")
    ],
    scene: Annotated[Path, describe_config("SCENE", SCENE_HELP)],
    students: Annotated[
        bool, typer.Option("--students", help="POSITIONS is a folder with one submission of each student.")
    ] = False,
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default size by default.")] = None,
    iterations: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="Required iterations a step; 50 for JSON scenes, else convergence."),
    ] = None,
    first_frame: Annotated[
        int | None, typer.Option(min=0, max=1, help="Number of the first stored frame: 0 is the start of the scene.")
    ] = None,
    rest: Annotated[
        Path | None, typer.Option(help="Rest positions in the order of POSITIONS, to match the vertices by.")
    ] = None,
    array: Annotated[str, typer.Option(help="Name of the array in .npz files.")] = "positions",
    budget: Annotated[
        float, typer.Option(min=0.0, max=1e5, help="Time limit [s] of the minima, and of the integrated motion.")
    ] = 30.0,
    csv: Annotated[Path | None, typer.Option(help="File (.csv) for all steps, or for all students.")] = None,
) -> None:
    """Grade positions by whether each step minimises its objective, and by their error.

    A mistake that explains the error is reported, if one is found.
    """
    require_output_file(csv, ".csv", "--csv")
    if isnan(budget):
        raise InputError("--budget: got nan; expected seconds")
    if students and not positions.is_dir():
        raise InputError(
            InputMistake("is no folder; --students needs one with a submission of each student", positions)
        )

    from springbench.harness.config.config_loader import is_assignment_file, load_scene_run
    from springbench.harness.execution.progress_display import ThrottledMessages
    from springbench.harness.execution.worker_process import TaskLimits
    from springbench.harness.experiments.grading.grading import GradeRequest
    from springbench.harness.scenes.assignment_scene import ASSIGNMENT_ITERATIONS

    run = load_scene_run(scene, size)
    required = iterations or (ASSIGNMENT_ITERATIONS if is_assignment_file(scene) else None)
    request = GradeRequest(run.scene, run.size, required, first_frame, rest, array, budget)
    show_activity("grading")
    work = partial(_grade_students if students else _grade_one, request, positions)
    report_progress = print_message if students else ThrottledMessages(print_message, show_activity)
    lines, table, cells, is_good = run_isolated(
        work, run.scene.find_plugins(), TaskLimits(run.time_limit, run.memory_limit), report_progress
    )
    if students:
        get_output_console().print(_build_class_table(table))
    for line in lines if students else (*lines, "", *format_plain_table(table)):
        print(line)
    if csv:
        with csv.open("w", newline="") as file:
            csv_format.writer(file).writerows(cells)
        print_message(f"{'all students' if students else 'all steps'} are in {csv}")
    sys.stdout.flush()
    raise typer.Exit(0 if is_good else 1)


_Answer = tuple[list[str], list[tuple[str, ...]], list[list[str]], bool]
"""Sentences, the printed table, the lines of the CSV, and whether the grade is good."""


def _grade_one(request: GradeRequest, path: Path, tick: ProgressCallback) -> _Answer:
    """Grade one submission."""
    from springbench.harness.experiments.grading.grade_tables import format_grade, list_step_lines, list_step_table
    from springbench.harness.experiments.grading.grading import CORRECT, SceneGrader

    found = SceneGrader(request).grade_file(path, tick)
    return [*format_grade(found)], list_step_table(found), list_step_lines(found), found.kind == CORRECT


def _grade_students(request: GradeRequest, folder: Path, tick: ProgressCallback) -> _Answer:
    """Grade a folder of submissions."""
    from springbench.harness.experiments.grading.grade_tables import (
        CLASS_COLUMNS,
        grade_folder,
        list_class_table,
    )
    from springbench.harness.experiments.grading.grading import SceneGrader

    rows = grade_folder(SceneGrader(request), folder, tick)
    reasons = [f"{row.name}: {row.reason}" for row in rows if row.grade is None]
    return reasons, list_class_table(rows), [list(CLASS_COLUMNS), *(row.list_cells() for row in rows)], True


def _build_class_table(lines: list[tuple[str, ...]]) -> object:
    from rich.markup import escape
    from rich.table import Table

    table = Table(*lines[0])
    for line in lines[1:]:
        table.add_row(*map(escape, line))
    return split_wide_table(table)

"""Pictures of a sweep: runs, solver comparisons, and run times.

The side-by-side recordings of the comparisons are also written.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
from springbench.harness.atomic_files import is_outdated
from springbench.harness.config.run_options import RUN_OPTIONS
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.execution.isolated_worker import ProgressCallback, TaskFailure, TaskLimits
from springbench.harness.execution.optional_parts import PICTURES
from springbench.harness.execution.progress_display import ThrottledMessages
from springbench.harness.execution.progress_events import ignore_progress
from springbench.harness.execution.timing_lock import lock_timing_shared
from springbench.harness.execution.worker_pool import PoolTask, run_tasks
from springbench.harness.execution.worker_process import TaskFunction
from springbench.harness.report.citations import write_bibtex
from springbench.harness.report.picture_sources import digest_runs, read_sources
from springbench.harness.report.varying_settings import find_varying_keys


class PictureJob(NamedTuple):
    """A run, and the paths of its recording and its picture."""

    run: RunSpec
    recording_path: Path
    picture_path: Path


def draw_sweep_pictures(
    name: str,
    jobs: Sequence[PictureJob],
    folder: Path,
    table: pa.Table,
    print_message: Callable[[str], None],
    *,
    num_concurrent: int = 1,
    stale_ids: Collection[str] = (),
) -> None:
    """Draw the pictures and comparisons that are missing or older than one of their recordings.

    `references.bib` is written too.

    Args:
        name: name of the sweep.
        jobs: runs with their recordings and pictures.
        folder: folder of the sweep's results.
        table: rows of all runs.
        print_message: prints a remark.
        num_concurrent: number of drawing processes.
        stale_ids: ids of runs that were executed by other code than the current version.
    """
    write_bibtex(folder / "references.bib", table["citation"].to_pylist())
    drawn = [p for p in jobs if p.run.record and p.recording_path.exists()]
    wanting = [p for p in drawn if p.run.pictures and is_outdated(p.picture_path, [p.recording_path])]
    groups = [
        group for group in group_by_scene(drawn, folder) if group.has_outdated_recording or group.has_outdated_picture
    ]

    def times() -> None:
        path, sources = folder / "pictures" / "timing.png", digest_runs(name, table, stale_ids)
        if any(p.run.pictures for p in jobs) and sources != read_sources(path):
            from springbench.harness.report.timing_plot import draw_timing_plot

            with lock_timing_shared(ignore_progress):
                draw_timing_plot(table, path, name, stale_ids, sources)

    missing = _load_drawing() if wanting or any(group.has_outdated_picture for group in groups) else None
    if missing:
        print_message(missing)
        wanting = []
    if wanting:
        print_message(f"drawing the pictures of {len(wanting)} runs")
    tasks = [
        *(_DrawingTask(p.picture_path, partial(_draw_job, p)) for p in wanting),
        *(_DrawingTask(group.recording_path, partial(_draw_comparison, group, not missing)) for group in groups),
    ]
    _draw_in_parallel(tasks, print_message, num_concurrent, times)


def _load_drawing() -> str | None:
    """Load the drawing modules for forked processes; return why drawing is impossible, or None."""
    from springbench.harness.report import opengl_probe

    opengl_probe.start_opengl_probe()
    if PICTURES.is_installed():
        import_module("springbench.harness.report.run_picture")
    return opengl_probe.find_opengl_problem()


class _DrawingTask(NamedTuple):
    """A file, and the function that draws it."""

    path: Path
    draw: TaskFunction


def _draw_in_parallel(
    tasks: Sequence[_DrawingTask],
    print_message: Callable[[str], None],
    num_concurrent: int,
    run_meanwhile: Callable[[], None],
) -> None:
    """Draw in parallel processes, and report why a process was lost."""
    if not tasks:
        run_meanwhile()
        return
    done, remarks = 0, ThrottledMessages(print_message)

    def tick(message: str) -> None:
        remarks(f"{done} of {len(tasks)} pictures and comparisons are drawn")

    pool_tasks = [PoolTask(task.draw, tick, TaskLimits()) for task in tasks]
    for number, outcome in run_tasks(
        num_concurrent, int, [None] * len(tasks), lambda number: pool_tasks[number], run_meanwhile
    ):
        done += 1
        if isinstance(outcome, TaskFailure):
            print_message(f"{tasks[number].path} is not drawn: its process {outcome}")


def _draw_comparison(group: SolverGroup, has_pictures: bool, tick: ProgressCallback) -> None:
    """Create the side-by-side recording of a group, and its picture if pictures can be drawn."""
    from springbench.harness.recording.recording_reader import read_replay
    from springbench.harness.recording.side_by_side import LineStyle, write_side_by_side
    from springbench.harness.report.comparison_picture import draw_comparison_picture
    from springbench.harness.report.plot_style import assign_label_shades

    with lock_timing_shared(tick):
        if group.has_outdated_recording:
            found = assign_label_shades((name, p.run.solver.name) for name, p in group.jobs_by_label.items())
            looks = {name: LineStyle(mark.color) for name, mark in found.items()}
            write_side_by_side(group.recording_path, group.recording_paths, group.group_label.replace("-", " "), looks)
        if group.has_outdated_picture and has_pictures:
            draw_comparison_picture(
                {name: read_replay(path) for name, path in group.recording_paths.items()}, group.picture_path
            )


def _draw_job(p: PictureJob, tick: ProgressCallback) -> None:
    from springbench.harness.recording.recording_reader import read_replay
    from springbench.harness.report.run_picture import draw_run_picture

    camera = p.run.scene.camera
    with lock_timing_shared(tick):
        draw_run_picture(
            read_replay(p.recording_path), p.picture_path, camera=(camera.azimuth, camera.elevation) if camera else None
        )


@dataclass(frozen=True, slots=True)
class SolverGroup:
    """Runs that differ only in their solver or its settings.

    Attributes:
        group_label: scene and size.
        jobs_by_label: the runs, by solver and differing settings.
        recording_path, picture_path: files that compare the runs.
    """

    group_label: str
    jobs_by_label: dict[str, PictureJob]
    recording_path: Path
    picture_path: Path

    @property
    def recording_paths(self) -> dict[str, Path]:
        """The recordings of the runs by label."""
        return {name: p.recording_path for name, p in self.jobs_by_label.items()}

    @property
    def has_outdated_recording(self) -> bool:
        """Whether the side-by-side recording has to be made."""
        return is_outdated(self.recording_path, self.recording_paths.values())

    @property
    def has_outdated_picture(self) -> bool:
        """Whether the comparison picture has to be drawn."""
        return next(iter(self.jobs_by_label.values())).run.pictures and is_outdated(
            self.picture_path, self.recording_paths.values()
        )


def group_by_scene(drawn: list[PictureJob], folder: Path) -> list[SolverGroup]:
    """Group runs by scene and size; only groups of two or more runs are returned.

    Args:
        drawn: runs with a recording.
        folder: folder of the sweep's results, where recordings and pictures of the groups are stored.
    """
    by_scene: dict[str, list[PictureJob]] = {}
    for p in drawn:
        by_scene.setdefault(f"{p.run.scene_name}-{p.run.size}", []).append(p)
    return [
        SolverGroup(
            label,
            {_distinct_label(p, some): p for p in some},
            folder / "recordings" / f"{label}-solvers.rrd",
            folder / "pictures" / f"{label}-solvers.png",
        )
        for label, some in by_scene.items()
        if len(some) > 1
    ]


def _distinct_label(p: PictureJob, group: list[PictureJob]) -> str:
    """Return the solver's name with its varying parameters and options.

    These are the ones in which the group's runs of this solver differ.
    """

    def settings(run: RunSpec) -> dict[str, Any]:
        return {**run.solver.parameters, **{option: getattr(run, option) for option in RUN_OPTIONS}}

    varying = find_varying_keys(settings(one.run) for one in group if one.run.solver.name == p.run.solver.name)
    shown = [(key, value) for key, value in settings(p.run).items() if key in varying]
    short = {name: option.short_format for name, option in RUN_OPTIONS.items()}
    return ", ".join([p.run.solver.name, *(short.get(key, f"{key} {{}}").format(value) for key, value in shown)])

"""Pictures of a sweep: runs, solver comparisons, and run times.

Side-by-side recordings are made too.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from harness.base.crew import Task, done_by
from harness.base.machine_lock import beside
from harness.base.progress import Remarks
from harness.base.workers import Limits, Lost, Tick
from harness.config.options import OPTIONS
from harness.config.sweep import RunSpec
from harness.report.references import write_bibtex


class Pictured(NamedTuple):
    """A run, and the paths of its recording and its picture."""

    run: RunSpec
    recording: Path
    picture: Path


def draw_sweep(
    name: str,
    pictured: Sequence[Pictured],
    folder: Path,
    table: pa.Table,
    say: Callable[[str], None],
    *,
    at_once: int = 1,
    older: Collection[str] = (),
) -> None:
    """Draw the pictures and comparisons that are missing or older than one of their recordings.

    Args:
        name: name of the sweep.
        pictured: runs with their recordings and pictures.
        folder: folder of the sweep's results.
        table: rows of all runs.
        say: prints a remark.
        at_once: number of drawing processes.
        older: ids of runs that were executed by other code than the current version.
    """
    write_bibtex(folder / "references.bib", table["reference"].to_pylist())
    drawn = [p for p in pictured if p.run.record and p.recording.exists()]
    wanting = [p for p in drawn if p.run.pictures and _stale(p.picture, [p.recording])]
    groups = [group for group in compared(drawn, folder) if group.old_recording or group.old_picture]

    def times() -> None:
        if any(p.run.pictures for p in pictured):
            from harness.report.timing_plot import draw_timing

            with beside(_silent):
                draw_timing(table, folder / "pictures" / "timing.png", name, older)

    missing = _loaded() if wanting or any(group.old_picture for group in groups) else None
    if missing:
        say(missing)
    if wanting and not missing:
        say(f"drawing the pictures of {len(wanting)} runs")
        _draw_runs(wanting, say, at_once, times)
    else:
        times()
    _draw_groups(groups, say, pictures=not missing)


def get_ready() -> None:
    """Load the drawing modules in this process, in parts.

    No part is loaded while a timing runs.
    """
    from harness.report import opengl

    with beside(_silent):
        opengl.begin()
        import_module("harness.report.timing_plot")  # with Matplotlib
        opengl.problem()
    for name in ("harness.record.reader", "pyvista", "harness.report.run_picture"):
        with beside(_silent):
            import_module(name)


def _loaded() -> str | None:
    """Load the drawing modules for forked processes; return why drawing is impossible, or None."""
    from harness.report import opengl

    opengl.begin()
    import_module("harness.report.run_picture")
    return opengl.problem()


def _draw_runs(
    wanting: Sequence[Pictured], say: Callable[[str], None], at_once: int, meanwhile: Callable[[], None]
) -> None:
    """Draw the pictures of runs in parallel processes, and report why a process was lost."""
    done, remarks = 0, Remarks(say)

    def tick(said: str) -> None:
        remarks(f"{done} of {len(wanting)} pictures are drawn")

    tasks = [Task(partial(_draw, p), tick, Limits()) for p in wanting]
    for number, outcome in done_by(at_once, int, [None] * len(tasks), lambda number: tasks[number], meanwhile):
        done += 1
        if isinstance(outcome, Lost):
            say(f"{wanting[number].picture} is not drawn: its process {outcome}")


def _draw_groups(groups: Sequence[Compared], say: Callable[[str], None], *, pictures: bool) -> None:
    """Create the side-by-side recordings of groups, and their pictures if `pictures` is true."""
    if not groups:
        return
    from harness.record.compare import Look, side_by_side
    from harness.record.reader import read_replay
    from harness.report.comparison import draw_comparison
    from harness.report.style import shades

    remarks = Remarks(say)
    for number, group in enumerate(groups):
        remarks(f"{number} of {len(groups)} comparisons of solvers are drawn")
        with beside(_silent):
            if group.old_recording:
                found = shades((name, p.run.solver.name) for name, p in group.runs.items())
                looks = {name: Look(mark.color) for name, mark in found.items()}
                side_by_side(group.recording, group.recordings, group.label.replace("-", " "), looks)
            if group.old_picture and pictures:
                draw_comparison({name: read_replay(path) for name, path in group.recordings.items()}, group.picture)


def _draw(p: Pictured, tick: Tick) -> None:
    from harness.record.reader import read_replay
    from harness.report.run_picture import draw_run

    camera = p.run.scene.camera
    with beside(tick):
        draw_run(read_replay(p.recording), p.picture, camera=(camera.azimuth, camera.elevation) if camera else None)


def _silent(said: str) -> None:
    pass


def _stale(made: Path, sources: Iterable[Path]) -> bool:
    """Return whether a file is missing, or older than one of its sources."""
    return not made.exists() or any(made.stat().st_mtime_ns < source.stat().st_mtime_ns for source in sources)


@dataclass(frozen=True, slots=True)
class Compared:
    """Runs that differ only in their solver or its settings.

    `runs` has them by these differences; the paths are those of the files that compare them.
    """

    label: str
    runs: dict[str, Pictured]
    recording: Path
    picture: Path

    @property
    def recordings(self) -> dict[str, Path]:
        """The recordings of the runs by label."""
        return {name: p.recording for name, p in self.runs.items()}

    @property
    def old_recording(self) -> bool:
        """Whether the side-by-side recording has to be made."""
        return _stale(self.recording, self.recordings.values())

    @property
    def old_picture(self) -> bool:
        """Whether the comparison picture has to be drawn."""
        return next(iter(self.runs.values())).run.pictures and _stale(self.picture, self.recordings.values())


def compared(drawn: list[Pictured], folder: Path) -> list[Compared]:
    """Group runs by scene and size; only groups of two or more runs are returned."""
    alike: dict[str, list[Pictured]] = {}
    for p in drawn:
        alike.setdefault(f"{p.run.scene_name}-{p.run.size}", []).append(p)
    return [
        Compared(
            label,
            {_distinct(p, some): p for p in some},
            folder / "recordings" / f"{label}-solvers.rrd",
            folder / "pictures" / f"{label}-solvers.png",
        )
        for label, some in alike.items()
        if len(some) > 1
    ]


def _distinct(p: Pictured, group: list[Pictured]) -> str:
    """Return the solver's name with its varying parameters and options.

    These are the ones in which the group's runs of this solver differ.
    """

    def settings(run: RunSpec) -> dict[str, Any]:
        return {**run.solver.parameters, **{option: getattr(run, option) for option in OPTIONS}}

    own = [settings(other.run) for other in group if other.run.solver.name == p.run.solver.name]
    varied = [(k, v) for k, v in settings(p.run).items() if any(k not in other or other[k] != v for other in own)]
    short = {name: option.short for name, option in OPTIONS.items()}
    return ", ".join([p.run.solver.name, *(short.get(k, f"{k} {{}}").format(v) for k, v in varied)])

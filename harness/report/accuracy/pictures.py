"""A picture of the mesh of each frozen step, the last iterate of a solve that was recorded."""

from __future__ import annotations

from pathlib import Path

from harness.report import opengl
from harness.report.accuracy.measured import Curve, Measurements, Problem


def draw_meshes(table: Measurements, results: Path, folder: Path) -> dict[str, Path]:
    """The pictures that could be drawn, by the digest of their problem; of the solve that came nearest the minimum.

    Where the system cannot draw, or nothing was recorded, there are none.
    """
    if opengl.problem() is not None:
        return {}
    from harness.record.reader import read_replay  # slow to load, and most results hold no recordings
    from harness.report.run_picture import draw_run

    drawn: dict[str, Path] = {}
    for problem in table.problems:
        if best := nearest(table, problem, results):
            path = place(problem, folder)
            path.parent.mkdir(parents=True, exist_ok=True)
            draw_run(read_replay(results / best.recording, [-1]), path)
            drawn[problem.digest] = path
    return drawn


def place(problem: Problem, folder: Path) -> Path:
    """Where the picture of a problem's mesh lies."""
    return folder / f"{problem.scene}-{problem.size}-{problem.moment}-{problem.digest}.png"


def nearest(table: Measurements, problem: Problem, results: Path) -> Curve | None:
    """Of the solves of a problem whose recordings are there, the one that came nearest the lowest minimum."""
    recorded = [c for c in table.curves if c.problem is problem and c.recording and (results / c.recording).is_file()]
    return min(recorded, key=lambda curve: (curve.status != "ok", curve.gap[-1]), default=None)

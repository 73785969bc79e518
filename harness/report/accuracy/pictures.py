"""Pictures of the mesh of each step snapshot: the last iterate of a recorded solve."""

from __future__ import annotations

from pathlib import Path

from harness.report import opengl
from harness.report.accuracy.measured import Curve, Measurements, Problem


def draw_meshes(table: Measurements, results: Path, folder: Path) -> dict[str, Path]:
    """Draw the mesh of each problem from its closest recorded solve.

    This is the solve that came closest to the minimum.

    Args:
        table: data of an accuracy measurement.
        results: folder of the results.
        folder: folder that the pictures are written to.
    Returns: the pictures by the digest of their problem; empty if the system cannot draw or nothing was recorded.
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
    """Return the path of the picture of a problem's mesh."""
    return folder / f"{problem.scene}-{problem.size}-{problem.moment}-{problem.digest}.png"


def nearest(table: Measurements, problem: Problem, results: Path) -> Curve | None:
    """Find the recorded solve of a problem closest to the lowest minimum.

    The result is None if no solve was recorded.

    Args:
        table: data of an accuracy measurement.
        problem: step snapshot.
        results: folder of the results, which contains the recordings.
    """
    recorded = [c for c in table.curves if c.problem is problem and c.recording and (results / c.recording).is_file()]
    return min(recorded, key=lambda curve: (curve.status != "ok", curve.gap[-1]), default=None)

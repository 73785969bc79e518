"""A picture of the mesh of each frozen step, the last iterate of a solve that was recorded."""

from __future__ import annotations

from pathlib import Path

from harness.report import opengl
from harness.report.accuracy.measured import Measurements


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
        recorded = [
            curve
            for curve in table.curves
            if curve.problem is problem and curve.recording and (results / curve.recording).is_file()
        ]
        if recorded:
            best = min(recorded, key=lambda curve: (curve.status != "ok", curve.gap[-1]))
            path = folder / f"{problem.scene}-{problem.size}-{problem.moment}-{problem.digest}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            draw_run(read_replay(results / best.recording, [-1]), path)
            drawn[problem.digest] = path
    return drawn

"""Pictures of the mesh of each step snapshot: the last iterate of a recorded solve."""

from __future__ import annotations

from pathlib import Path

from springbench.harness.report import opengl_probe
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, ConvergenceCurve, SnapshotProblem


def draw_snapshot_meshes(table: AccuracyData, results: Path, folder: Path) -> dict[str, Path]:
    """Draw the mesh of each problem from its closest recorded solve.

    This is the solve with the smallest gap to the minimum.

    Args:
        table: data of an accuracy measurement.
        results: folder of the results.
        folder: folder that the pictures are written to.

    Returns:
        The pictures by the digest of their problem; empty if the system cannot draw or nothing was recorded.
    """
    if opengl_probe.find_opengl_problem() is not None:
        return {}
    from springbench.harness.recording.recording_reader import (
        read_replay,  # slow to load, and most results contain no recordings
    )
    from springbench.harness.report.run_picture import draw_run_picture

    drawn: dict[str, Path] = {}
    for problem in table.problems:
        if best := find_closest_solve(table, problem, results):
            path = snapshot_picture_path(problem, folder)
            path.parent.mkdir(parents=True, exist_ok=True)
            draw_run_picture(read_replay(results / best.recording_path, [-1]), path)
            drawn[problem.problem_digest] = path
    return drawn


def snapshot_picture_path(problem: SnapshotProblem, folder: Path) -> Path:
    """Return the path of the picture of a problem's mesh.

    Args:
        problem: step snapshot, whose scene, size, name and digest make the file name.
        folder: folder of the pictures.
    """
    return folder / f"{problem.scene}-{problem.size}-{problem.snapshot}-{problem.problem_digest}.png"


def find_closest_solve(table: AccuracyData, problem: SnapshotProblem, results: Path) -> ConvergenceCurve | None:
    """Find the recorded solve of a problem closest to the lowest minimum.

    The result is None if no solve was recorded.

    Args:
        table: data of an accuracy measurement.
        problem: step snapshot.
        results: folder of the results, which contains the recordings.
    """
    recorded = [
        c for c in table.curves if c.problem is problem and c.recording_path and (results / c.recording_path).is_file()
    ]
    return min(recorded, key=lambda curve: (curve.status != "ok", curve.gap[-1]), default=None)

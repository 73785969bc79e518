"""Picture of a mesh file, with the findings of its checks marked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from springbench.harness.execution import machine_info
from springbench.harness.recording.local_origin import compute_local_origin, store_relative
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.recording.strain_scale import DEFAULT_STRAIN_RANGE
from springbench.harness.report.scene_preview import MarkedPoints, draw_scene_preview
from springbench.harness.scenes.mesh.mesh_checks import MeshFinding
from springbench.harness.scenes.mesh.mesh_report import MeshReport, format_finding

_MAX_MARKS = 5_000
"""Maximum number of marked points of a finding; more would cover the mesh."""
_EDGE_SHARES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
"""Places along an edge that are marked."""


def draw_mesh_findings(report: MeshReport, path: Path) -> None:
    """Draw the mesh of a report as PNG, with each finding in one colour.

    Args:
        report: the report.
        path: target file.

    Raises:
        RunFailed: if the system cannot draw.
    """
    origin, springs = compute_local_origin(report.points), report.edges
    replay = RecordingReplay(
        title=report.path.name,
        run_id="",
        frames=np.zeros(1, np.int64),
        times=np.zeros(1),
        positions=store_relative(report.points, origin)[None],
        triangles=report.triangles,
        springs=springs,
        rest_lengths=np.linalg.norm(report.points[springs[:, 0]] - report.points[springs[:, 1]], axis=1),
        pinned_vertices=np.empty(0, np.int64),
        strain_range=DEFAULT_STRAIN_RANGE,
        scalars={},
        properties={"cpu": machine_info.describe_machine().cpu, "commit": machine_info.read_commit()},
        origin=origin,
    )
    marked, notes = list[MarkedPoints](), list[tuple[str, str]]()
    for finding in report.findings:
        points, words = _mark_places(finding, report.points - origin), format_finding(finding, report.cells)
        if len(points):
            marked.append(MarkedPoints(f"{finding.name}: {finding.num_places:,}", words, points))
        else:
            notes.append((finding.name, words))
    (_, counts), *facts = report.format_facts()
    draw_scene_preview(replay, marked, [counts], [*notes, *facts], path)


def _mark_places(finding: MeshFinding, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points (q, 3) that mark a finding.

    They are on its edges; without edges in its triangles, and without triangles at its vertices.
    """
    if len(finding.edges):
        a, b = (points[finding.edges[:, k]][:, None] for k in range(2))
        places = (a + _EDGE_SHARES[:, None] * (b - a)).reshape(-1, 3)
    elif len(finding.triangles):
        places = points[finding.triangles].mean(axis=1)
    else:
        places = points[finding.vertices]
    return places[:: -(-len(places) // _MAX_MARKS)] if len(places) else places

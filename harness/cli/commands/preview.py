"""Command `springbench preview`: preview a scene with the vertices that its effects select."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from springbench.harness.cli.shared_options import SCENE_HELP, describe_config, require_output_file
from springbench.harness.console import print_message, show_activity
from springbench.harness.execution.isolated_call import run_isolated

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from springbench.harness.config.sweep_config import RunSpec
    from springbench.harness.execution.worker_process import ProgressCallback
    from springbench.harness.recording.recorder_interface import RecordingReplay


def preview(
    scene: Annotated[Path, describe_config("SCENE", SCENE_HELP)],
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default size by default.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Picture to write (.png); SCENE.png by default.")
    ] = None,
) -> None:
    """Draw a scene at its start, and list selected vertices and possible selectors."""
    path = output or Path(f"{scene.stem}.png")
    require_output_file(path, ".png", "--output")

    show_activity("drawing the scene")
    from springbench.harness.config.config_loader import load_scene_run
    from springbench.harness.config.user_code import DEFAULT_LOAD_LIMITS
    from springbench.harness.execution.early_worker import run_in_early_worker
    from springbench.harness.execution.progress_events import ignore_progress
    from springbench.harness.execution.worker_process import TaskLimits

    run = load_scene_run(scene, size)
    content = run_isolated(partial(_describe_scene, run), run.find_plugins(), TaskLimits(*DEFAULT_LOAD_LIMITS))
    run_in_early_worker(partial(_draw_preview, content, path), ignore_progress)
    for line in (*content.lines, f"the picture is {path}"):
        print_message(line)


class _PreviewContent(NamedTuple):
    """Content of a preview, and messages about the selections."""

    replay: RecordingReplay
    marks: list[tuple[str, str, NDArray[np.float64]]]
    facts: list[str]
    notes: list[tuple[str, str]]
    camera: tuple[float, float] | None
    lines: list[str]


def _draw_preview(content: _PreviewContent, path: Path, tick: ProgressCallback) -> None:
    from springbench.harness.report.scene_preview import MarkedPoints, draw_scene_preview  # with PyVista

    marks = [MarkedPoints(*mark) for mark in content.marks]
    draw_scene_preview(content.replay, marks, content.facts, content.notes, path, camera=content.camera)


def _describe_scene(run: RunSpec, tick: ProgressCallback) -> _PreviewContent:
    """Build the scene of a run, and describe it at its start."""
    import numpy as np
    from springbench.harness.execution import machine_info
    from springbench.harness.recording.local_origin import compute_local_origin, store_relative
    from springbench.harness.recording.recorder_interface import (
        RecordingReplay,
        build_obstacles_property,
        list_obstacles,
    )
    from springbench.harness.recording.strain_scale import DEFAULT_STRAIN_RANGE
    from springbench.harness.scenes.scene_builder import build_scene
    from springbench.harness.scenes.vertex_selectors import find_selections

    scene, lines = run.scene.load_plugins(), list[str]()
    made = build_scene(scene, run.size)
    mesh, choices = made.mesh, list[tuple[str, str, Any]]()
    for k, effect in enumerate(scene.effects):
        for key, selection in find_selections(effect):
            name = f"effects[{k}] {effect.kind}{f': {key}' if key else ''}"
            choices.append((name, selection.describe_selection(), selection.select_vertices(mesh, name)))
    notes = _list_selectors(mesh)
    for name, description, vertices in choices:
        some = ", ".join(map(str, vertices[:8].tolist())) + (", ..." if len(vertices) > 8 else "")
        lines.append(f"{name}: {len(vertices)} vertices ({description}): {some}")
    for kind, words in notes:
        lines.append(f"{kind}: {words}")
    origin = compute_local_origin(mesh.rest_positions)
    replay = RecordingReplay(
        title=f"{run.scene_name}, size {run.size}" if run.size else run.scene_name,
        run_id="",
        frames=np.zeros(1, np.int64),
        times=np.zeros(1),
        positions=store_relative(made.start.compute_positions(mesh.rest_positions), origin)[None],
        triangles=mesh.triangles,
        springs=made.all_springs.edges,
        rest_lengths=made.all_springs.rest_length,
        pinned_vertices=np.empty(0, np.int64),
        strain_range=run.strain_range or DEFAULT_STRAIN_RANGE,
        scalars={},
        properties={
            **build_obstacles_property(list_obstacles(scene.effects)),
            "cpu": machine_info.describe_machine().cpu,
            "commit": machine_info.read_commit(),
        },
        origin=origin,
    )
    facts = [
        f"{len(mesh.rest_positions):,} vertices, {len(mesh.triangles):,} triangles, "
        f"{len(made.all_springs.edges):,} springs",
        f"{made.system.mass.sum():.4g} kg",
        "at the start",
    ]
    named = [i for _, _, vertices in choices for i in vertices.tolist()]
    facts += ["what is chosen twice has the later colour"] if len(set(named)) < len(named) else []
    camera, positions = scene.camera, replay.positions[0].astype(np.float64)
    marks = [
        (f"{name}: {len(vertices):,} {'vertex' if len(vertices) == 1 else 'vertices'}", words, positions[vertices])
        for name, words, vertices in choices
    ]
    angles = (camera.azimuth, camera.elevation) if camera else None
    return _PreviewContent(replay, marks, facts, notes, angles, lines)


def _list_selectors(mesh: Any) -> list[tuple[str, str]]:
    """List a mesh's selectors: parts, boundary loops with lengths, holes, numbers of its file."""
    from springbench.harness.scenes.mesh.boundary_loops import find_boundary_loops

    rims = find_boundary_loops(mesh)
    found = {
        "parts (at)": [f"{name} {len(part):,}" for name, part in sorted(mesh.parts.items())],
        "boundary loops (boundary_loops)": [f"{k}: {rim.length:.3g} m" for k, rim in enumerate(rims)],
        "holes": [f"{k}: {rim.length:.3g} m" for k, rim in enumerate(rim for rim in rims if rim.is_hole)],
        "numbers (attribute)": [f"{name} {x.min():.3g} to {x.max():.3g}" for name, x in mesh.attributes.items()],
    }
    return [(kind, ", ".join(words)) for kind, words in found.items() if words]

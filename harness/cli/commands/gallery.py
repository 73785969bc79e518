"""Command `springbench gallery`: simulate scenes and draw their last frames on one sheet."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from springbench.harness.cli.shared_options import describe_config, require_output_file
from springbench.harness.console import print_message
from springbench.harness.execution.isolated_call import run_isolated

if TYPE_CHECKING:
    from springbench.harness.config.sweep_config import RunSpec
    from springbench.harness.execution.worker_process import ProgressCallback

_SOLVER, _TOLERANCE = "hybrid", "1e-4"


def gallery(
    scenes: Annotated[
        list[Path], describe_config("SCENES...", "Scenes (YAML) in the order of the sheet, or names of shipped ones.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture to write (.png).")] = Path("scenes.png"),
    title: Annotated[str, typer.Option(help="Title of the sheet.")] = "Scenes coloured by strain",
) -> None:
    """Draw a sheet of scenes, each at its default size and last frame."""
    from springbench.harness.report.gallery_sheet import draw_gallery_sheet

    require_output_file(output, ".png", "--output")
    tiles: list[Any] = []
    for path in scenes:
        tiles.append(_build_tile(path))
        print_message(f"[{len(tiles)}/{len(scenes)}] {tiles[-1].name}")
    draw_gallery_sheet(tiles, output, title, [f"at the last frame, by {_SOLVER} to {_TOLERANCE}"])
    print_message(f"the sheet is {output}")


def _build_tile(path: Path) -> Any:
    """Simulate a scene and build its tile."""
    from springbench.harness.config.config_loader import load_config
    from springbench.harness.execution.worker_process import TaskLimits

    run = load_config(path, solvers=[_SOLVER]).list_runs()[0]
    return run_isolated(partial(_simulate_tile, run), run.find_plugins(), TaskLimits(run.time_limit, run.memory_limit))


def _simulate_tile(run: RunSpec, tick: ProgressCallback) -> Any:
    import numpy as np
    from springbench.harness.execution import machine_info
    from springbench.harness.recording.local_origin import compute_local_origin, store_relative
    from springbench.harness.recording.recorder_interface import (
        INTERSECTION_FREE_PROPERTY,
        RecordingReplay,
        build_obstacles_property,
        list_obstacles,
    )
    from springbench.harness.recording.strain_scale import DEFAULT_STRAIN_RANGE
    from springbench.harness.report.gallery_sheet import SceneTile
    from springbench.harness.scenes.scene_builder import build_scene
    from springbench.harness.simulation.time_loop import build_initial_state, prepare
    from springbench.harness.simulation.timing_pass import SteppingSettings, iterate_steps
    from springbench.solvers.model.step_problem import StopRule
    from springbench.solvers.registry import SOLVERS, load_target

    scene = build_scene(run.scene, run.size)
    solver = load_target(SOLVERS[_SOLVER])()
    first = p = build_initial_state(scene).motion.positions
    with machine_info.limit_threads(1):
        settings = SteppingSettings(StopRule(200, float(_TOLERANCE)), run.initial_guess, run.frames, 1)
        for step in iterate_steps(scene, prepare(scene, solver), settings):
            p = step.positions
    origin = compute_local_origin(scene.mesh.rest_positions)
    replay = RecordingReplay(
        title=run.scene_name,
        run_id="",
        frames=np.array([0, run.frames]),
        times=np.array([0.0, scene.compute_time(run.frames)]),
        positions=np.stack([store_relative(at, origin) for at in (first, p)]),
        triangles=scene.mesh.triangles,
        springs=scene.all_springs.edges,
        rest_lengths=scene.all_springs.rest_length,
        pinned_vertices=scene.system.pins.vertices,
        strain_range=run.strain_range or DEFAULT_STRAIN_RANGE,
        scalars={},
        properties={
            **build_obstacles_property(list_obstacles(run.scene.effects)),
            INTERSECTION_FREE_PROPERTY: scene.has_self_contact,
            "cpu": machine_info.describe_machine().cpu,
            "commit": machine_info.read_commit(),
        },
        origin=origin,
    )
    camera = run.scene.camera
    return SceneTile(
        replay=replay,
        mass=scene.system.mass,
        name=run.scene_name.replace("-", " "),
        angles=(camera.azimuth, camera.elevation) if camera else None,
    )

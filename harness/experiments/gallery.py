"""Command `springbench gallery`: simulate scenes and draw their last frames on one sheet."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from harness.base.console import say
from harness.base.errors import InputError

_SOLVER, _TOLERANCE = "hybrid", "1e-4"


def gallery(
    scenes: Annotated[list[Path], typer.Argument(help="Scenes (YAML), in the order of the sheet.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The picture to write (.png).")] = Path("scenes.png"),
) -> None:
    """Draw a sheet of scenes, each at its default size and last frame."""
    from harness.report.contact_sheet import draw_sheet

    if output.suffix != ".png" or not output.parent.is_dir() or output.is_dir():
        raise InputError(f"--output: came {output}; wanted a file that ends in .png, in a folder that exists")
    tiles: list[Any] = []
    for path in scenes:
        tiles.append(_tile(path))
        say(f"[{len(tiles)}/{len(scenes)}] {tiles[-1].name}")
    draw_sheet(tiles, output, [f"at the last frame, by {_SOLVER} to {_TOLERANCE}", *_strains(tiles)])
    say(f"the sheet is {output}")


def _strains(tiles: list[Any]) -> list[str]:
    """Return the legend of the strain colours if all tiles share one range."""
    ranges = {tile.replay.strain_range for tile in tiles}
    return [f"strain: blue −{100 * ranges.pop():g} % or more, orange as much stretched"] if len(ranges) == 1 else []


def _tile(path: Path) -> Any:
    """Simulate a scene and build its tile."""
    import numpy as np

    from harness.base import machine
    from harness.config.load import load_any
    from harness.record.base import SELF_CONTACT, Replay
    from harness.record.local_origin import local_origin, store_relative
    from harness.record.obstacles import declared, listed
    from harness.record.shading import STRAIN_RANGE
    from harness.report.contact_sheet import Tile
    from harness.scenes.bind import build
    from harness.simulation.measure import Settings, steps
    from harness.simulation.step import prepare, start
    from solvers.problem import StopRule
    from solvers.registry import SOLVERS, load

    run = load_any(path, solvers=[_SOLVER]).runs()[0]
    scene = build(run.scene, run.size)
    solver = load(SOLVERS[_SOLVER])()
    first = p = start(scene).now.positions
    with machine.pinned_threads(1):
        settings = Settings(StopRule(200, float(_TOLERANCE)), run.first_guess, run.frames, 1)
        for step in steps(scene, prepare(scene, solver), settings):
            p = step.positions
    origin = local_origin(scene.mesh.rest)
    replay = Replay(
        title=run.scene_name,
        run_id="",
        frames=np.array([0, run.frames]),
        times=np.array([0.0, scene.time(run.frames)]),
        positions=np.stack([store_relative(at, origin) for at in (first, p)]),
        triangles=scene.mesh.triangles,
        springs=scene.springs.edges,
        rest_lengths=scene.springs.rest_length,
        pinned=scene.system.pins.vertices,
        strain_range=run.strain_range or STRAIN_RANGE,
        scalars={},
        properties={
            **declared(listed(run.scene.effects)),
            SELF_CONTACT: scene.self_contact,
            "cpu": machine.describe().cpu,
            "commit": machine.commit(),
        },
        origin=origin,
    )
    kinds = dict.fromkeys(effect.kind for effect in run.scene.effects)
    camera = run.scene.camera
    return Tile(
        replay=replay,
        mass=scene.system.mass,
        name=run.scene_name.replace("-", " "),
        effects=", ".join(kinds).replace("-", " "),
        angles=(camera.azimuth, camera.elevation) if camera else None,
    )

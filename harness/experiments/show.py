"""Command `springbench show`: preview a scene with the vertices that its effects select."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness.base.console import say
from harness.base.errors import InputError
from harness.experiments.apart import apart

if TYPE_CHECKING:
    from harness.base.worker import Tick
    from harness.config.sweep import RunSpec


def show(
    scene: Annotated[Path, typer.Argument(help="A scene (YAML), or an assignment's scene (JSON).")],
    size: Annotated[int | None, typer.Option(help="The mesh's size; the scene's default size if left out.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The picture to write (.png); SCENE.png here if left out.")
    ] = None,
) -> None:
    """Draw a scene at its start, and list selected vertices and possible selectors."""
    path = output or Path(f"{scene.stem}.png")
    if path.suffix != ".png" or not path.parent.is_dir() or path.is_dir():
        raise InputError(f"--output: came {path}; wanted a file that ends in .png, in a folder that exists")

    from harness.config.load import load_any

    run = load_any(scene, sizes=() if size is None else (size,)).runs()[0]
    for line in apart(partial(_shown, run, path), run.own()):
        say(line)


def _shown(run: RunSpec, path: Path, tick: Tick) -> list[str]:
    """Draw the scene of a run at its start, and return the messages about it."""
    import numpy as np

    from harness.base import machine
    from harness.record.base import Replay
    from harness.record.local_origin import local_origin, store_relative
    from harness.record.obstacles import declared, listed
    from harness.record.shading import STRAIN_RANGE
    from harness.report.shown import Choice, draw_scene
    from harness.scenes.bind import build
    from harness.scenes.selection import selections
    from harness.simulation.step import start

    scene, told = run.scene.opened(), list[str]()
    made = build(scene, run.size)
    mesh, choices = made.mesh, list[Choice]()
    for k, effect in enumerate(scene.effects):
        for key, selection in selections(effect):
            name = f"effects[{k}] {effect.kind}{f': {key}' if key else ''}"
            choices.append(Choice(name, selection.told(), selection.chosen(mesh, name)))
    notes = _notes(mesh)
    for one in choices:
        some = ", ".join(map(str, one.vertices[:8].tolist())) + (", ..." if len(one.vertices) > 8 else "")
        told.append(f"{one.name}: {len(one.vertices)} vertices ({one.how}): {some}")
    for kind, words in notes:
        told.append(f"{kind}: {words}")
    origin = local_origin(mesh.rest)
    replay = Replay(
        title=f"{run.scene_name}, size {run.size}" if run.size else run.scene_name,
        run_id="",
        frames=np.zeros(1, np.int64),
        times=np.zeros(1),
        positions=store_relative(start(made).now.positions, origin)[None],
        triangles=mesh.triangles,
        springs=made.springs.edges,
        rest_lengths=made.springs.rest_length,
        pinned=np.empty(0, np.int64),
        strain_range=run.strain_range or STRAIN_RANGE,
        scalars={},
        properties={
            **declared(listed(scene.effects)),
            "cpu": machine.describe().cpu,
            "commit": machine.commit(),
        },
        origin=origin,
    )
    facts = [
        f"{len(mesh.rest):,} vertices, {len(mesh.triangles):,} triangles, {len(made.springs.edges):,} springs",
        f"{made.system.mass.sum():.4g} kg",
        "at the start",
    ]
    named = [i for one in choices for i in one.vertices.tolist()]
    facts += ["what is chosen twice has the later colour"] if len(set(named)) < len(named) else []
    camera = scene.camera
    draw_scene(replay, choices, facts, notes, path, camera=(camera.azimuth, camera.elevation) if camera else None)
    return [*told, f"the picture is {path}"]


def _notes(mesh: Any) -> list[tuple[str, str]]:
    """List a mesh's selectors: parts, boundary loops with lengths, holes, numbers of its file."""
    from harness.scenes.mesh.boundary import loops

    rims = loops(mesh)
    found = {
        "parts (at)": [f"{name} {len(part):,}" for name, part in sorted(mesh.parts.items())],
        "boundary loops (loops)": [f"{k}: {rim.length:.3g} m" for k, rim in enumerate(rims)],
        "holes": [f"{k}: {rim.length:.3g} m" for k, rim in enumerate(rim for rim in rims if rim.hole)],
        "numbers (attribute)": [f"{name} {x.min():.3g} to {x.max():.3g}" for name, x in mesh.attributes.items()],
    }
    return [(kind, ", ".join(words)) for kind, words in found.items() if words]

"""Command `springbench repeat`: export a simulation as a script for an external engine.

The simulation is a point of an accuracy config.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness.base.console import aligned, say
from harness.base.errors import InputError, Mistake, RunFailed

if TYPE_CHECKING:
    from harness.config.accuracy import WorkSpec
    from harness.scenes.bind import Scene


def repeat(
    config: Annotated[Path, typer.Argument(help="An accuracy config (YAML).")],
    point: Annotated[str, typer.Argument(help="A point's name, or its last letters; all are listed if left out.")] = "",
    output: Annotated[Path, typer.Option("-o", "--output", help="The folder for the script and its data.")] = Path(),
) -> None:
    """Export a script that repeats one simulation with an external engine alone."""
    from harness.config.accuracy_load import load_accuracy
    from solvers.registry import EVERY, load

    engines = {spec.label(): spec for spec in load_accuracy(config).work}
    engines = {label: spec for label, spec in engines.items() if hasattr(load(EVERY[spec.solver.name]), "script")}
    if not point:
        for line in aligned(
            [("point", "scene", "integrator", "substeps", "parameters"), *map(_line, engines.values())]
        ):
            print(line)
        return
    found = [label for label in engines if label.endswith(point)]
    if len(found) != 1:
        problem = (
            f"came {point!r}, which {len(found)} points of outside engines end with; `springbench repeat {config}` "
        )
        raise InputError(Mistake(f"{problem}lists them", key="POINT"))
    if output.exists() and not output.is_dir():
        raise InputError(
            Mistake(f"{output} is a file; expected a folder, which is made if it is missing", key="--output")
        )
    texts = _written(found[0], engines[found[0]], output)
    print(texts[f"{found[0]}.py"], end="")
    say(f"{', '.join(texts)} and {found[0]}.npz are in {output.resolve()}: run `python {found[0]}.py` there")


def _line(spec: WorkSpec) -> tuple[str, ...]:
    words = " ".join(f"{key}={value}" for key, value in spec.solver.parameters.items())
    return spec.label(), spec.case.title, spec.case.integrator, str(spec.options["iterations"]), words


def _written(name: str, spec: WorkSpec, folder: Path) -> dict[str, str]:
    """Write the script's files next to their data, and return their texts by name."""
    import numpy as np

    from harness.base import machine
    from harness.reference.frozen import bind
    from harness.simulation.step import prepare, problem, simulate, start
    from solvers.engines.base import Engine, Network
    from solvers.problem import StopRule, Unsupported
    from solvers.registry import EVERY, load

    scene = bind(spec.case.scene, spec.case.size, spec.case.integrator)
    if acts := _between(scene):
        raise RunFailed(f"{name}: between frames springbench sets {' and '.join(acts)}; take another point")
    engine: Engine = load(EVERY[spec.solver.name])(**spec.solver.parameters)
    frames, substeps = round(spec.horizon / spec.case.scene.time_step), int(spec.options["iterations"])
    begun = problem(scene, start(scene), "current")
    try:
        network = Network.of(scene.system, engine.name, damps=engine.damps)
        texts = engine.script(name, network, begun, substeps, frames)
        with machine.pinned_threads(1):
            run = simulate(scene, prepare(scene, engine), StopRule(substeps), first_guess="current", frames=frames)
            end = [step.positions for step in run][-1]
    except Unsupported as refused:
        raise RunFailed(str(refused)) from refused
    arrays: dict[str, Any] = {**network.arrays(begun), "end": end}
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / f"{name}.npz", **arrays)
    for file, text in texts.items():
        (folder / file).write_text(text)
    return texts


def _between(scene: Scene) -> list[str]:
    """List the quantities that springbench changes in the engine before each frame."""
    there = (
        ("velocities that drag has slowed (with the integrator own it is a force of the engine's)", scene.filters),
        ("forces that change", scene.forces),
        ("pins that move", scene.moving),
    )
    return [what for what, some in there if some]

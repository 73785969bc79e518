"""Command `springbench export-script`: export a point of an accuracy config as an engine script.

The script repeats the simulation with the external engine alone.
"""

from __future__ import annotations

from functools import partial
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from springbench.harness.cli.shared_options import describe_config
from springbench.harness.console import format_plain_table, print_message
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.execution.isolated_call import run_isolated

if TYPE_CHECKING:
    from springbench.harness.config.accuracy_config import WorkSpec
    from springbench.harness.execution.worker_process import ProgressCallback
    from springbench.harness.scenes.scene_builder import Scene
    from springbench.solvers.external.external_engine import ExternalEngine, ScriptFrames
    from springbench.solvers.model.step_problem import Positions


def export_script(
    config: Annotated[Path, describe_config("CONFIG", "Accuracy config (YAML), or name of a shipped one.")],
    point: Annotated[str, typer.Argument(help="Name of a point, or its last characters; lists all by default.")] = "",
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the script and its data.")] = Path(),
) -> None:
    """Export a script that repeats one simulation with an external engine alone."""
    from springbench.harness.config.accuracy_loader import load_accuracy
    from springbench.harness.config.user_code import DEFAULT_LOAD_LIMITS
    from springbench.harness.execution.worker_process import TaskLimits
    from springbench.solvers.registry import OPTIONAL_SOLVERS, is_engine, load_target

    engines = {spec.build_file_stem(): spec for spec in load_accuracy(config).work}
    engines = {
        label: spec
        for label, spec in engines.items()
        if spec.solver.name in OPTIONAL_SOLVERS and is_engine(load_target(OPTIONAL_SOLVERS[spec.solver.name]))
    }
    if not point:
        for line in format_plain_table(
            [("point", "scene", "integrator", "substeps", "parameters"), *map(_format_point, engines.values())]
        ):
            print(line)
        return
    found = [label for label in engines if label.endswith(point)]
    if len(found) != 1:
        problem = (
            f"got {point!r}, which {len(found)} points of outside engines end "
            f"with; `springbench export-script {config}` "
        )
        raise InputError(InputMistake(f"{problem}lists them", key="POINT"))
    if output.exists() and not output.is_dir():
        raise InputError(
            InputMistake(f"{output} is a file; expected a folder, which is made if it is missing", key="--output")
        )
    spec = engines[found[0]]
    texts = run_isolated(
        partial(_write_script, found[0], spec, output), spec.find_plugins(), TaskLimits(*DEFAULT_LOAD_LIMITS)
    )
    print(texts[f"{found[0]}.py"], end="")
    print_message(f"{', '.join(texts)} and {found[0]}.npz are in {output.resolve()}: run `python {found[0]}.py` there")


def _format_point(spec: WorkSpec) -> tuple[str, ...]:
    words = " ".join(f"{key}={value}" for key, value in spec.solver.parameters.items())
    return spec.build_file_stem(), spec.case.title, spec.case.integrator, str(spec.options["max_iterations"]), words


def _write_script(name: str, spec: WorkSpec, folder: Path, tick: ProgressCallback) -> dict[str, str]:
    """Write the script's files next to their data, and return their texts by name."""
    from springbench.harness.reference.step_snapshot import build_exact_scene
    from springbench.solvers.registry import SOLVER_TABLE, load_target

    scene = build_exact_scene(spec.case.scene, spec.case.size, spec.case.integrator)
    engine: ExternalEngine = load_target(SOLVER_TABLE[spec.solver.name])(**spec.solver.parameters)
    frames, substeps = round(spec.t_end / spec.case.scene.time_step), int(spec.options["max_iterations"])
    return write_engine_script(name, scene, engine, substeps, frames, folder)


def write_engine_script(
    name: str,
    scene: Scene,
    engine: ExternalEngine,
    substeps: int,
    frames: int,
    folder: Path,
    end: Positions | None = None,
) -> dict[str, str]:
    """Write a script that repeats a simulation with an engine alone.

    Args:
        name: stem of the files.
        scene: scene whose step is a frame.
        engine: engine with its parameters.
        substeps: substeps of a frame.
        frames: number of frames.
        folder: folder of the files, made if it is missing.
        end: positions (n, 3) [m] in which the simulation ends; simulated if None.

    Returns:
        The texts of the files by name.

    Raises:
        RunFailed: the script cannot repeat what changes between frames, or the engine does not support the scene.
    """
    import numpy as np
    from springbench.harness.execution import machine_info
    from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
    from springbench.solvers.external.external_engine import EngineNetwork
    from springbench.solvers.model.step_problem import StopRule, Unsupported

    driven = _describe_frames(name, scene, substeps, frames)
    begun = build_problem(scene, build_initial_state(scene), "previous")
    try:
        network = EngineNetwork.from_system(scene.system, engine.solver_name, supports_damping=engine.supports_damping)
        texts = engine.write_script(name, network, begun, driven)
        if end is None:
            with machine_info.limit_threads(1):
                ready, stop = prepare(scene, engine), StopRule(substeps)
                run = simulate_scene(scene, ready, stop, initial_guess="previous", frames=frames)
                end = [step.positions for step in run][-1]
    except Unsupported as refused:
        raise RunFailed(str(refused)) from refused
    arrays: dict[str, Any] = {**network.export_arrays(begun), "end": end}
    if driven.is_driven:
        arrays["pins"] = np.array([scene.compute_pin_targets(scene.compute_time(k)) for k in range(frames + 1)])
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / f"{name}.npz", **arrays)
    for file, text in texts.items():
        (folder / file).write_text(text)
    return texts


def _describe_frames(name: str, scene: Scene, substeps: int, frames: int) -> ScriptFrames:
    """Describe what springbench changes between frames; raise RunFailed for what scripts cannot repeat."""
    from springbench.solvers.external.external_engine import ScriptFrames
    from springbench.solvers.model.velocity_filters import ExponentialDecay

    decays = [one.decay_factor for one in scene.velocity_filters if isinstance(one, ExponentialDecay)]
    there = (
        ("velocities that air drag has slowed", len(decays) < len(scene.velocity_filters)),
        ("forces that change", scene.varying_forces),
    )
    if acts := [what for what, some in there if some]:
        raise RunFailed(f"{name}: between frames springbench sets {' and '.join(acts)}; take another point")
    return ScriptFrames(frames, substeps, prod(decays), bool(scene.pin_motions))

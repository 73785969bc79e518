"""Command `springbench convergence`: check whether given settings are converged."""

from __future__ import annotations

import csv
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from springbench.harness.atomic_files import atomic_write
from springbench.harness.cli.shared_options import SCENE_HELP, ResultsOption, describe_config
from springbench.harness.console import print_message, show_activity
from springbench.harness.errors import InputError, InputMistake, RunFailed

if TYPE_CHECKING:
    from collections.abc import Callable

    from springbench.harness.config.sweep_config import SolverSpec
    from springbench.harness.experiments.setting_convergence import SettingSimulator
    from springbench.harness.results.setting_verdict import ConvergenceStudy, StepSetting
    from springbench.harness.scenes.scene_spec import SceneSpec
    from springbench.solvers.model.step_problem import Positions


class _StudyRequest(NamedTuple):
    """Scene, solver and settings of a study, and its limits.

    Attributes:
        spec: the scene.
        name: name of the scene, after which files are named.
        size: mesh size; 0 for a mesh without sizes.
        solver: the solver.
        integrator: the integrator; the usual one of the solver if None.
        t_end: simulated time [s]; by default 1, or less if the motion is unpredictable.
        settings: given settings.
        error: relative error that counts as converged.
        num_doublings: powers of two around settings.
        time_limit: processor time of a setting [s].
        search_time: wall time after which no further setting starts [s].
    """

    spec: SceneSpec
    name: str
    size: int
    solver: SolverSpec
    integrator: str | None
    t_end: float | None
    settings: list[StepSetting]
    error: float
    num_doublings: int
    time_limit: float
    search_time: float


def convergence(
    scene: Annotated[Path, describe_config("SCENE", SCENE_HELP)],
    solver: Annotated[str, typer.Option(help="Solver, or outside engine such as mujoco or newton-physics.")],
    setting: Annotated[
        list[str] | None,
        typer.Option(
            help="Substeps of a frame x iterations of a substep, such as 2x5, or 8 where a method has no iterations; "
            "repeatable. 1x50 by default."
        ),
    ] = None,
    parameter: Annotated[list[str] | None, typer.Option(help="Parameter of the solver, KEY=VALUE; repeatable.")] = None,
    integrator: Annotated[str | None, typer.Option(help="Integrator; the usual one of the solver by default.")] = None,
    error: Annotated[float, typer.Option(help="Relative error that counts as converged.")] = 0.05,
    doublings: Annotated[
        int | None,
        typer.Option(min=1, max=4, help="Powers of two around settings; 2 around one, 1 around several."),
    ] = None,
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default size by default.")] = None,
    t_end: Annotated[
        float | None, typer.Option(help="Simulated time [s]; 1 by default, or less if the motion is unpredictable.")
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Limit of a setting's processor time [s].")] = 30.0,
    search_time: Annotated[float, typer.Option(help="Wall time after which no further setting starts [s].")] = 200.0,
    results: ResultsOption = Path("results"),
) -> None:
    """Check whether substeps x iterations of a solver or engine are converged.

    Settings around the given ones are simulated, and compared with the reference motion, to find one that is converged.
    """
    from springbench.harness.config.config_loader import load_scene
    from springbench.harness.errors import format_allowed_names
    from springbench.harness.execution.isolated_call import run_isolated
    from springbench.harness.execution.worker_process import TaskLimits
    from springbench.harness.experiments.accuracy.accuracy_units import EXTRA_WALL_SECONDS
    from springbench.harness.results.folder_ownership import claim_folder
    from springbench.harness.scenes.mesh.mesh_generator import MeshGenerator
    from springbench.solvers.model.integrators import INTEGRATOR_TABLE

    given = [_read_setting(text) for text in setting or ()]
    for key, value in (("--error", error), ("--time-limit", time_limit), ("--search-time", search_time)):
        if not 0.0 < value < 1e5:
            raise InputError(InputMistake(f"got {value:g}; expected a number above 0", key=key))
    if t_end is not None and not 0.0 < t_end <= 1e4:
        raise InputError(InputMistake(f"got {t_end:g}; expected seconds above 0, at most 10,000", key="--t-end"))
    if integrator is not None and integrator not in INTEGRATOR_TABLE:
        problem = f"got {integrator!r}; expected {format_allowed_names(integrator, INTEGRATOR_TABLE)}"
        raise InputError(InputMistake(problem, key="--integrator"))
    spec = load_scene(scene)
    spec.require_fixed_time_step()
    made = read_solver_options(scene, solver, parameter or ())
    number = (size or spec.default_size or 0) if isinstance(spec.mesh, MeshGenerator) else 0
    folder = claim_folder(results / f"convergence-{scene.stem}", scene)
    request = _StudyRequest(
        spec,
        scene.stem,
        number,
        made,
        integrator,
        t_end,
        given,
        error,
        num_doublings=doublings or (1 if len(given) > 1 else 2),
        time_limit=time_limit,
        search_time=search_time,
    )
    show_activity("measuring")
    study = run_isolated(
        partial(_study_settings, request, results, folder),
        spec.find_plugins(),
        TaskLimits(search_time + 10.0 * time_limit + EXTRA_WALL_SECONDS),
        print_message,
    )
    for line in study.describe_verdict():
        print_message(line)
    raise typer.Exit(0 if study.is_converged else 1)


def _read_setting(text: str) -> StepSetting:
    """Read a setting; raise InputError if it is invalid."""
    from springbench.harness.results.setting_verdict import MAX_SETTING, parse_setting

    try:
        return parse_setting(text)
    except ValueError:
        expected = "substeps x iterations, such as 2x5, or substeps alone, such as 8"
        problem = f"got {text[:40]!r}; expected {expected}, up to {MAX_SETTING:,} each"
        raise InputError(InputMistake(problem, key="--setting")) from None


def read_solver_options(path: Path, name: str, parameters: tuple[str, ...] | list[str]) -> SolverSpec:
    """Read a solver and its parameters from options.

    Args:
        path: file of the scene, for messages.
        name: name of the solver.
        parameters: `key=value` each; values are read as in YAML.

    Raises:
        InputError: there is no such solver, or a parameter is wrong.
    """
    from springbench.harness.config.solver_parameters import read_solvers
    from springbench.harness.errors import format_allowed_names
    from springbench.harness.schema.config_document import ConfigDocument
    from springbench.harness.schema.yaml_loader import parse_scalar
    from springbench.solvers.registry import SOLVER_TABLE

    if name not in SOLVER_TABLE:
        raise InputError(
            InputMistake(f"got {name!r}; expected {format_allowed_names(name, SOLVER_TABLE)}", key="--solver")
        )
    chosen: dict[str, Any] = {"name": name}
    for text in parameters:
        key, sign, value = text.partition("=")
        if not (key and sign and value):
            raise InputError(InputMistake(f"got {text!r}; expected KEY=VALUE", key="--parameter"))
        chosen[key] = parse_scalar(value)
    document = ConfigDocument(path, {"solvers": [chosen]})
    found = read_solvers(document)
    if document.mistakes or not found:
        raise InputError([InputMistake(one.problem, key=f"--parameter {one.key}") for one in document.mistakes])
    return found[0]


def _study_settings(
    request: _StudyRequest, results: Path, folder: Path, print_message: Callable[[str], None]
) -> ConvergenceStudy:
    """Run the study, and write its table, picture, and commands or scripts of its settings."""
    from springbench.harness.config.config_loader import find_scene_mistakes
    from springbench.harness.experiments.accuracy.accuracy_units import open_reference_store
    from springbench.harness.experiments.accuracy.method_recommendation import DEFAULT_T_END, find_default_t_end
    from springbench.harness.experiments.setting_convergence import (
        SettingSimulator,
        StudyLimits,
        complete_settings,
        study_convergence,
    )
    from springbench.harness.reference.equations_of_motion import NotIntegrable
    from springbench.harness.report.charts.setting_chart import build_setting_chart
    from springbench.harness.report.figures.chart_sheets import draw_chart_sheets

    spec, name, size, solver = request.spec.load_plugins(), request.name, request.size, request.solver
    if mistakes := find_scene_mistakes(spec, [size]):
        raise InputError(mistakes)
    given = complete_settings(request.settings, solver)
    store, growth_end = open_reference_store(results), None
    t_end = request.t_end
    if t_end is None:
        growth_end = DEFAULT_T_END
        with suppress(NotIntegrable):  # there is no reference, which the study reports
            t_end = find_default_t_end(spec.path, spec, size, request.error, store, print_message)
    simulator = SettingSimulator(spec, size, solver, request.integrator, max(t_end or DEFAULT_T_END, spec.time_step))
    study = study_convergence(
        simulator,
        given,
        store,
        request.error,
        num_doublings=request.num_doublings,
        limits=StudyLimits(request.time_limit, request.search_time, growth_end, request.t_end is not None),
        print_message=print_message,
    )
    stem = f"{name}-{size}-{solver.name}-{'-'.join(map(_format_setting, given))}"
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / f"{stem}.csv") as build_partial_path, build_partial_path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(study.results[0].columns))
        writer.writeheader()
        writer.writerows(result.columns for result in study.results)
    verb = "Is" if len(given) == 1 else "Are"
    title = f"{verb} {', '.join(map(str, given))} converged? {name} {size or ''}".rstrip() + f", {solver.name}"
    frames = f"{simulator.num_frames} frames of {spec.time_step:.6g} s"
    facts = [frames, simulator.integrator, f"errors against {study.reference}"]
    picture, *_ = draw_chart_sheets(build_setting_chart(study, title, facts), folder / "pictures" / stem)
    print_message(f"the map is {picture}, its numbers are in {folder / f'{stem}.csv'}")
    best = study.find_cheapest(request.error)
    for setting in given if best is None or best.setting in given else [*given, best.setting]:
        label, end = "given" if setting in given else "cheapest", study.find_result(setting).positions
        script_folder = folder / f"{name}-{size}-{solver.name}-{_format_setting(setting)}"
        lines = _export_setting(simulator, setting, name, script_folder, end[-1] if len(end) else None)
        print_message(f"the {label} setting, {setting}, to run it:")
        for line in lines:
            print_message(f"  {line}")
    return study


def _format_setting(setting: StepSetting) -> str:
    return str(setting).replace(" ", "")


def _export_setting(
    simulator: SettingSimulator, setting: StepSetting, name: str, folder: Path, end: Positions | None
) -> list[str]:
    """Return the lines that describe how to repeat a setting.

    They are a command of springbench or, for an external engine, the call of a script that is written to `folder`.

    Args:
        simulator: simulator of the study.
        setting: substeps and iterations.
        name: stem of the script's files.
        folder: folder of the script's files.
        end: final positions (n, 3) [m]; None if the setting failed.
    """
    import shlex

    from springbench.harness.cli.commands.export_script import write_engine_script

    spec, frames = simulator.spec, simulator.num_frames
    if not simulator.is_engine:
        given: dict[str, Any] = {"size": simulator.size or None, "solver": simulator.name}
        given |= {"integrator": simulator.integrator, "time-step": repr(spec.time_step / setting.substeps)}
        given |= {"frames": frames * setting.substeps, "max-iterations": max(1, setting.iterations)}
        parts = [part for key, value in given.items() if value is not None for part in (f"--{key}", str(value))]
        return [shlex.join(["springbench", "run", str(spec.path), *parts])]
    scene, engine, _, _ = simulator.build_step(spec, setting)
    step = f"{simulator.name}: steps of {spec.time_step / setting.substeps:.9g} s"
    lines = [f"{step}, {setting.iterations} iterations each" if simulator.has_iterations else step]
    if end is None:
        return [*lines, "no script, because the setting failed"]
    try:
        texts = write_engine_script(name, scene, engine, setting.substeps, frames, folder, end)
    except RunFailed as refused:
        return [*lines, f"no script of it: {refused}"]
    reads = [f"{name}.npz", *(file for file in texts if not file.endswith(".py"))]
    return [*lines, f"cd {folder} && python {name}.py    # reads {', '.join(reads)}"]

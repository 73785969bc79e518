"""Loader of accuracy configs: validation, and expansion into units of work.

All mistakes are reported at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

from springbench.harness.config.accuracy_config import (
    AccuracyConfig,
    AccuracyStudyConfig,
    BenchmarkCase,
    CurveSpec,
    CurveStudyConfig,
    MeasurementSettings,
    WorkSpec,
    WorkStudyConfig,
)
from springbench.harness.config.config_loader import (
    ACCURACY,
    check_file_name,
    check_scene_parts,
    read_config,
    read_plugin_metadata,
    read_scenes,
)
from springbench.harness.config.expand_grid import select_sizes
from springbench.harness.config.run_options import STEP_OPTIONS
from springbench.harness.config.solver_parameters import read_solvers
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.config.user_code import DEFAULT_LOAD_LIMITS, load_in_sandbox
from springbench.harness.errors import format_allowed_names
from springbench.harness.execution.optional_parts import RECORDINGS
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.schema.config_document import ConfigDocument, ConfigKey, UserCodePolicy, quote_value
from springbench.solvers.plugins.plugin_discovery import PluginName

MAX_UNITS = 20_000


@dataclass(frozen=True, slots=True)
class AccuracyPlan:
    """A validated accuracy config: its name and its distinct units of work."""

    name: str
    curves: tuple[CurveSpec, ...]
    work: tuple[WorkSpec, ...]


def load_accuracy(path: Path) -> AccuracyPlan:
    """Load an accuracy config from a YAML file.

    User code that it names is tried first in a worker process (`springbench.harness.config.user_code`).

    Raises:
        InputError: for all mistakes.
    """
    return load_in_sandbox(
        partial(_load_document, path), _find_plugins, _read_metadata, lambda accuracy: DEFAULT_LOAD_LIMITS
    )


def _find_plugins(accuracy: AccuracyPlan) -> list[PluginName]:
    return [plugin for unit in (*accuracy.curves, *accuracy.work) for plugin in unit.find_plugins()]


def _read_metadata(accuracy: AccuracyPlan) -> dict[str, Any]:
    return read_plugin_metadata({unit.solver.name: None for unit in (*accuracy.curves, *accuracy.work)})


def _load_document(path: Path, policy: UserCodePolicy) -> AccuracyPlan:
    _, document = read_config(path, ACCURACY, policy=policy)
    check_file_name(document)
    fields = document.validate_data(AccuracyConfig, document.data)
    scenes, solvers = read_scenes(document), read_solvers(document)
    if fields is None or document.mistakes:
        raise document.build_error()
    for scene in scenes.values():
        scene.require_fixed_time_step()
    return expand_studies(document, fields, scenes, solvers)


def expand_studies(
    document: ConfigDocument, fields: AccuracyConfig, scenes: Mapping[str, SceneSpec], solvers: Sequence[SolverSpec]
) -> AccuracyPlan:
    """Expand a config into its units of work.

    The settings of the first study apply to duplicates.

    Args:
        document: config, which collects mistakes.
        fields: validated fields of the config.
        scenes: scenes by name.
        solvers: solvers of the config.

    Raises:
        InputError: for all mistakes.
    """
    expansion = _StudyExpansion(document, scenes, solvers)
    curves = [unit for i, study in enumerate(fields.curves) for unit in expansion.expand_curves(study, ("curves", i))]
    work = [unit for i, study in enumerate(fields.work) for unit in expansion.expand_work(study, ("work", i))]
    if len(curves) + len(work) > MAX_UNITS:
        document.add_mistake(f"requests {len(curves) + len(work)} units of work; at most {MAX_UNITS} are allowed")
    for name, scene in scenes.items():
        sizes = [unit.case.size for unit in (*curves, *work) if unit.case.scene_name == name]
        document.mistakes.extend(check_scene_parts(document, name, scene, sizes) if not document.mistakes else [])
    if document.mistakes:
        raise document.build_error()
    return AccuracyPlan(
        document.path.stem,
        _remove_duplicates(curves),
        _remove_duplicates(work),
    )


U = TypeVar("U", CurveSpec, WorkSpec)


def _remove_duplicates(units: Sequence[U]) -> tuple[U, ...]:
    """Return the units without those that measure the same as an earlier one."""
    first: dict[str, U] = {}
    for unit in units:
        first.setdefault(unit.build_file_stem(), unit)
    return tuple(first.values())


class _StudyExpansion:
    """Expands studies, and adds mistakes to the document."""

    def __init__(
        self, document: ConfigDocument, scenes: Mapping[str, SceneSpec], solvers: Sequence[SolverSpec]
    ) -> None:
        self.document, self.scenes, self.solvers = document, scenes, solvers

    def expand_curves(self, study: CurveStudyConfig, at: ConfigKey) -> Iterator[CurveSpec]:
        """Expand a study into one curve for each problem and minimising solver."""
        how = MeasurementSettings(study.threads, study.rounds, study.time_limit)
        if "coarse-to-fine" in study.initial_guess:
            problem = "the time of a curve begins after its initial guess, which here is a solve; compare it in a sweep"
            self.document.add_mistake(f"coarse-to-fine: {problem}", (*at, "initial_guess"))
        if study.recordings and not RECORDINGS.is_installed():
            self.document.add_mistake(RECORDINGS.describe_absence(), (*at, "recordings"))
        solvers = [solver for solver in self._select_solvers(study, at) if solver.is_minimiser]
        for case, moment, solver in product(self._expand_cases(study, at), study.snapshot, solvers):
            if isinstance(moment, int) and moment > case.scene.frames:
                problem = f"frame {moment} is not among the {case.scene.frames} frames of {case.scene_name}"
                self.document.add_mistake(problem, (*at, "snapshot"))
            recordings = study.recordings
            yield CurveSpec(case, moment, solver, study.initial_guess, study.max_iterations, recordings, how)

    def expand_work(self, study: WorkStudyConfig, at: ConfigKey) -> Iterator[WorkSpec]:
        how = MeasurementSettings(study.threads, study.rounds, study.time_limit)
        for case in self._expand_cases(study, at):
            dt = case.scene.time_step
            steps = study.t_end / dt
            if round(steps) < 1 or abs(steps - round(steps)) > 1e-9 * steps:  # allows for round-off of the quotient
                problem = f"{study.t_end:g} s is no multiple of the time step {dt:.6g} s of {case.scene_name}"
                self.document.add_mistake(problem, (*at, "t_end"))
            lists = [getattr(study, name) for name in STEP_OPTIONS]
            for solver, values in product(self._select_solvers(study, at), product(*lists)):
                options = dict(zip(STEP_OPTIONS, values, strict=True))
                options["initial_guess"] = options["initial_guess"] or case.scene.choose_initial_guess(case.integrator)
                yield WorkSpec(case, study.t_end, solver, options, how)

    def _expand_cases(self, study: AccuracyStudyConfig, at: ConfigKey) -> list[BenchmarkCase]:
        found: list[BenchmarkCase] = []
        for name in self._select_names("scene", study.scene, list(self.scenes), at):
            scene = self.scenes[name]
            sizes = select_sizes(self.document, name, scene, study.size, (*at, "size"))
            lists: Any = study.integrator, study.time_step
            for size, (integrator, time_step) in product(sizes, product(*lists)):
                found.append(BenchmarkCase(name, scene.with_time_step(time_step or scene.time_step), size, integrator))
        return found

    def _select_solvers(self, study: AccuracyStudyConfig, at: ConfigKey) -> list[SolverSpec]:
        names = self._select_names("solver", study.solver, [solver.name for solver in self.solvers], at)
        return [solver for solver in self.solvers if solver.name in names]

    def _select_names(self, key: str, requested: Sequence[str], known: Sequence[str], at: ConfigKey) -> list[str]:
        """Return the names that a study selects, or all if it selects none."""
        for name in requested:
            if name not in known:
                self.document.add_mistake(
                    f"got {quote_value(name)}; expected {format_allowed_names(name, known)}", (*at, key)
                )
        return [name for name in known if name in requested or not requested]

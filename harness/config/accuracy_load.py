"""Loader of accuracy configs: validation, and expansion into units of work.

All mistakes are reported at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

from harness.base.document import Document, Key, OwnCode, quote
from harness.base.errors import InputError, Mistake, did_you_mean
from harness.base.yaml import read_yaml
from harness.config.accuracy import AccuracyFields, Case, CurveSpec, CurveStudy, How, Study, WorkSpec, WorkStudy
from harness.config.expand import check_size
from harness.config.load import check_name, misfits_of, scenes_of, stated_by
from harness.config.options import OF_STEPS
from harness.config.own import MOST, tried
from harness.config.solvers import solvers_of
from harness.config.sweep import SolverSpec
from harness.scenes.mesh.generator import Generator
from harness.scenes.spec import SceneSpec
from solvers.plugins import Plugin, found

MAX_UNITS = 20_000


@dataclass(frozen=True, slots=True)
class Accuracy:
    """A validated accuracy config: its name and its distinct units of work."""

    name: str
    curves: tuple[CurveSpec, ...]
    work: tuple[WorkSpec, ...]


def load_accuracy(path: Path) -> Accuracy:
    """Load an accuracy config from a YAML file; raise InputError.

    User code that it names is tried first in a worker process (`harness.config.own`).
    """
    return tried(partial(_load, path), _own, _stated, lambda accuracy: MOST)


def _own(accuracy: Accuracy) -> list[Plugin]:
    units = (*accuracy.curves, *accuracy.work)
    named = [name for unit in units for name in (unit.solver.name, unit.case.integrator)]
    return found([*named, *(plugin for unit in units for plugin, _ in unit.case.scene.own.values())])


def _stated(accuracy: Accuracy) -> dict[str, Any]:
    return stated_by({unit.solver.name: None for unit in (*accuracy.curves, *accuracy.work)})


def _load(path: Path, own: OwnCode) -> Accuracy:
    document = replace(read_yaml(path), own=own)
    if not {"curves", "work"} & set(document.data):
        problem = "is no accuracy config: it has neither `curves` nor `work`; `springbench run` does scenes and sweeps"
        raise InputError(Mistake(problem, path))
    check_name(document)
    fields = document.check(AccuracyFields, document.data)
    scenes, solvers = scenes_of(document), solvers_of(document)
    if fields is None or document.mistakes:
        raise document.error()
    for scene in scenes.values():
        scene.require_even_steps()
    return expand(document, fields, scenes, solvers)


def expand(
    document: Document, fields: AccuracyFields, scenes: Mapping[str, SceneSpec], solvers: Sequence[SolverSpec]
) -> Accuracy:
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
    expansion = _Expansion(document, scenes, solvers)
    curves = [unit for i, study in enumerate(fields.curves) for unit in expansion.curves(study, ("curves", i))]
    work = [unit for i, study in enumerate(fields.work) for unit in expansion.work(study, ("work", i))]
    if len(curves) + len(work) > MAX_UNITS:
        document.report(f"asks for {len(curves) + len(work)} units of work; at most {MAX_UNITS} are allowed")
    for name, scene in scenes.items():
        sizes = [unit.case.size for unit in (*curves, *work) if unit.case.scene_name == name]
        document.mistakes.extend(misfits_of(document, name, scene, sizes) if not document.mistakes else [])
    if document.mistakes:
        raise document.error()
    return Accuracy(
        document.path.stem,
        _distinct(curves),
        _distinct(work),
    )


U = TypeVar("U", CurveSpec, WorkSpec)


def _distinct(units: Sequence[U]) -> tuple[U, ...]:
    """Return the first of the units that measure the same."""
    first: dict[str, U] = {}
    for unit in units:
        first.setdefault(unit.label(), unit)
    return tuple(first.values())


class _Expansion:
    """Expands studies, and adds mistakes to the document."""

    def __init__(self, document: Document, scenes: Mapping[str, SceneSpec], solvers: Sequence[SolverSpec]) -> None:
        self.document, self.scenes, self.solvers = document, scenes, solvers

    def curves(self, study: CurveStudy, at: Key) -> Iterator[CurveSpec]:
        """Expand a study into one curve for each problem and minimising solver."""
        how = How(study.threads, study.rounds, study.time_limit)
        if "coarse" in study.first_guess:
            problem = "a curve's clock begins at its first guess, and this one is a solve itself; compare it in a sweep"
            self.document.report(f"coarse: {problem}", (*at, "first_guess"))
        solvers = [solver for solver in self._solvers(study, at) if solver.minimises]
        for case, moment, solver in product(self._cases(study, at), study.moment, solvers):
            if isinstance(moment, int) and moment > case.scene.frames:
                problem = f"frame {moment} is not among the {case.scene.frames} frames of {case.scene_name}"
                self.document.report(problem, (*at, "moment"))
            recordings = study.recordings
            yield CurveSpec(case, moment, solver, study.first_guess, study.iterations, recordings, how)

    def work(self, study: WorkStudy, at: Key) -> Iterator[WorkSpec]:
        how = How(study.threads, study.rounds, study.time_limit)
        for case in self._cases(study, at):
            dt = case.scene.time_step
            steps = study.horizon / dt
            if round(steps) < 1 or abs(steps - round(steps)) > 1e-9 * steps:  # round-off of the quotient, and no more
                problem = f"{study.horizon:g} s is no multiple of the time step {dt:.6g} s of {case.scene_name}"
                self.document.report(problem, (*at, "horizon"))
            lists = [getattr(study, name) for name in OF_STEPS]
            for solver, values in product(self._solvers(study, at), product(*lists)):
                options = dict(zip(OF_STEPS, values, strict=True))
                options["first_guess"] = options["first_guess"] or case.scene.guess(case.integrator)
                yield WorkSpec(case, study.horizon, solver, options, how)

    def _cases(self, study: Study, at: Key) -> list[Case]:
        found: list[Case] = []
        for name in self._named("scene", study.scene, list(self.scenes), at):
            scene = self.scenes[name]
            lists: Any = study.integrator, study.time_step
            for size, (integrator, time_step) in product(self._sizes(name, study, at), product(*lists)):
                found.append(Case(name, scene.stepped(time_step or scene.time_step), size, integrator))
        return found

    def _sizes(self, name: str, study: Study, at: Key) -> Sequence[int]:
        """Return the study's mesh sizes, else the scene's default.

        0 for a mesh from a file.
        """
        scene = self.scenes[name]
        if not isinstance(scene.mesh, Generator):
            return (0,)
        sizes = study.size or ((scene.default_size,) if scene.default_size else ())
        if not sizes:
            problem = f"is missing; the scene {name} needs a mesh size (or give it a default_size)"
            self.document.report(problem, (*at, "size"))
        for size in sizes:
            check_size(self.document, name, scene, size, (*at, "size"))
        return sizes

    def _solvers(self, study: Study, at: Key) -> list[SolverSpec]:
        names = self._named("solver", study.solver, [solver.name for solver in self.solvers], at)
        return [solver for solver in self.solvers if solver.name in names]

    def _named(self, key: str, asked: Sequence[str], known: Sequence[str], at: Key) -> list[str]:
        """Return the names that a study selects, or all if it selects none."""
        for name in asked:
            if name not in known:
                self.document.report(f"came {quote(name)}; expected {did_you_mean(name, known)}", (*at, key))
        return [name for name in known if name in asked or not asked]

"""Expansion of a sweep into runs: the grid of all combinations without `exclude`, plus `include`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from math import prod
from typing import Any

from springbench.harness.config.run_options import AUTO, ERROR_TARGET_OPTIONS, RUN_OPTIONS, SCENE_OPTIONS, RunOptions
from springbench.harness.config.sweep_config import (
    ExcludeEntry,
    FixedOptions,
    IncludeEntry,
    RunSpec,
    SolverSpec,
    SweepConfig,
)
from springbench.harness.errors import format_allowed_names
from springbench.harness.scenes.mesh.mesh_generator import MeshGenerator
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.schema.config_document import ConfigDocument, ConfigKey, quote_value

MAX_RUNS = 10_000


class GridExpansion:
    """Expands one sweep, and adds mistakes to its document.

    Attributes:
        document: config, which collects mistakes.
        name: name of the sweep.
        fields: validated fields of the sweep.
        scenes: scenes by name.
        solvers: solvers, in the order of the sweep.
    """

    def __init__(
        self,
        document: ConfigDocument,
        name: str,
        fields: SweepConfig,
        scenes: Mapping[str, SceneSpec],
        solvers: Sequence[SolverSpec],
    ) -> None:
        self.document, self.name, self.fields = document, name, fields
        self.scenes, self.solvers = scenes, solvers

    def expand_runs(self) -> tuple[RunSpec, ...]:
        """Expand the runs without duplicates, those of the grid first; empty if there are mistakes."""
        self._check_names()
        options = self.fields.options.model_dump(include=set(RUN_OPTIONS))
        self._check_error_target()
        jobs = [
            (name, select_sizes(self.document, name, scene, self.fields.sizes, ("sizes",)), self.solvers, options)
            for name, scene in self.scenes.items()
        ]
        extra = [job for i, entry in enumerate(self.fields.include) for job in self._expand_include(i, entry, options)]
        count = sum(len(s) * len(v) * prod(map(len, o.values())) for _, s, v, o in [*jobs, *extra])
        if count > MAX_RUNS:
            self.document.add_mistake(f"requests {count} runs; at most {MAX_RUNS} are allowed", ("options",))
        if self.document.mistakes:
            return ()
        grid = self._apply_exclude([run for job in jobs for run in self._expand_product(*job)])
        runs = [*grid, *(run for job in extra for run in self._expand_product(*job))]
        if not runs and not self.document.mistakes:
            self.document.add_mistake("leaves no run", ("exclude",))
        self._check_frames(runs)
        return tuple({(run.scene_name, run.build_identity()): run for run in runs}.values())

    def _expand_product(
        self,
        scene_name: str,
        sizes: Sequence[int],
        solvers: Sequence[SolverSpec],
        options: Mapping[str, Sequence[Any]],
    ) -> Iterable[RunSpec]:
        scene = self.scenes[scene_name]
        fixed_options = {name: getattr(self.fields.options, name) for name in FixedOptions.model_fields}
        for size, solver, values in product(sizes, solvers, product(*options.values())):
            chosen: dict[str, Any] = dict(zip(options, values, strict=True))
            if chosen["error_target"] is not None:
                chosen |= {
                    name: None if name in SCENE_OPTIONS else RunOptions.model_fields[name].default
                    for name in ERROR_TARGET_OPTIONS
                }
            chosen |= {
                name: _find_scene_value(name, scene, chosen["integrator"])
                for name in SCENE_OPTIONS
                if chosen[name] is None
            }
            yield RunSpec.model_construct(
                sweep=self.name,
                scene_name=scene_name,
                scene=scene.with_time_step(chosen["time_step"]),
                size=size,
                solver=solver,
                **chosen,
                **fixed_options,
            )

    def _expand_include(self, i: int, entry: IncludeEntry, options: Mapping[str, Sequence[Any]]) -> Iterable[Any]:
        chosen = {key: entry.get_values(key) or values[:1] for key, values in options.items()}
        solvers = [s for s in self.solvers if s.name in (entry.solver or [s.name])]
        for scene_name in entry.scene or self.scenes:
            if scene_name not in self.scenes:
                continue
            sizes: Sequence[int] = (0,)
            if isinstance(self.scenes[scene_name].mesh, MeshGenerator):
                sizes = entry.size
                for k, size in enumerate(sizes):
                    _check_mesh_size(
                        self.document, scene_name, self.scenes[scene_name], size, ("include", i, "size", k)
                    )
                if not sizes:
                    self.document.add_mistake(f"is missing; the scene {scene_name} has one", ("include", i, "size"))
            yield scene_name, sizes, solvers, chosen

    def _apply_exclude(self, grid: Sequence[RunSpec]) -> list[RunSpec]:
        """Return the grid points that no entry of `exclude` matches."""
        remaining = list(grid)
        for i, entry in enumerate(self.fields.exclude):
            if not any(self._is_match(entry, run) for run in grid):
                self.document.add_mistake("matches no run of the grid; correct or remove it", ("exclude", i))
            remaining = [run for run in remaining if not self._is_match(entry, run)]
        return remaining

    def _is_match(self, entry: ExcludeEntry, run: RunSpec) -> bool:
        """Return whether a run matches all keys of an entry; null matches the scene's value."""
        named = {"scene": run.scene_name, "size": run.size, "solver": run.solver.name}
        allowed = {key: entry.get_values(key) for key in (*named, *RUN_OPTIONS)}
        for name in SCENE_OPTIONS:
            if None in allowed[name]:
                allowed[name] += (_find_scene_value(name, self.scenes[run.scene_name], run.integrator),)
        values = named | {key: getattr(run, key) for key in RUN_OPTIONS}
        return (
            all(not allowed[key] or value in allowed[key] for key, value in values.items())
            and (entry.size_above is None or run.size > entry.size_above)
            and (entry.size_below is None or run.size < entry.size_below)
        )

    def _check_names(self) -> None:
        known = {"scene": list(self.scenes), "solver": [solver.name for solver in self.solvers]}
        for part in ("exclude", "include"):
            for i, entry in enumerate(getattr(self.fields, part)):
                for key, names in known.items():
                    for name in getattr(entry, key):
                        if name not in names:
                            problem = f"got {quote_value(name)}; expected {format_allowed_names(name, names)}"
                            self.document.add_mistake(problem, (part, i, key))

    def _check_error_target(self) -> None:
        """Check that options do not conflict with an error target or with verification."""
        options = self.fields.options
        if None not in options.error_target:
            for name in ERROR_TARGET_OPTIONS:
                if name in options.model_fields_set:
                    self.document.add_mistake("is chosen by the `error_target`; leave it out", ("options", name))
        if options.timing == "none" and options.record:
            problem = (
                "got none, which has no pass for the colours of a recording; set `record: false`, or another timing"
            )
            self.document.add_mistake(problem, ("options", "timing"))
        entries = [options, *self.fields.include]
        if options.verify and any(AUTO in one.rtol or set(one.error_target) != {None} for one in entries):
            problem = "needs a number or null as `rtol` and no `error_target`; change these, or leave `verify` out"
            self.document.add_mistake(problem, ("options", "verify"))

    def _check_frames(self, runs: Sequence[RunSpec]) -> None:
        for i, frame in enumerate(self.fields.options.convergence_frames or ()):
            short = next((run for run in runs if run.frames < frame), None)
            if short:
                problem = f"frame {frame} is not among the {short.frames} frames of {short.scene_name}"
                self.document.add_mistake(problem, ("options", "convergence_frames", i))


def select_sizes(
    document: ConfigDocument, scene_name: str, scene: SceneSpec, requested: Sequence[int], at: ConfigKey
) -> Sequence[int]:
    """Return the requested mesh sizes, else the scene's default; 0 for a mesh file.

    Args:
        document: config, which collects mistakes.
        scene_name: name of the scene in messages.
        scene: scene with the mesh.
        requested: sizes that the config lists, if any.
        at: location of this list in the document.
    """
    if not isinstance(scene.mesh, MeshGenerator):
        return (0,)
    sizes = requested or ((scene.default_size,) if scene.default_size else ())
    if not sizes:
        problem = f"is missing; the scene {scene_name} needs a mesh size (or give it a default_size)"
        document.add_mistake(problem, at)
    for i, size in enumerate(sizes):
        _check_mesh_size(document, scene_name, scene, size, (*at, i))
    return sizes


def _check_mesh_size(document: ConfigDocument, scene_name: str, scene: SceneSpec, size: int, at: ConfigKey) -> None:
    """Add a mistake if a generated mesh does not support a size.

    Args:
        document: config, which collects mistakes.
        scene_name: name of the scene in messages.
        scene: scene with the mesh.
        size: requested mesh size.
        at: location of the size in the document.
    """
    mesh = scene.mesh
    if not isinstance(mesh, MeshGenerator):
        return
    if size < mesh.MIN_SIZE:
        document.add_mistake(f"{size} is too small for the scene {scene_name}: {mesh.MIN_SIZE} at least", at)
    elif excess := mesh.describe_excess(size):
        document.add_mistake(f"{size} {excess} (scene {scene_name})", at)


def _find_scene_value(name: str, scene: SceneSpec, integrator: str) -> Any:
    """Return the scene's value of one of SCENE_OPTIONS, which null stands for."""
    return scene.choose_initial_guess(integrator) if name == "initial_guess" else getattr(scene, name)

"""Reader of configs of all kinds, and loader of scenes and sweeps.

All mistakes of a sweep and its scenes are reported at once.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from springbench.harness.config.expand_grid import GridExpansion
from springbench.harness.config.run_options import AUTO, DEFAULT_SOLVER, DEFAULT_STOP_RULE
from springbench.harness.config.shipped_configs import resolve_scene_path, suggest_shipped_scene
from springbench.harness.config.solver_parameters import read_solvers
from springbench.harness.config.sweep_config import RunSpec, SweepConfig, SweepOptions
from springbench.harness.config.user_code import (
    BINDING_PREFIX,
    DEFAULT_LOAD_LIMITS,
    build_load_limits,
    fingerprint_parameters,
    load_in_sandbox,
    resolve_tag,
)
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.optional_parts import RECORDINGS
from springbench.harness.results.solver_metadata import list_packages, read_solver_metadata
from springbench.harness.scenes.assignment_scene import (
    ASSIGNMENT_FORCE,
    ASSIGNMENT_PIN_WEIGHT,
    ASSIGNMENT_TIME_STEP,
    read_assignment_scene,
)
from springbench.harness.scenes.effects import effect_table
from springbench.harness.scenes.fabric_table import FabricChoice, fill_effect, find_fabric
from springbench.harness.scenes.mesh import mesh_table
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_generator import MeshGenerator
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_plugins import PluginEffect, PluginMesh, build_plugin_part, load_plugin
from springbench.harness.scenes.scene_spec import NAME_PATTERN, SceneFile, SceneSpec
from springbench.harness.schema.base_model import ConfigModel, Vector3
from springbench.harness.schema.config_document import (
    IMPORT_USER_CODE,
    SKIP_USER_CODE,
    ConfigDocument,
    ConfigKey,
    UserCodePolicy,
    format_key,
    is_list,
    quote_value,
)
from springbench.harness.schema.yaml_loader import read_yaml
from springbench.solvers.plugins.plugin_discovery import PluginName, load_target, select_plugins

ASSIGNMENT_FRAMES = 30
ASSIGNMENT_SOLVER = "numba"
"""Default number of frames and solver of an assignment's scene; iteration limits are those of `RunOptions`."""


class ConfigKind(NamedTuple):
    """A kind of config: its name, identifying keys, and commands that read it."""

    name: str
    keys: tuple[str, ...]
    usage: str

    @property
    def description(self) -> str:
        """Name and keys."""
        return f"{self.name} (with {' or '.join(f'`{key}`' for key in self.keys)})"


_RUN_USAGE = "`springbench run`, or `springbench regress` with --baseline REVISION"
SCENE = ConfigKind("a scene", ("mesh",), _RUN_USAGE)
SWEEP = ConfigKind("a sweep", ("scenes",), _RUN_USAGE)
ACCURACY = ConfigKind("an accuracy config", ("curves", "work"), "`springbench accuracy`")
GATES = ConfigKind("a gates file", ("gates",), "`springbench regress` without --baseline")
CONFIG_KINDS = (ACCURACY, GATES, SWEEP, SCENE)
"""All kinds. An accuracy config also has the key of a sweep, so it is first."""


def find_config_kind(keys: Iterable[str]) -> ConfigKind | None:
    """Find the kind of a config by its top-level keys; None if unknown."""
    present = set(keys)
    return next((kind for kind in CONFIG_KINDS if present & {*kind.keys}), None)


def is_assignment_file(path: Path) -> bool:
    """Return whether a file is a scene of the assignment, which is JSON."""
    return path.suffix.lower() == ".json"


def read_config(
    path: Path, *kinds: ConfigKind, policy: UserCodePolicy = IMPORT_USER_CODE
) -> tuple[ConfigKind, ConfigDocument]:
    """Read a config of one of the given kinds.

    Args:
        path: YAML file; or JSON file of an assignment, whose document is empty.
        kinds: expected kinds.
        policy: policy for code that the config names.

    Returns:
        Its kind, and its document.

    Raises:
        InputError: if it cannot be read, or is of another kind.
    """
    is_assignment = is_assignment_file(path)
    document = ConfigDocument(path, {}) if is_assignment else read_yaml(path)
    document.user_code = policy
    kind = SCENE if is_assignment else find_config_kind(document.data)
    expected = " or ".join(one.description for one in kinds)
    if kind is None:
        raise InputError(InputMistake(f"is no config: expected {expected}", path))
    if kind in kinds:
        return kind, document
    raise InputError(InputMistake(f"is {kind.description}, for {kind.usage}; expected {expected}", path))


class AssignmentMesh(ConfigModel):
    """The mesh of an assignment's scene, with its masses."""

    kind: Literal["assignment"] = "assignment"
    path: Path

    def build_mesh(self, size: int = 0) -> Mesh:
        """Read the mesh of the file, which has only one size; raise InputError."""
        return read_assignment_scene(self.path).mesh


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """A validated sweep: its name, options, runs and reports."""

    name: str
    options: SweepOptions
    run_specs: tuple[RunSpec, ...]
    reports: tuple[str, ...] = ()

    def list_runs(self) -> list[RunSpec]:
        """List the distinct runs: scene by scene, size by size, solver by solver."""
        return list(self.run_specs)


def load_config(
    path: Path, *, solvers: Sequence[str] = (), sizes: Sequence[int] = (), imports_code: bool = True, **options: Any
) -> SweepPlan:
    """Load a sweep from a file, or build one of a single scene.

    The keyword arguments apply to scenes only; a sweep defines its own. A YAML scene gets `DEFAULT_STOP_RULE` unless
    `options` names a part of it or an error target. An assignment's scene gets the defaults of a sweep.

    Args:
        path: file of a sweep or a scene.
        solvers: names of solvers; the default solver if empty.
        sizes: mesh sizes; the scene's default if empty.
        imports_code: whether user code is tried first in a worker process. Otherwise its parameters are not checked.
        options: options of `springbench.harness.config.sweep_config.SweepOptions`; None selects the default there.

    Raises:
        InputError: for all mistakes.
    """
    load = partial(_load_any, path, solvers, sizes, options)
    return _load_sweep_checked(load) if imports_code else load(SKIP_USER_CODE)


def load_scene_run(path: Path, size: int | None = None) -> RunSpec:
    """Load a scene as one run, like `load_config`.

    Args:
        path: file of the scene.
        size: mesh size; the scene's default if None.

    Raises:
        InputError: for all mistakes, and for a sweep.
    """
    read_config(path, SCENE, policy=SKIP_USER_CODE)
    return load_config(path, sizes=() if size is None else (size,)).list_runs()[0]


def _load_any(
    path: Path, solvers: Sequence[str], sizes: Sequence[int], options: dict[str, Any], policy: UserCodePolicy
) -> SweepPlan:
    given = {key: value for key, value in options.items() if value is not None}
    kind, document = read_config(path, SCENE, SWEEP, policy=policy)
    if kind == SWEEP:
        if solvers or sizes or given:
            raise InputError(InputMistake("is a sweep, which defines its own runs; change the file instead", path))
        return _build_sweep(document)
    assignment = is_assignment_file(path)
    scene = convert_assignment_scene(path) if assignment else build_scene_from_document(document)
    if not assignment and not {*DEFAULT_STOP_RULE, "error_target"} & options.keys():
        given = DEFAULT_STOP_RULE | given
    usual = ASSIGNMENT_SOLVER if assignment else DEFAULT_SOLVER
    keys = {"scenes": [path.name], "sizes": list(sizes), "solvers": list(solvers) or [usual]}
    alone = ConfigDocument(path, {**keys, "options": {"threads": AUTO, **given}}, user_code=policy)
    return _expand_sweep(alone, {path.stem: scene})


def load_sweep(path: Path) -> SweepPlan:
    """Load a sweep from a YAML file, validate its scenes and expand its grid.

    Raises:
        InputError: for all mistakes.
    """
    return build_sweep_from_document(read_config(path, SWEEP)[1])


def _load_sweep_checked(load: Callable[[UserCodePolicy], SweepPlan]) -> SweepPlan:
    return load_in_sandbox(
        load,
        _find_plugins,
        _read_metadata,
        lambda sweep: build_load_limits(sweep.options.time_limit, sweep.options.memory_limit),
    )


def _find_plugins(sweep: SweepPlan) -> list[PluginName]:
    return [*(plugin for run in sweep.run_specs for plugin in run.find_plugins()), *select_plugins(sweep.reports)]


def _read_metadata(sweep: SweepPlan) -> dict[str, Any]:
    return read_plugin_metadata({run.solver.name: None for run in sweep.run_specs})


def read_plugin_metadata(solvers: Iterable[str]) -> dict[str, Any]:
    """Read the metadata of the user solvers among the given names, by importing their code."""
    return {
        str(name): read_solver_metadata(name) | {"packages": list_packages(name)} for name in select_plugins(solvers)
    }


def load_scene(path: Path) -> SceneSpec:
    """Load a scene from a YAML file, or from an assignment's JSON file.

    User code that it names is tried first in a worker process, as in `load_config`.

    Raises:
        InputError: for all mistakes.
    """
    return load_in_sandbox(
        partial(_load_scene, path),
        SceneSpec.find_plugins,
        _check_binding,
        lambda scene: DEFAULT_LOAD_LIMITS,
    )


def _check_binding(scene: SceneSpec) -> dict[str, Any]:
    """Check a scene by building it at its default size; return no metadata of solvers."""
    if mistakes := find_scene_mistakes(scene, [scene.default_size or 0]):
        raise InputError(mistakes)
    return {}


def load_scene_in_process(path: Path) -> SceneSpec:
    """Load a scene and import the code that it names in this process; raise InputError."""
    return _load_scene(path, IMPORT_USER_CODE)


def _load_scene(path: Path, policy: UserCodePolicy) -> SceneSpec:
    _, document = read_config(path, SCENE, policy=policy)
    return convert_assignment_scene(path) if is_assignment_file(path) else build_scene_from_document(document)


def convert_assignment_scene(path: Path) -> SceneSpec:
    """Convert an assignment file to an equivalent scene; raise InputError.

    It has the same springs, force, pins and time step.
    """
    document = ConfigDocument(path, {})
    check_file_name(document)
    if document.mistakes:
        raise document.build_error()
    assignment = read_assignment_scene(path)
    k, pins, mesh = assignment.stiffness, assignment.pinned_vertices.tolist(), AssignmentMesh(path=path)
    effects: tuple[dict[str, Any], ...] = (
        {"kind": "springs", "scaling_rule": "fixed", "stretch": k, "shear": k, "bend": k},
        {"kind": "constant-force", "force": ASSIGNMENT_FORCE},
        *([{"kind": "pins", "indices": pins, "weight": ASSIGNMENT_PIN_WEIGHT}] if pins else []),
    )
    return SceneSpec(
        mesh=mesh,
        mesh_digest=_hash_mesh(mesh),
        time_step=ASSIGNMENT_TIME_STEP,
        frames=ASSIGNMENT_FRAMES,
        effects=tuple(load_target(effect_table.EFFECT_CLASSES[effect["kind"]])(**effect) for effect in effects),
        initial_guess="assignment",
        path=path,
    )


def build_scene_from_document(document: ConfigDocument) -> SceneSpec:
    """Build the scene of a document; raise InputError for all mistakes."""
    data = document.data
    check_file_name(document)
    fields = document.validate_data(SceneFile, data)
    own: dict[str, tuple[PluginName, dict[str, Any]]] = {}
    mesh = _build_part(document, "mesh", data["mesh"], ("mesh",), own) if "mesh" in data else None
    listed: Any = data.get("effects", [])
    if not is_list(listed):
        document.add_mistake("should be a list of mappings, each with a `kind`", ("effects",))
        listed = []
    filled = listed if fields is None else _fill_from_fabric(document, fields, listed)
    effects = tuple(_build_part(document, "effect", effect, ("effects", i), own) for i, effect in enumerate(filled))
    if fields is None or document.mistakes:
        raise document.build_error()
    try:
        digest = _hash_mesh(mesh)
    except InputError as error:
        document.add_errors(error)
        raise document.build_error() from None
    parts: dict[str, Any] = {"mesh": mesh, "mesh_digest": digest, "effects": effects}
    if fields.fabric is not None and fields.mass is None and fields.mass_per_area is None:
        parts["mass_per_area"] = find_fabric(_split_fabric(fields.fabric)[0]).density
    return SceneSpec(
        **vars(fields) | parts,
        path=document.path,
        plugins=own,
        key_lines={format_key(key): line for key, line in document.lines.items()},
    )


def _fill_from_fabric(document: ConfigDocument, fields: SceneFile, listed: list[Any]) -> list[Any]:
    """Complete the effects with the material of the scene's fabric.

    A fabric that provides no value is a mistake.
    """
    if fields.fabric is None:
        return listed
    name, warp = _split_fabric(fields.fabric)
    filled = [fill_effect(effect, name, warp) for effect in listed]
    if filled == listed and (fields.mass is not None or fields.mass_per_area is not None):
        document.add_mistake("provides nothing, because the scene states all its values; leave it out", ("fabric",))
    return filled


def _split_fabric(fabric: str | FabricChoice) -> tuple[str, Vector3 | None]:
    """Return the name of a fabric, and the direction of its warp or None."""
    return (fabric, None) if isinstance(fabric, str) else (fabric.name, fabric.warp)


def _hash_mesh(source: Any) -> str:
    """Compute the SHA-256 of a mesh from a file, or "" for a generated mesh."""
    if isinstance(source, MeshGenerator):
        return ""
    mesh: Mesh = source.build_mesh(0)
    digest = hashlib.sha256()
    arrays = {
        "rest": mesh.rest_positions,
        "springs": mesh.springs,
        "triangles": mesh.triangles,
        "shares": mesh.mass_fractions,
    }
    if own := mesh.spring_properties:
        arrays |= {"stiffness": own.stiffness, "rest length": own.rest_length, "only pulls": own.only_pulls}
    for name, array in {**arrays, "mass": mesh.mass, **mesh.spring_families}.items():
        digest.update(f"{name} {None if array is None else array.shape} ".encode())
        digest.update(b"" if array is None else array.tobytes())
    return digest.hexdigest()


_PART_TABLES = {"mesh": (mesh_table.MESH_TABLE, PluginMesh), "effect": (effect_table.EFFECT_TABLE, PluginEffect)}


def _build_part(
    document: ConfigDocument,
    part_kind: str,
    data: Any,
    at: ConfigKey,
    plugins: dict[str, tuple[PluginName, dict[str, Any]]],
) -> Any:
    """Build a mesh or an effect by the class of its `kind`.

    Only that class is imported.

    Args:
        document: config, which collects mistakes.
        part_kind: "mesh" or "effect".
        data: mapping of the part.
        at: location of the part in the document.
        plugins: dictionary that receives user code, by location.
    """
    table, unopened = _PART_TABLES[part_kind]
    named = resolve_tag(document, table, data, "kind", at)
    if named is None:
        return None
    name, parameters = named
    if not isinstance(name, PluginName):
        model = load_target(table[name])
        return document.validate_data(model, document.resolve_paths(model, data, at), at)
    plugins[format_key(at)] = name, fingerprint_parameters(document, parameters)
    if not document.user_code.imports_code:
        return unopened(kind=name, parameters=parameters, folder=str(document.path.parent.absolute()))
    return build_plugin_part(document, name, part_kind, parameters, at)


def build_sweep_from_document(document: ConfigDocument) -> SweepPlan:
    """Build the sweep of a document, with the scenes that it names; raise InputError.

    User code that it names is tried first in a worker process.
    """
    return _load_sweep_checked(partial(_build_sweep_with, document))


def _build_sweep_with(document: ConfigDocument, policy: UserCodePolicy) -> SweepPlan:
    return _build_sweep(replace(document, user_code=policy, mistakes=[]))


def _build_sweep(document: ConfigDocument) -> SweepPlan:
    return _expand_sweep(document, read_scenes(document))


def read_scenes(document: ConfigDocument) -> dict[str, SceneSpec]:
    """Read the scenes listed under `scenes`, by name; mistakes are added to the document."""
    scenes: dict[str, SceneSpec] = {}
    listed: Any = document.data.get("scenes")
    for i, entry in enumerate(listed if is_list(listed) else []):
        if not isinstance(entry, str):
            continue  # the check of the whole sweep reports it
        at, path = ("scenes", i), resolve_scene_path(entry, document.path.parent)
        if not os.path.isfile(path):
            document.add_mistake(f"there is no file {quote_value(str(path))}{suggest_shipped_scene(entry)}", at)
        elif path.stem in scenes and not os.path.samefile(scenes[path.stem].path, path):
            document.add_mistake(f"two scenes are named {path.stem}; rename one of the files", at)
        else:
            try:
                scenes[path.stem] = _load_scene(path, document.user_code)
            except InputError as error:
                document.mistakes.extend(error.mistakes)
    return scenes


def _expand_sweep(document: ConfigDocument, scenes: dict[str, SceneSpec]) -> SweepPlan:
    check_file_name(document)
    sweep = document.validate_data(SweepConfig, document.data)
    solvers = read_solvers(document)
    if sweep is None or document.mistakes:
        raise document.build_error()
    fields = _omit_missing_recordings(document, sweep)
    runs = GridExpansion(document, document.path.stem, fields, scenes, solvers).expand_runs()
    if document.user_code.imports_code:
        for integrator in select_plugins({run.integrator: None for run in runs}):
            load_plugin(document, integrator, "integrator", ("options", "integrator"))
        for report in select_plugins(sweep.reports):
            load_plugin(document, report, "report", ("reports",))
    for name, scene in scenes.items():
        sizes = [run.size for run in runs if run.scene_name == name]
        document.mistakes.extend(check_scene_parts(document, name, scene, sizes))
    if document.mistakes:
        raise document.build_error()
    return SweepPlan(document.path.stem, sweep.options, runs, sweep.reports)


def _omit_missing_recordings(document: ConfigDocument, sweep: SweepConfig) -> SweepConfig:
    """Return the sweep without recordings if Rerun is not installed.

    A file that requests recordings explicitly then gets a mistake.
    """
    if RECORDINGS.is_installed() or not sweep.options.record:
        return sweep
    if "record" in sweep.options.model_fields_set:
        document.add_mistake(f"{RECORDINGS.describe_absence()}; or set `record: false`", ("options", "record"))
    return sweep.model_copy(update={"options": sweep.options.model_copy(update={"record": False})})


def require_fixed_steps(runs: Iterable[RunSpec]) -> None:
    """Raise InputError for a run with an error target, whose step size is not fixed."""
    if any(run.error_target is not None for run in runs):
        raise InputError(
            InputMistake(
                "chooses the steps of each run, which `springbench run` does; leave it out", key="error_target"
            )
        )


def check_scene_parts(
    document: ConfigDocument, name: str, scene: SceneSpec, sizes: Sequence[int]
) -> list[InputMistake]:
    """Find parts of a scene that do not fit together, if the policy permits.

    A scene with user code is checked only if that code is imported.

    Args:
        document: config with the policy for user code.
        name: name of the scene in messages.
        scene: scene to check.
        sizes: mesh sizes of its runs.
    """
    if not scene.plugins:
        return find_scene_mistakes(scene, sizes)
    document.user_code.on_import(f"{BINDING_PREFIX}{name}")
    return find_scene_mistakes(scene, sizes) if document.user_code.imports_code else []


def find_scene_mistakes(scene: SceneSpec, sizes: Sequence[int]) -> list[InputMistake]:
    """Find parts of a scene that do not fit together, by building it.

    Args:
        scene: scene whose parts are valid individually.
        sizes: mesh sizes, of which the smallest is built; nothing is built if there are none.

    Returns:
        Mistakes with their file, and their line where it is known.
    """
    try:
        if sizes:
            built = build_scene(scene, min(sizes))
            if getattr(scene.mesh, "kind", "") == "file":
                from springbench.harness.scenes.mesh_support import log_mesh_remarks  # for meshes from files only

                log_mesh_remarks(scene, built.mesh)
    except InputError as error:
        return [
            replace(m, file=m.file or scene.path, line=m.line or scene.key_lines.get(m.key)) for m in error.mistakes
        ]
    return []


def check_file_name(document: ConfigDocument) -> None:
    """Add a mistake if the file's name is not a valid name of results."""
    if not NAME_PATTERN.fullmatch(document.path.stem):
        expectation = "rename it to letters, digits, `.`, `_` and `-`, at most 64, the first a letter or a digit"
        document.add_mistake(f"the file's name becomes the name of results; {expectation}")

"""Loader of scenes and sweeps from their files.

All mistakes of a sweep and its scenes are reported at once.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from harness.base.document import IMPORTED, Document, Key, OwnCode, is_list, key_text, quote
from harness.base.errors import InputError, Mistake
from harness.base.model import Model
from harness.base.stated import packages, stated
from harness.base.yaml import read_yaml
from harness.config.expand import Expansion
from harness.config.options import AUTO, DEFAULT_SOLVER, DEFAULT_STOP
from harness.config.own import BINDING, MOST, chosen, given, tried, within
from harness.config.solvers import solvers_of
from harness.config.sweep import Options, RunSpec, SweepFields
from harness.scenes.assignment import FORCE, PIN_WEIGHT, TIME_STEP, read_assignment
from harness.scenes.bind import build
from harness.scenes.effects import effect_names
from harness.scenes.mesh import mesh_names
from harness.scenes.mesh.base import Mesh
from harness.scenes.mesh.generator import Generator
from harness.scenes.own import OwnEffect, OwnMesh, checked, opened
from harness.scenes.spec import NAME, SceneFile, SceneSpec
from solvers.plugins import Plugin, found, load

ASSIGNMENT_FRAMES = 30
ASSIGNMENT_SOLVER = "numba"
"""Default number of frames and solver of an assignment's scene; iteration limits are those of `Chosen`."""


class AssignmentMesh(Model):
    """The mesh of an assignment's scene, with its masses."""

    kind: Literal["assignment"] = "assignment"
    path: Path

    def build(self, size: int = 0) -> Mesh:
        """Read the mesh of the file, which has only one size; raise InputError."""
        return read_assignment(self.path).mesh


@dataclass(frozen=True, slots=True)
class Sweep:
    """A validated sweep: its name, options, runs and reports."""

    name: str
    options: Options
    expanded: tuple[RunSpec, ...]
    reports: tuple[str, ...] = ()

    def runs(self) -> list[RunSpec]:
        """List the distinct runs: scene by scene, size by size, solver by solver."""
        return list(self.expanded)


def load_any(
    path: Path, *, solvers: Sequence[str] = (), sizes: Sequence[int] = (), opens: bool = True, **options: Any
) -> Sweep:
    """Load a sweep from a file, or build one of a single scene.

    The keyword arguments apply to scenes only; a sweep defines its own. A YAML scene without a stop rule gets
    `DEFAULT_STOP`, and an assignment's scene gets the defaults of a sweep.

    Args:
        path: file of a sweep or a scene.
        solvers: names of solvers; the default solver if empty.
        sizes: mesh sizes; the scene's default if empty.
        opens: whether user code is tried first in a worker process. Otherwise its parameters are not checked.
        options: options of `harness.config.sweep.Options`; None corresponds to null in a sweep.
    Raises:
        InputError: for all mistakes.
    """
    load = partial(_any, path, solvers, sizes, options)
    return _tried_sweep(load) if opens else load(OwnCode(opens=False, kept=True))


def _any(path: Path, solvers: Sequence[str], sizes: Sequence[int], options: dict[str, Any], own: OwnCode) -> Sweep:
    asked = {key: value for key, value in options.items() if value is not None}
    assignment = _is_assignment(path)
    document = Document(path, {}) if assignment else read_yaml(path)
    document.own = own
    if {"curves", "work"} & set(document.data):
        raise InputError(Mistake("is an accuracy config; run it with `springbench accuracy`", path))
    if "goals" in document.data:
        raise InputError(Mistake("has goals; run it with `springbench goals`", path))
    if "scenes" in document.data:
        if solvers or sizes or asked:
            raise InputError(Mistake("is a sweep, which says itself what to run; change the file instead", path))
        return _sweep_of(document)
    if not assignment and "mesh" not in document.data:
        raise InputError(Mistake("is neither a scene (it has no `mesh`) nor a sweep (it has no `scenes`)", path))
    scene = scene_from_assignment(path) if assignment else scene_of(document)
    if not assignment and not {*DEFAULT_STOP, "accuracy"} & options.keys():
        asked = DEFAULT_STOP | asked
    usual = ASSIGNMENT_SOLVER if assignment else DEFAULT_SOLVER
    keys = {"scenes": [path.name], "sizes": list(sizes), "solvers": list(solvers) or [usual]}
    alone = Document(path, {**keys, "options": {"threads": AUTO, **asked}}, own=own)
    return _expanded(alone, {path.stem: scene})


def load_sweep(path: Path) -> Sweep:
    """Load a sweep from a YAML file, validate its scenes and expand its grid.

    Raises:
        InputError: if that fails.
    """
    return sweep_of(read_yaml(path))


def _tried_sweep(load: Callable[[OwnCode], Sweep]) -> Sweep:
    return tried(load, _own, _stated, lambda sweep: within(sweep.options.time_limit, sweep.options.memory_limit))


def _own(sweep: Sweep) -> list[Plugin]:
    return [*(plugin for run in sweep.expanded for plugin in run.own()), *found(sweep.reports)]


def _stated(sweep: Sweep) -> dict[str, Any]:
    return stated_by({run.solver.name: None for run in sweep.expanded})


def stated_by(solvers: Iterable[str]) -> dict[str, Any]:
    """Read the metadata of the user solvers among the given names, by importing their code."""
    return {str(name): stated(name) | {"packages": packages(name)} for name in found(solvers)}


def load_scene(path: Path) -> SceneSpec:
    """Load a scene from a YAML file, or from an assignment's JSON file; raise InputError.

    User code that it names is tried first in a worker process, as in `load_any`.
    """
    return tried(
        partial(_scene, path), lambda scene: [plugin for plugin, _ in scene.own.values()], _bound, lambda scene: MOST
    )


def _bound(scene: SceneSpec) -> dict[str, Any]:
    """Check a scene by building it at its default size; return no metadata of solvers."""
    if mistakes := misfits(scene, [scene.default_size or 0]):
        raise InputError(mistakes)
    return {}


def opened_scene(path: Path) -> SceneSpec:
    """Load a scene and import the code that it names in this process; raise InputError."""
    return _scene(path, IMPORTED)


def _scene(path: Path, own: OwnCode) -> SceneSpec:
    return scene_from_assignment(path) if _is_assignment(path) else scene_of(replace(read_yaml(path), own=own))


def scene_from_assignment(path: Path) -> SceneSpec:
    """Convert an assignment file to an equivalent scene; raise InputError.

    It has the same springs, force, pins and time step.
    """
    document = Document(path, {})
    check_name(document)
    if document.mistakes:
        raise document.error()
    assignment = read_assignment(path)
    k, pins, mesh = assignment.stiffness, assignment.pins.tolist(), AssignmentMesh(path=path)
    effects: tuple[dict[str, Any], ...] = (
        {"kind": "springs", "rule": "fixed", "stretch": k, "shear": k, "bend": k},
        {"kind": "constant-force", "force": FORCE},
        *([{"kind": "pins", "indices": pins, "weight": PIN_WEIGHT}] if pins else []),
    )
    return SceneSpec(
        mesh=mesh,
        mesh_digest=_digest(mesh),
        time_step=TIME_STEP,
        frames=ASSIGNMENT_FRAMES,
        effects=tuple(load(effect_names.EFFECTS[effect["kind"]])(**effect) for effect in effects),
        first_guess="assignment",
        path=path,
    )


def scene_of(document: Document) -> SceneSpec:
    """Build the scene of a document; raise InputError for all mistakes."""
    data = document.data
    if "scenes" in data and "mesh" not in data:
        raise InputError(Mistake("is a sweep; a scene is wanted here", document.path))
    check_name(document)
    fields = document.check(SceneFile, data)
    own: dict[str, tuple[Plugin, dict[str, Any]]] = {}
    mesh = _part(document, "mesh", data["mesh"], ("mesh",), own) if "mesh" in data else None
    listed: Any = data.get("effects", [])
    if not is_list(listed):
        document.report("should be a list of mappings, each with a `kind`", ("effects",))
        listed = []
    effects = tuple(_part(document, "effect", effect, ("effects", i), own) for i, effect in enumerate(listed))
    if fields is None or document.mistakes:
        raise document.error()
    parts: dict[str, Any] = {"mesh": mesh, "mesh_digest": _digest(mesh), "effects": effects}
    return SceneSpec(
        **vars(fields) | parts,
        path=document.path,
        own=own,
        lines={key_text(key): line for key, line in document.lines.items()},
    )


def _digest(source: Any) -> str:
    """Compute the SHA-256 of a mesh from a file, or "" for a generated mesh."""
    if isinstance(source, Generator):
        return ""
    mesh: Mesh = source.build(0)
    digest = hashlib.sha256()
    arrays = {"rest": mesh.rest, "springs": mesh.springs, "triangles": mesh.triangles, "shares": mesh.shares}
    for name, array in {**arrays, "mass": mesh.mass, **mesh.families}.items():
        digest.update(f"{name} {None if array is None else array.shape} ".encode())
        digest.update(b"" if array is None else array.tobytes())
    return digest.hexdigest()


_PARTS = {"mesh": (mesh_names.EVERY, OwnMesh), "effect": (effect_names.EVERY, OwnEffect)}


def _part(document: Document, what: str, data: Any, at: Key, own: dict[str, tuple[Plugin, dict[str, Any]]]) -> Any:
    """Build a mesh or an effect by the class of its `kind`.

    Only that class is imported.

    Args:
        document: config, which collects mistakes.
        what: "mesh" or "effect".
        data: mapping of the part.
        at: location of the part in the document.
        own: dictionary that receives user code, by location.
    """
    table, unopened = _PARTS[what]
    named = chosen(document, table, data, "kind", at)
    if named is None:
        return None
    name, parameters = named
    if not isinstance(name, Plugin):
        model = load(table[name])
        return document.check(model, document.with_paths(model, data, at), at)
    own[key_text(at)] = name, given(document, parameters)
    if not document.own.opens:
        return unopened(kind=name, parameters=parameters, folder=str(document.path.parent.absolute()))
    return checked(document, name, what, parameters, at)


def sweep_of(document: Document) -> Sweep:
    """Build the sweep of a document, with the scenes that it names; raise InputError.

    User code that it names is tried first in a worker process.
    """
    return _tried_sweep(partial(_sweep_by, document))


def _sweep_by(document: Document, own: OwnCode) -> Sweep:
    return _sweep_of(replace(document, own=own, mistakes=[]))


def _sweep_of(document: Document) -> Sweep:
    return _expanded(document, scenes_of(document))


def scenes_of(document: Document) -> dict[str, SceneSpec]:
    """Read the scenes listed under `scenes`, by name; mistakes are added to the document."""
    scenes: dict[str, SceneSpec] = {}
    listed: Any = document.data.get("scenes")
    for i, entry in enumerate(listed if is_list(listed) else []):
        if not isinstance(entry, str):
            continue  # the check of the whole sweep reports it
        at, path = ("scenes", i), document.path.parent / entry
        if not os.path.isfile(path):
            document.report(f"there is no file {quote(str(path))}", at)
        elif path.stem in scenes and not os.path.samefile(scenes[path.stem].path, path):
            document.report(f"two scenes are named {path.stem}; rename one of the files", at)
        else:
            try:
                scenes[path.stem] = _scene(path, document.own)
            except InputError as error:
                document.mistakes.extend(error.mistakes)
    return scenes


def _expanded(document: Document, scenes: dict[str, SceneSpec]) -> Sweep:
    check_name(document)
    sweep = document.check(SweepFields, document.data)
    solvers = solvers_of(document)
    if sweep is None or document.mistakes:
        raise document.error()
    runs = Expansion(document, document.path.stem, sweep, scenes, solvers).runs()
    if document.own.opens:
        for integrator in found({run.integrator: None for run in runs}):
            opened(document, integrator, "integrator", ("options", "integrator"))
        for report in found(sweep.reports):
            opened(document, report, "report", ("reports",))
    for name, scene in scenes.items():
        sizes = [run.size for run in runs if run.scene_name == name]
        document.mistakes.extend(misfits_of(document, name, scene, sizes))
    if document.mistakes:
        raise document.error()
    return Sweep(document.path.stem, sweep.options, runs, sweep.reports)


def require_stated(runs: Iterable[RunSpec]) -> None:
    """Raise InputError for a run with an error target, whose step size is not fixed."""
    if any(run.accuracy is not None for run in runs):
        raise InputError(
            Mistake("chooses the steps of each run, which `springbench run` does; leave it out", key="accuracy")
        )


def misfits_of(document: Document, name: str, scene: SceneSpec, sizes: Sequence[int]) -> list[Mistake]:
    """Find mistakes between the parts of a scene, if the policy permits.

    A scene with user code is checked only if that code is imported.

    Args:
        document: config with the policy for user code.
        name: name of the scene in messages.
        scene: scene to check.
        sizes: mesh sizes of its runs.
    """
    if not scene.own:
        return misfits(scene, sizes)
    document.own.tell(f"{BINDING}{name}")
    return misfits(scene, sizes) if document.own.opens else []


def misfits(scene: SceneSpec, sizes: Sequence[int]) -> list[Mistake]:
    """Find mistakes between the parts of a scene.

    The scene is built at the smallest of the sizes.
    """
    try:
        if sizes:
            build(scene, min(sizes))
    except InputError as error:
        return [replace(m, file=m.file or scene.path, line=m.line or scene.lines.get(m.key)) for m in error.mistakes]
    return []


def _is_assignment(path: Path) -> bool:
    return path.suffix.lower() == ".json"


def check_name(document: Document) -> None:
    """Add a mistake if the file's name is not a valid name of results."""
    if not NAME.fullmatch(document.path.stem):
        wanted = "rename it to letters, digits, `.`, `_` and `-`, at most 64, the first a letter or a digit"
        document.report(f"the file's name becomes the name of results; {wanted}")

"""Python interface for scripts and notebooks: scenes, steps, sweeps, rows, pictures and recordings.

scene = springbench.make_scene(mesh={"kind": "grid"}, mass=1.0, time_step=1/30, frames=60, default_size=16,
                           effects=[{"kind": "springs", "stretch": 300.0}, {"kind": "gravity"}])
simulation = springbench.Simulation(scene, "hybrid")
positions = simulation.step()                        # (n, 3) [m], after 1/30 s
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, Unpack, cast

import numpy as np
from numpy.typing import NDArray
from springbench.harness.config import config_loader
from springbench.harness.config.run_options import DEFAULT_SOLVER, DEFAULT_STOP_RULE
from springbench.harness.config.shipped_configs import locate_config
from springbench.harness.config.solver_parameters import read_solvers
from springbench.harness.config.typed_keys import (
    IntegratorName,
    OptionKeys,
    SceneKeys,
    SolverName,
    SweepKeys,
    UserCodeName,
)
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.recording.local_origin import compute_local_origin, store_relative
from springbench.harness.recording.recorder_interface import (
    INTERSECTION_FREE_PROPERTY,
    RecordingReplay,
    build_obstacles_property,
    list_obstacles,
)
from springbench.harness.recording.strain_shading import compute_strain_range
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.fabric_table import FABRIC_EFFECTS
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import InitialGuess, MeshSource, SceneSpec
from springbench.harness.schema.config_document import ConfigDocument, ConfigKey, format_key
from springbench.harness.simulation.time_loop import SimulationStep, build_initial_state, prepare, simulate_scene
from springbench.solvers.model.step_problem import Positions, Solver, StopRule
from springbench.solvers.plugins import plugin_discovery
from springbench.solvers.registry import SOLVER_TABLE

if TYPE_CHECKING:
    from springbench.harness.recording.notebook_viewer import NotebookViewer

__all__ = [
    "IntegratorName",
    "OptionKeys",
    "PngImage",
    "RunRecording",
    "SceneKeys",
    "Simulation",
    "SolverName",
    "SweepKeys",
    "UserCodeName",
    "draw_picture",
    "load_rows",
    "load_scene",
    "make_scene",
    "open_recording",
    "run_config",
    "view_recording",
]


def load_scene(path: str | Path) -> SceneSpec:
    """Load a scene from a file, or a shipped scene by its name.

    Args:
        path: YAML file, JSON file of an assignment, or name of a shipped scene.

    Raises:
        InputError: for any mistake in the scene.

    Example:
        >>> scene = springbench.load_scene("configs/scenes/chain.yaml")
        >>> scene.frames
        90
    """
    return config_loader.load_scene_in_process(locate_config(path))


def make_scene(
    *,
    mesh: Mapping[str, Any] | MeshSource,
    effects: Sequence[Mapping[str, Any] | SceneEffect] = (),
    folder: str | Path = ".",
    name: str = "scene",
    **fields: Unpack[SceneKeys],
) -> SceneSpec:
    """Build a scene in Python, with the keys that its file would have.

    Args:
        mesh: mapping as in a file, or a mesh object.
        effects: mappings as in a file, or effect objects.
        folder: folder of the files that the scene names.
        name: name of the scene in messages.
        fields: other keys of a scene file.

    Returns:
        The validated scene.

    Raises:
        InputError: for any mistake in the scene.

    Example:
        >>> effects = [{"kind": "springs", "stretch": 300.0}, {"kind": "gravity"}, {"kind": "pins", "parts": ["ends"]}]
        >>> scene = springbench.make_scene(
        ...     mesh={"kind": "chain"}, mass=1.0, time_step=1 / 30, frames=30, default_size=5, effects=effects
        ... )
        >>> scene.mesh.kind
        'chain'
    """
    # Objects are validated already. Placeholders stand for them while the other parts of the scene are checked.
    keys = [_list_effect_keys(effect, has_fabric=fields.get("fabric") is not None) for effect in effects]
    listed = [{"kind": "gravity"} if of_effect is None else of_effect for of_effect in keys]
    given = dict(mesh) if isinstance(mesh, Mapping) else {"kind": "grid"}
    data = {**fields, "mesh": given, "effects": listed}
    checked = config_loader.build_scene_from_document(
        ConfigDocument(Path(folder) / f"{name}.yaml", _to_plain_data(data))
    )
    own = tuple(
        effect if of_effect is None else made
        for effect, of_effect, made in zip(effects, keys, checked.effects, strict=True)
    )
    changed: dict[str, Any] = {"effects": own}
    if not isinstance(mesh, Mapping):
        changed["mesh"] = mesh
    return checked.model_copy(update=changed)


def _list_effect_keys(effect: Any, *, has_fabric: bool) -> dict[str, Any] | None:
    """Return the keys that an effect has in a file; None for an object.

    An object has keys only if a fabric may complete its material.
    """
    if isinstance(effect, Mapping):
        return dict(cast(Mapping[str, Any], effect))
    of = cast(object, effect).__class__
    if not has_fabric or f"{of.__module__}:{of.__qualname__}" not in [EFFECT_CLASSES[kind] for kind in FABRIC_EFFECTS]:
        return None
    return effect.model_dump(mode="json", exclude_unset=True) | {"kind": effect.kind}


class Simulation:
    """A simulation of a scene that advances step by step.

    Attributes:
        mesh: mesh at rest.
        last_step: last step, with its problem and its solution; None at the start.

    Example:
        >>> scene = springbench.load_scene("configs/scenes/chain.yaml")
        >>> simulation = springbench.Simulation(scene, "newton", size=5)
        >>> positions = simulation.step()
        >>> positions.shape, simulation.last_step.solution.termination_reason
        ((5, 3), 'converged')
    """

    def __init__(
        self,
        scene: SceneSpec,
        solver: SolverName | UserCodeName | Solver = DEFAULT_SOLVER,
        *,
        size: int | None = None,
        integrator: IntegratorName | UserCodeName = "implicit-euler",
        max_iterations: int = DEFAULT_STOP_RULE["max_iterations"],
        rtol: float | None = DEFAULT_STOP_RULE["rtol"],
        initial_guess: InitialGuess | None = None,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        """Build the scene and prepare the solver.

        Args:
            scene: scene to simulate.
            solver: a solver's name as in a sweep, or a solver object.
            size: mesh size; the scene's default if omitted.
            integrator: name of the time integrator.
            max_iterations: iteration limit of a step.
            rtol: relative tolerance of a step; None performs all iterations.
            initial_guess: initial guess of a step; the scene's default if omitted.
            parameters: parameters of a solver that is given by name.

        Raises:
            InputError: for a mistake in the scene, the integrator or the solver's parameters.
            Exception: of any type, from the preparation of the solver.
        """
        size = size if size is not None else scene.default_size
        self._spec, self._scene = scene, build_scene(scene, size or 0, integrator)
        if isinstance(solver, str):
            solver = _create_solver(solver, parameters or {}, scene.path)
        self._prepared = prepare(self._scene, solver)
        self._stop, self._guess = (
            StopRule(max_iterations, rtol),
            initial_guess or scene.choose_initial_guess(integrator),
        )
        self._start = self._state = build_initial_state(self._scene)
        self.mesh: Mesh = self._scene.mesh
        self.last_step: SimulationStep | None = None

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._scene.compute_time(self._state.index)

    @property
    def positions(self) -> Positions:
        """Copy of the vertex positions, (n, 3) [m]."""
        return self._state.motion.positions.copy()

    @property
    def velocity(self) -> Positions:
        """Copy of the vertex velocities, (n, 3) [m/s]."""
        return self._state.motion.velocity.copy()

    def step(self) -> Positions:
        """Advance by one step and return the new positions, (n, 3) [m]."""
        frames = self._state.index + 1
        (self.last_step,) = simulate_scene(
            self._scene, self._prepared, self._stop, initial_guess=self._guess, frames=frames, initial_state=self._state
        )
        self._state = self.last_step.state
        return self.positions

    def run_steps(self, count: int) -> NDArray[np.float64]:
        """Advance by `count` steps and return all their positions, (count, n, 3) [m]."""
        return np.array([self.step() for _ in range(count)])

    def draw_state(self) -> PngImage:
        """Draw the positions at the start and the present ones.

        Raises:
            RunFailed: if the system cannot draw.
        """
        states = [self._start, self._state] if self._state.index > self._start.index else [self._state]
        springs, origin = self._scene.all_springs, compute_local_origin(self.mesh.rest_positions)
        replay = RecordingReplay(
            title=self._spec.path.stem,
            run_id="",
            frames=np.array([state.index for state in states]),
            times=np.array([self._scene.compute_time(state.index) for state in states]),
            positions=np.stack([store_relative(state.motion.positions, origin) for state in states]),
            triangles=self.mesh.triangles,
            springs=springs.edges,
            rest_lengths=springs.rest_length,
            pinned_vertices=self._scene.system.pins.vertices,
            strain_range=compute_strain_range(
                self.mesh.rest_positions, [self._state.motion.positions], springs.edges, springs.rest_length
            ),
            scalars={},
            properties={
                **build_obstacles_property(list_obstacles(self._spec.effects)),
                INTERSECTION_FREE_PROPERTY: self._scene.has_self_contact,
            },
            origin=origin,
        )
        return draw_picture(replay)

    def _repr_png_(self) -> bytes | None:
        """Return the picture that a notebook displays; None where nothing can be drawn."""
        from springbench.harness.report.opengl_probe import find_opengl_problem

        return None if find_opengl_problem() else self.draw_state().content


def _create_solver(name: str, parameters: Mapping[str, Any], path: Path) -> Solver:
    document = ConfigDocument(path, {"solvers": [{"name": name, **parameters}]})
    found = read_solvers(document)
    if document.mistakes:
        raise document.build_error()
    return plugin_discovery.load_target(SOLVER_TABLE[found[0].name])(**found[0].parameters)


def run_config(
    config: str | Path | SweepKeys,
    *,
    name: str = "",
    folder: str | Path = ".",
    results: str | Path = "results",
    rerun: bool = False,
) -> Any:
    """Run the missing runs of a sweep, as `springbench run` does, and return its rows.

    Args:
        config: file of a sweep or a scene, name of a shipped one, or a sweep as a mapping.
        name: name of the sweep; required for a mapping.
        folder: folder of the scenes and the code that a mapping names.
        results: folder that contains a results folder for each sweep.
        rerun: whether to repeat runs that have results.

    Returns:
        The rows, a pandas DataFrame.

    Raises:
        InputError: for any mistake in the config.

    Example:
        >>> options = {"frames": 2, "rounds": 1, "verify": True, "pictures": False}
        >>> sweep = {"scenes": ["chain.yaml"], "sizes": [5], "solvers": ["sparse", "newton"], "options": options}
        >>> rows = springbench.run_config(sweep, name="small", folder="configs/scenes")
    """
    from springbench.harness.console import get_error_console
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.sweep_runner import ExecutionOptions, run_sweep
    from springbench.harness.report.report_plugins import run_reports
    from springbench.harness.results.folder_ownership import claim_folder

    if isinstance(config, Mapping):
        if not name:
            raise InputError("a sweep that is a mapping needs a name: run_config({...}, name='mine')")
        path = Path(folder) / f"{name}.yaml"
        sweep = config_loader.build_sweep_from_document(ConfigDocument(path, _to_plain_data(config)))
    else:
        path = locate_config(config)
        sweep = config_loader.load_config(path)
    place = claim_folder(Path(results) / sweep.name, path)
    table = run_sweep(
        sweep.name,
        sweep.list_runs(),
        place,
        create_display(get_error_console()),
        lambda line: None,
        ExecutionOptions(rerun=rerun),
    ).table
    run_reports(sweep.reports, table, place, sweep.options.time_limit)
    return _to_dataframe(table)


def _to_plain_data(value: Any, at: ConfigKey = ()) -> Any:
    """Convert config data to what its file would contain; raise InputError for other objects.

    Tuples and arrays become lists, paths become text.
    """
    if isinstance(value, Mapping):
        given = cast(Mapping[Any, Any], value)
        return {str(key): _to_plain_data(one, (*at, str(key))) for key, one in given.items()}
    if isinstance(value, np.ndarray | np.generic):
        return cast(Any, value).tolist()
    if isinstance(value, list | tuple):
        return [_to_plain_data(one, (*at, i)) for i, one in enumerate(cast(Sequence[Any], value))]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, str | int | float):
        return value
    of = value if isinstance(value, type) else cast(object, value).__class__
    got = f"the class {of.__name__}" if of is value else f"an object of {of.__name__}"
    file = Path(getattr(sys.modules.get(of.__module__), "__file__", None) or "mine.py").name
    expected = f'its name; write the class into a file next to the scenes, and give "./{file}:{of.__name__}"'
    raise InputError(InputMistake(f"got {got}; expected {expected}", key=format_key(at)))


def load_rows(folder: str | Path) -> Any:
    """Load the rows of a sweep's results folder.

    Args:
        folder: results folder, such as "results/quickstart".

    Returns:
        A pandas DataFrame; the columns are described in configs/reference/columns.md.

    Raises:
        InputError: for a damaged file of rows.

    Example:
        >>> rows = springbench.load_rows("results/small")
        >>> sorted(set(rows["solver"]))
        ['newton', 'sparse']
    """
    from springbench.harness.results.parquet_rows import read_rows
    from springbench.harness.results.row_store import list_units

    return _to_dataframe(read_rows(list_units(Path(folder) / "rows")))


def _to_dataframe(table: Any) -> Any:
    """Convert rows to a DataFrame whose integer and boolean columns may contain missing values."""
    import pandas as pd  # pyright: ignore[reportMissingTypeStubs]
    import pyarrow as pa

    return table.to_pandas(types_mapper={pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype()}.get)


class RunRecording(RecordingReplay):
    """A finished run, read from its recording; a notebook displays its picture.

    Example:
        >>> path = sorted(Path("results/small/recordings").glob("chain-5-newton-*.rrd"))[0]
        >>> len(springbench.open_recording(path).times)
        3
    """

    __slots__ = ()

    def __repr__(self) -> str:
        """Return the title and the numbers of frames and vertices."""
        frames, vertices, _ = self.positions.shape
        return f"RunRecording({self.title!r}, {frames} frames of {vertices} vertices)"

    def _repr_png_(self) -> bytes | None:
        """Return the picture that a notebook displays; None where nothing can be drawn."""
        from springbench.harness.report.opengl_probe import find_opengl_problem

        return None if find_opengl_problem() else draw_picture(self).content


def open_recording(path: str | Path) -> RunRecording:
    """Open a recording; a notebook displays its picture.

    Args:
        path: path of the recording.

    Returns:
        Times (k,) [s], positions (k, n, 3) [m] relative to `origin` (3,), springs and scalars. Its method
        `absolute_positions(k)` adds the origin in double precision.

    Raises:
        InputError: if the recording cannot be read.

    Example:
        >>> path = sorted(Path("results/small/recordings").glob("chain-5-newton-*.rrd"))[0]
        >>> springbench.open_recording(path).positions.shape
        (3, 5, 3)
    """
    from springbench.harness.recording.recording_reader import read_replay

    replay = read_replay(Path(path))
    return RunRecording(**{field.name: getattr(replay, field.name) for field in fields(replay)})


def view_recording(path: str | Path, *, width: int | Literal["auto"] = "auto", height: int = 600) -> NotebookViewer:
    """Show a recording in Rerun's viewer, in the output of a notebook cell.

    Args:
        path: path of the recording.
        width: width in pixels, or "auto" for that of the cell.
        height: height in pixels.

    Returns:
        The viewer, which a notebook displays at the end of a cell.

    Raises:
        InputError: if the recording cannot be read, or the extra `notebook` is not installed.

    Example:
        >>> springbench.view_recording(path, height=480).height
        480
    """
    from springbench.harness.recording.notebook_viewer import NotebookViewer
    from springbench.harness.recording.recording_reader import open_recording_source

    viewer = NotebookViewer(Path(path), width, height)
    with open_recording_source(viewer.path):
        return viewer


@dataclass(frozen=True, slots=True)
class PngImage:
    """A PNG image that a notebook displays.

    Attributes:
        content: bytes of the file.

    Example:
        >>> springbench.PngImage(b"...").save("picture.png").name
        'picture.png'
    """

    content: bytes

    def _repr_png_(self) -> bytes:
        return self.content

    def save(self, path: str | Path) -> Path:
        """Write the image to a file (.png) and return its path."""
        Path(path).write_bytes(self.content)
        return Path(path)


def draw_picture(source: str | Path | RecordingReplay | Mapping[str, str | Path | RecordingReplay]) -> PngImage:
    """Draw the picture of a run from its recording, or a comparison of several recordings.

    Args:
        source: a recording or its path, or a mapping of names to these.

    Raises:
        InputError: if a recording cannot be read.
        RunFailed: if the system cannot draw.

    Example:
        >>> picture = springbench.draw_picture(path)
        >>> picture.save("chain.png").name
        'chain.png'
    """
    from springbench.harness.report.comparison_picture import draw_comparison_picture
    from springbench.harness.report.run_picture import draw_run_picture

    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        if isinstance(source, Mapping):
            draw_comparison_picture({name: _load_replay(one) for name, one in source.items()}, path)
        else:
            draw_run_picture(_load_replay(source), path)
        return PngImage(path.read_bytes())


def _load_replay(one: str | Path | RecordingReplay) -> RecordingReplay:
    return one if isinstance(one, RecordingReplay) else open_recording(one)

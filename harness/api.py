"""Python interface for scripts and notebooks: scenes, steps, sweeps, rows, pictures and recordings.

scene = harness.make_scene(mesh={"kind": "grid"}, mass=1.0, time_step=1/30, frames=60, default_size=16,
                           effects=[{"kind": "springs", "stretch": 300.0}, {"kind": "gravity"}])
simulation = harness.Simulation(scene, "hybrid")
positions = simulation.step()                        # (n, 3) [m], after 1/30 s
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack, cast

import numpy as np
from numpy.typing import NDArray

from harness.base.document import Document, Key, key_text
from harness.base.errors import InputError, Mistake
from harness.config import load
from harness.config.keys import IntegratorName, OptionKeys, OwnName, SceneKeys, SolverName, SweepKeys
from harness.config.options import DEFAULT_SOLVER, DEFAULT_STOP
from harness.config.solvers import solvers_of
from harness.record.base import Replay
from harness.scenes.bind import build
from harness.scenes.effects.base import Effect
from harness.scenes.mesh.base import Mesh
from harness.scenes.spec import FirstGuess, MeshSource, SceneSpec
from harness.simulation.step import Step, prepare, simulate, start
from solvers import plugins
from solvers.problem import Positions, Solver, StopRule
from solvers.registry import EVERY

__all__ = [
    "IntegratorName",
    "OptionKeys",
    "OwnName",
    "Picture",
    "SceneKeys",
    "Simulation",
    "SolverName",
    "SweepKeys",
    "draw",
    "load_scene",
    "make_scene",
    "open_recording",
    "rows",
    "run",
]


def load_scene(path: str | Path) -> SceneSpec:
    """Load a scene from a YAML file, or from an assignment's JSON file; raise InputError."""
    return load.opened_scene(Path(path))


def make_scene(
    *,
    mesh: Mapping[str, Any] | MeshSource,
    effects: Sequence[Mapping[str, Any] | Effect] = (),
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
    Returns: the validated scene.
    Raises:
        InputError: for any mistake in the scene.
    """
    listed = [dict(effect) if isinstance(effect, Mapping) else {"kind": "gravity"} for effect in effects]
    given = dict(mesh) if isinstance(mesh, Mapping) else {"kind": "grid"}
    data = {**fields, "mesh": given, "effects": listed}
    checked = load.scene_of(Document(Path(folder) / f"{name}.yaml", _plain(data)))
    own = tuple(
        made if isinstance(effect, Mapping) else effect for effect, made in zip(effects, checked.effects, strict=True)
    )
    changed: dict[str, Any] = {"effects": own}
    if not isinstance(mesh, Mapping):
        changed["mesh"] = mesh
    return checked.model_copy(update=changed)


class Simulation:
    """A simulation of a scene that advances step by step.

    mesh: mesh at rest.
    time: simulated time [s].
    positions: (n, 3) [m].
    velocity: (n, 3) [m/s].
    last: last step, with its problem and its solution; None at the start.
    """

    def __init__(
        self,
        scene: SceneSpec,
        solver: SolverName | OwnName | Solver = DEFAULT_SOLVER,
        *,
        size: int | None = None,
        integrator: IntegratorName | OwnName = "implicit-euler",
        iterations: int = DEFAULT_STOP["iterations"],
        tolerance: float | None = DEFAULT_STOP["tolerance"],
        first_guess: FirstGuess | None = None,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        """Build the scene and prepare the solver.

        Args:
            scene: scene to simulate.
            solver: a solver's name as in a sweep, or a solver object.
            size: mesh size; the scene's default if omitted.
            integrator: name of the time integrator.
            iterations: iteration limit of a step.
            tolerance: relative tolerance of a step; None performs all iterations.
            first_guess: initial guess of a step; the scene's default if omitted.
            parameters: parameters of a solver that is given by name.
        Raises: InputError, and the errors of the solver's preparation.
        """
        size = size if size is not None else scene.default_size
        self._scene = build(scene, size or 0, integrator)
        if isinstance(solver, str):
            solver = _solver(solver, parameters or {}, scene.path)
        self._prepared = prepare(self._scene, solver)
        self._stop, self._guess = StopRule(iterations, tolerance), first_guess or scene.guess(integrator)
        self._state = start(self._scene)
        self.mesh: Mesh = self._scene.mesh
        self.last: Step | None = None

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._scene.time(self._state.index)

    @property
    def positions(self) -> Positions:
        """Copy of the vertex positions, (n, 3) [m]."""
        return self._state.now.positions.copy()

    @property
    def velocity(self) -> Positions:
        """Copy of the vertex velocities, (n, 3) [m/s]."""
        return self._state.now.velocity.copy()

    def step(self) -> Positions:
        """Advance by one step and return the new positions, (n, 3) [m]."""
        frames = self._state.index + 1
        (self.last,) = simulate(
            self._scene, self._prepared, self._stop, first_guess=self._guess, frames=frames, state=self._state
        )
        self._state = self.last.state
        return self.positions

    def steps(self, count: int) -> NDArray[np.float64]:
        """Advance by `count` steps and return all their positions, (count, n, 3) [m]."""
        return np.array([self.step() for _ in range(count)])


def _solver(name: str, parameters: Mapping[str, Any], path: Path) -> Solver:
    document = Document(path, {"solvers": [{"name": name, **parameters}]})
    found = solvers_of(document)
    if document.mistakes:
        raise document.error()
    return plugins.load(EVERY[found[0].name])(**found[0].parameters)


def run(
    config: str | Path | SweepKeys,
    *,
    name: str = "",
    folder: str | Path = ".",
    results: str | Path = "results",
    again: bool = False,
) -> Any:
    """Run what is missing of a sweep, as `springbench run`, and return its rows.

    Args:
        config: file of a sweep or a scene, or a sweep as a mapping.
        name: name of a sweep that is a mapping.
        folder: folder of the scenes and the code that a mapping names.
        results: folder that contains a results folder for each sweep.
        again: whether to repeat runs that have results.
    Returns: the rows, in the type that `rows` returns.
    Raises:
        InputError: for any mistake in the config.
    """
    from harness.base.claim import claimed
    from harness.base.console import err
    from harness.base.progress import Lines
    from harness.experiments.sweep import run_sweep
    from harness.report.named import draw_reports

    if isinstance(config, Mapping):
        if not name:
            raise InputError("a sweep that is a mapping needs a name: run({...}, name='mine')")
        path = Path(folder) / f"{name}.yaml"
        sweep = load.sweep_of(Document(path, _plain(config)))
    else:
        path = Path(config)
        sweep = load.load_any(path)
    place = claimed(Path(results) / sweep.name, path)
    table = run_sweep(sweep.name, sweep.runs(), place, Lines(err()), lambda line: None, again=again)
    draw_reports(sweep.reports, table, place, sweep.options.time_limit)
    return _frame(table)


def _plain(value: Any, at: Key = ()) -> Any:
    """Convert config data to what its file would contain; raise InputError for other objects.

    Tuples and arrays become lists, paths become text.
    """
    if isinstance(value, Mapping):
        given = cast(Mapping[Any, Any], value)
        return {str(key): _plain(one, (*at, str(key))) for key, one in given.items()}
    if isinstance(value, np.ndarray | np.generic):
        return cast(Any, value).tolist()
    if isinstance(value, list | tuple):
        return [_plain(one, (*at, i)) for i, one in enumerate(cast(Sequence[Any], value))]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, str | int | float):
        return value
    of = value if isinstance(value, type) else cast(object, value).__class__
    came = f"the class {of.__name__}" if of is value else f"an object of {of.__name__}"
    file = Path(getattr(sys.modules.get(of.__module__), "__file__", None) or "mine.py").name
    wanted = f'its name; write the class into a file beside the scenes, and give "./{file}:{of.__name__}"'
    raise InputError(Mistake(f"came {came}; wanted {wanted}", key=key_text(at)))


def rows(folder: str | Path) -> Any:
    """Load the rows of a sweep's results folder, such as "results/quickstart"; raise InputError.

    Returns: a polars DataFrame if polars is installed, else a pandas DataFrame, else a pyarrow table.
    """
    from harness.base.rows import read
    from harness.base.shelf import units

    return _frame(read(units(Path(folder) / "rows")))


def _frame(table: Any) -> Any:
    if find_spec("polars"):
        return import_module("polars").from_arrow(table)
    return table.to_pandas() if find_spec("pandas") else table


def open_recording(path: str | Path) -> Replay:
    """Open a recording; raise InputError if it cannot be read.

    Returns: times (k,) [s], positions (k, n, 3) [m] relative to `origin` (3,), springs and scalars. Its method
    `absolute_positions(k)` adds the origin in double precision.
    """
    from harness.record.reader import read_replay

    return read_replay(Path(path))


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG image that a notebook displays; content: bytes of the file."""

    png: bytes

    def _repr_png_(self) -> bytes:
        return self.png

    def save(self, path: str | Path) -> Path:
        """Write the image to a file (.png) and return its path."""
        Path(path).write_bytes(self.png)
        return Path(path)


def draw(what: str | Path | Replay | Mapping[str, str | Path | Replay]) -> Picture:
    """Draw the picture of a run from its recording, or a comparison of several recordings.

    Args:
        what: a recording or its path, or a mapping of names to these.
    Raises:
        InputError: if a recording cannot be read.
        RunFailed: if the system cannot draw.
    """
    from harness.report.comparison import draw_comparison
    from harness.report.run_picture import draw_run

    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        if isinstance(what, Mapping):
            draw_comparison({name: _replay(one) for name, one in what.items()}, path)
        else:
            draw_run(_replay(what), path)
        return Picture(path.read_bytes())


def _replay(one: str | Path | Replay) -> Replay:
    return one if isinstance(one, Replay) else open_recording(one)

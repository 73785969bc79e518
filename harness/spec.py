"""What a config says, once it was checked: scenes, sweeps, and the runs that a sweep asks for."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from pydantic import BeforeValidator, ConfigDict, Field, SkipValidation, WithJsonSchema

from harness.effects.base import Effect
from harness.errors import InputError, Mistake
from harness.mesh.base import Mesh
from harness.mesh.generator import MAX_VERTICES
from harness.model import Many, Model
from harness.start import AnyStart

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
"""Names of scenes and sweeps; they become names of files in the results."""

FirstGuess = Literal["assignment", "current", "inertial"]
IntegratorName = Literal["implicit-euler", "bdf2", "midpoint"]


def _seconds(value: Any) -> Any:
    """A fraction such as "1/30" as a number."""
    if not isinstance(value, str):
        return value
    try:
        return float(Fraction(value))
    except (ValueError, ZeroDivisionError, OverflowError) as error:
        raise ValueError(f'should be a number or a fraction such as "1/30", not {value[:40]!r}') from error


TimeStep = Annotated[
    float,
    Field(ge=1e-9, le=1e3),
    BeforeValidator(_seconds),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "number", "minimum": 1e-9, "maximum": 1e3},
                {"type": "string", "pattern": r"^[0-9]+(/[0-9]+)?$"},
            ]
        }
    ),
]
Speed = Annotated[float, Field(ge=-1e6, le=1e6)]
Size = Annotated[int, Field(ge=2, le=MAX_VERTICES)]
Frames = Annotated[int, Field(ge=1, le=1_000_000)]


class Camera(Model):
    """Where pictures look from; the camera aims at the mesh's middle."""

    azimuth: float = Field(default=0.0, ge=-360, le=360)
    """Angle around the vertical axis [degrees], 0 looks along -z."""
    elevation: float = Field(default=0.0, ge=-90, le=90)
    """Angle above the horizon [degrees]."""


class SceneFields(Model):
    """The keys of a scene that mean the same in its file and in memory."""

    description: str = Field(default="", max_length=1000)
    """One sentence about the scene."""
    mass: float | None = Field(default=None, gt=0, le=1e12)
    """Total mass [kg]; may be left out where the mesh brings masses of its own."""
    time_step: TimeStep
    """Time step [s], a number or a fraction such as "1/30"."""
    alternate_time_step: TimeStep | None = None
    """Time step [s] of every second step; that of all others if left out."""
    frames: Frames
    """Number of steps to simulate."""
    velocity: tuple[Speed, Speed, Speed] = (0.0, 0.0, 0.0)
    """Velocity of every vertex at the start [m/s]."""
    start: AnyStart | None = None
    """How the start differs from the rest shape."""
    default_size: Size | None = None
    """Mesh size where neither a sweep nor the command line gives sizes."""
    camera: Camera | None = None
    """Where pictures look from; chosen by the mesh's shape if left out."""


class SceneFile(SceneFields):
    """A scene: a mesh, its mass and time step, and the effects that act on it."""

    mesh: Any  # checked, like the effects, by the class that its kind names
    """The mesh; its `kind` says which."""
    effects: Any = ()
    """What acts on the mesh; only what is listed is simulated."""


class MeshSource(Protocol):
    """A mesh as a scene declares it: a pydantic model with a literal `kind`."""

    def build(self, size: int) -> Mesh:
        """The mesh of this size; raises InputError when it has no such size."""
        ...


class SceneSpec(SceneFields):
    """A checked scene."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    mesh: SkipValidation[MeshSource]
    """The mesh; its `kind` says which."""
    mesh_digest: str = ""
    """SHA-256 of a mesh from a file; empty for a generated mesh, which its parameters and its size determine."""
    effects: SkipValidation[tuple[Effect, ...]] = ()
    """What acts on the mesh; only what is listed is simulated."""
    first_guess: FirstGuess = "current"
    """Where a step's iteration starts if a sweep does not say."""
    path: Path
    """The file that the scene was read from, for messages."""
    lines: SkipValidation[Mapping[str, int]] = Field(default_factory=dict)
    """The lines of the keys in that file, for messages."""

    def stepped(self, time_step: float) -> SceneSpec:
        """The same scene with another time step [s], the same in all steps."""
        if time_step == self.time_step:
            return self
        values: dict[str, Any] = {key: getattr(self, key) for key in SceneSpec.model_fields}
        return SceneSpec.model_construct(None, **values | {"time_step": time_step, "alternate_time_step": None})

    def require_even_steps(self) -> None:
        """Raise InputError for a scene whose steps differ in length."""
        if self.alternate_time_step is not None:
            key, wanted = "alternate_time_step", "what is measured here depends on one time step; leave it out"
            raise InputError(Mistake(wanted, self.path, self.lines.get(key), key))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that determines a run of the scene; mesh files count by content, not by name."""
        content = self.model_dump(mode="json", include={"mass", "time_step", "velocity", "camera", "mesh", "effects"})
        content["mesh"] = self.mesh_digest or content["mesh"]
        if self.start:
            content["start"] = self.start.model_dump(mode="json")
        if self.alternate_time_step is not None:
            content["alternate_time_step"] = self.alternate_time_step
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


Iterations = Annotated[int, Field(ge=1, le=100_000)]
Tolerance = Annotated[float, Field(gt=0, lt=1)] | None
Threads = Annotated[int, Field(ge=1, le=1024)]
AUTO: Literal["auto"] = "auto"
Rounds = Annotated[int, Field(ge=1, le=1000)]


class Grid(Model):
    """Options that a sweep can vary: one value, or a list of values to run each of."""

    iterations: Many[Iterations] = (50,)
    """Iteration limit of a step."""
    tolerance: Many[Tolerance] = (None,)
    """Relative tolerance that ends a step's iterations; null does all of them."""
    integrator: Many[IntegratorName] = ("implicit-euler",)
    """How time is integrated."""
    time_step: Many[TimeStep | None] = (None,)
    """Time step [s]; null takes the scene's."""
    first_guess: Many[FirstGuess | None] = (None,)
    """Where a step's iteration starts; null is `assignment` for JSON scenes, else `current`."""
    threads: Many[Threads | Literal["auto"]] = (1,)
    """Threads of Numba and of BLAS; auto: as many as there are cores that nobody else uses."""
    frames: Many[Frames | None] = (None,)
    """Number of steps; null takes the scene's."""
    rounds: Many[Rounds] = (2,)
    """How often the timed part is repeated."""


class Options(Grid):
    """Options of a sweep's runs."""

    convergence_frames: tuple[Annotated[int, Field(ge=1)], ...] | None = None
    """Frames whose convergence is measured; null is the first, the middle and the last."""
    strain_range: float = Field(default=0.1, gt=0, le=10)
    """Strain at the ends of the colour scale (0.1 is 10 %), the same for the whole sweep."""
    record: bool = True
    """Whether a Rerun recording is written for each run."""
    pictures: bool = True
    """Whether pictures are drawn from the recordings."""
    judge: bool = False
    """Whether an oracle judges each step's answer in the rows: for `springbench report`, on small meshes."""


class Include(Model):
    """Runs beside the grid: what is left out means every scene, every solver, and an option's first value."""

    scene: Many[str] = ()
    """Names of scenes, the stems of their files."""
    size: Many[Size] = ()
    """Mesh sizes; they need not be among the sweep's."""
    solver: Many[str] = ()
    """Names of solvers that the sweep lists."""
    iterations: Many[Iterations] = ()
    """Iteration limits of a step."""
    tolerance: Many[Tolerance] = ()
    """Relative tolerances; null is the run without one."""
    integrator: Many[IntegratorName] = ()
    """How time is integrated."""
    time_step: Many[TimeStep] = ()
    """Time steps [s]."""
    first_guess: Many[FirstGuess] = ()
    """Where a step's iteration starts."""
    threads: Many[Threads | Literal["auto"]] = ()
    """Numbers of threads."""
    frames: Many[Frames] = ()
    """Numbers of steps."""
    rounds: Many[Rounds] = ()
    """Repetitions of the timed part."""


class Exclude(Include):
    """Grid points to leave out: those that match all keys of the entry."""

    size_above: int | None = None
    """Matches sizes larger than this."""
    size_below: int | None = None
    """Matches sizes smaller than this."""


class SweepFields(Model):
    """A sweep: scenes, sizes, solvers and options, of which every combination is a run."""

    description: str = Field(default="", max_length=1000)
    """One sentence about what the sweep asks."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the sweep file."""
    sizes: tuple[Size, ...] = ()
    """Mesh sizes; may be left out where every scene has a default size or takes its mesh from a file."""
    solvers: tuple[str | dict[str, Any], ...] = Field(min_length=1)
    """Solvers: a name, or a mapping of `name` and the solver's parameters."""
    options: Options = Options()
    """Options; lists make a grid."""
    exclude: tuple[Exclude, ...] = ()
    """Grid points to leave out."""
    include: tuple[Include, ...] = ()
    """Runs beside the grid."""


@dataclass(frozen=True, slots=True)
class SolverSpec:
    """A solver's name and all of its parameters, defaults included."""

    name: str
    parameters: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class RunSpec:
    """One run. size: 0 where the mesh comes from a file.

    frames, time_step (which is the scene's own here) and first_guess are resolved; tolerance: None does all iterations;
    convergence_frames: None is the first, the middle and the last; strain_range: strain at the colour scale's ends.
    """

    sweep: str
    scene_name: str
    scene: SceneSpec
    size: int
    solver: SolverSpec
    iterations: int
    tolerance: float | None
    integrator: IntegratorName
    time_step: float
    first_guess: FirstGuess
    threads: int | Literal["auto"]
    frames: int
    rounds: int
    convergence_frames: tuple[int, ...] | None
    strain_range: float
    record: bool
    pictures: bool
    judge: bool

    def identity(self) -> str:
        """All that determines the run's result and timing on one machine, as canonical JSON."""
        settings = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("sweep", "scene_name")}
        settings |= {"scene": self.scene.digest, "solver": [self.solver.name, dict(self.solver.parameters)]}
        return json.dumps(settings, sort_keys=True, separators=(",", ":"))

    def run_id(self, machine: str) -> str:
        """The run's name on a machine, 12 hex digits of SHA-256; names of sweep and scene are no part."""
        return hashlib.sha256(f"{machine} {self.identity()}".encode()).hexdigest()[:12]

    def label(self, machine: str) -> str:
        """The run's name in the names of its files."""
        return f"{self.scene_name}-{self.size}-{self.solver.name}-{self.run_id(machine)}"

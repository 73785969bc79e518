"""What a sweep asks, once it was checked: its options, and the runs that they make."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

from pydantic import Field

from harness.base.model import Many, Model
from harness.scenes.spec import FirstGuess, Frames, IntegratorName, SceneSpec, Size, TimeStep

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
        """All that determines the run's result and timing on one machine, as canonical JSON; pictures come later, from
        the recording."""
        left_out = ("sweep", "scene_name", "pictures")
        settings = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}
        settings |= {"scene": self.scene.digest, "solver": [self.solver.name, dict(self.solver.parameters)]}
        return json.dumps(settings, sort_keys=True, separators=(",", ":"))

    def run_id(self, machine: str) -> str:
        """The run's name on a machine, 12 hex digits of SHA-256; names of sweep and scene are no part."""
        return hashlib.sha256(f"{machine} {self.identity()}".encode()).hexdigest()[:12]

    def label(self, machine: str) -> str:
        """The run's name in the names of its files."""
        return f"{self.scene_name}-{self.size}-{self.solver.name}-{self.run_id(machine)}"

"""What a sweep asks, once it was checked: its options, and the runs that they make."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import ConfigDict, Field

from harness.base.model import Many, Model
from harness.scenes.spec import FirstGuess, Frames, IntegratorName, SceneSpec, Size, TimeStep, named_in
from solvers.plugins import Plugin, Table, found, identity

REPORTS: dict[str, str] = {"medians": "harness.report.medians:medians", "timing": "harness.report.timing_plot:timing"}
"""The shipped reports by name; each is a function `report(rows, folder)` that answers the files it wrote."""

EVERY_REPORT = Table("springbench.reports", REPORTS)
"""All that a sweep can name."""

if TYPE_CHECKING:
    ReportName = str
else:
    ReportName = named_in(EVERY_REPORT)

Iterations = Annotated[int, Field(ge=1, le=100_000)]
Tolerance = Annotated[float, Field(gt=0, lt=1)] | None
Threads = Annotated[int, Field(ge=1, le=1024)]
AUTO: Literal["auto"] = "auto"
Rounds = Annotated[int, Field(ge=1, le=1000)]


class Option(NamedTuple):
    """What is known of an option besides its type: how its value is named where space is short, and its column of rows
    ("" for none)."""

    short: str
    column: str = ""


class Varied(Model):
    """Options that a sweep can vary: one value, or a list of values to run each of."""

    iterations: Annotated[Many[Iterations], Option("{} it.", "max_iterations")] = (50,)
    """Iteration limit of a step."""
    tolerance: Annotated[Many[Tolerance], Option("tol. {}", "tolerance")] = (None,)
    """Relative tolerance that ends a step's iterations; null does all of them."""
    integrator: Annotated[Many[IntegratorName], Option("{}", "integrator")] = ("implicit-euler",)
    """How time is integrated."""
    time_step: Annotated[Many[TimeStep | None], Option("dt {:.3g}", "time_step")] = (None,)
    """Time step [s]; null takes the scene's."""
    first_guess: Annotated[Many[FirstGuess | None], Option("{}", "first_guess")] = (None,)
    """Where a step's iteration starts; null is `assignment` for JSON scenes, else `current`."""
    threads: Annotated[Many[Threads | Literal["auto"]], Option("{} thr.", "threads")] = (1,)
    """Threads of Numba and of BLAS; auto: as many as there are cores that nobody else uses."""
    frames: Annotated[Many[Frames | None], Option("{} frames")] = (None,)
    """Number of steps; null takes the scene's."""
    rounds: Annotated[Many[Rounds], Option("{} rounds")] = (2,)
    """How often the timed part is repeated."""


OPTIONS: dict[str, Option] = {
    name: option
    for name, field in Varied.model_fields.items()
    for option in field.metadata
    if isinstance(option, Option)
}
"""By name. What a sweep varies, what its entries match, how runs and their rows are named follow from it."""


class Options(Varied):
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
    time_limit: float | None = Field(default=3600.0, gt=0, le=1e7)
    """Wall time [s] that a run may take, all of it; null is any. One that takes longer is ended, and is a row."""
    memory_limit: float | None = Field(default=None, gt=0, le=1e6)
    """Memory [GiB] that a run may take beyond what a process has anyway; null is any."""


def _without_defaults(schema: dict[str, Any]) -> None:
    """What an entry leaves out is not the default of a sweep."""
    for described in schema["properties"].values():
        described.pop("default", None)


class Include(Varied):
    """Runs beside the grid: what is left out means every scene, every solver, and an option's first value."""

    model_config = ConfigDict(json_schema_extra=_without_defaults)

    scene: Many[str] = ()
    """Names of scenes, the stems of their files."""
    size: Many[Size] = ()
    """Mesh sizes; they need not be among the sweep's."""
    solver: Many[str] = ()
    """Names of solvers that the sweep lists."""

    def stated(self, key: str) -> tuple[Any, ...]:
        """The values that the entry lists under a key; none where it leaves it out."""
        return getattr(self, key) if key in self.model_fields_set else ()


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
    reports: tuple[ReportName, ...] = ()
    """What is told of the rows when all runs are done, beside the pictures."""


@dataclass(frozen=True, slots=True)
class SolverSpec:
    """A solver's name and all of its parameters, defaults included."""

    name: str
    parameters: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class RunSpec:
    """One run. size: 0 where the mesh comes from a file.

    frames, time_step (which is the scene's own here) and first_guess are resolved; tolerance: None does all iterations;
    convergence_frames: None is the first, the middle and the last; strain_range: strain at the colour scale's ends;
    time_limit, memory_limit: what the run may take [s] [GiB], None is any.
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
    time_limit: float | None
    memory_limit: float | None

    @property
    def title(self) -> str:
        """The run in words."""
        return f"{self.scene_name}{f' {self.size}' if self.size else ''} {self.solver.name}"

    def identity(self) -> str:
        """All that determines the run's result and timing on one machine, as canonical JSON; pictures come later, from
        the recording, and limits only say when to give up."""
        left_out = ("sweep", "scene_name", "pictures", "time_limit", "memory_limit")
        settings = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}
        settings |= {"scene": self.scene.digest, "solver": [identity(self.solver.name), dict(self.solver.parameters)]}
        settings["integrator"] = identity(self.integrator)
        return json.dumps(settings, sort_keys=True, separators=(",", ":"))

    def run_id(self, machine: str) -> str:
        """The run's name on a machine, 12 hex digits of SHA-256; names of sweep and scene are no part."""
        return hashlib.sha256(f"{machine} {self.identity()}".encode()).hexdigest()[:12]

    def label(self, machine: str) -> str:
        """The run's name in the names of its files."""
        return f"{self.scene_name}-{self.size}-{in_file_name(self.solver.name)}-{self.run_id(machine)}"

    def own(self) -> list[Plugin]:
        """Somebody's own code in the run: the solver, the integrator, the mesh, effects."""
        return found([self.solver.name, self.integrator, *(plugin for plugin, _ in self.scene.own.values())])


def in_file_name(name: str) -> str:
    """A name as part of the names of files: that of own code has no colon and no slash there."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip("._")

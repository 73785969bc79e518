"""What a sweep asks, once it was checked: its options, and the runs that they make."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field, SkipValidation

from harness.base.files import safe_name
from harness.base.model import Many, Model
from harness.base.stated import packages, stated
from harness.config.options import OPTIONS, Chosen, lists
from harness.scenes.spec import SceneSpec, Size, named_in
from solvers.plugins import Plugin, Table, found, identity
from solvers.registry import EVERY, load, minimises

REPORTS: dict[str, str] = {
    "certificates": "harness.report.certificates:certificates",
    "medians": "harness.report.medians:medians",
    "timing": "harness.report.timing_plot:timing",
}
"""The shipped reports by name; each is a function `report(rows, folder)` that answers the files it wrote."""

EVERY_REPORT = Table("springbench.reports", REPORTS)
"""All that a sweep can name."""

if TYPE_CHECKING:
    ReportName = str
else:
    ReportName = named_in(EVERY_REPORT)


class Varied(lists(*OPTIONS)):
    """Options that a sweep can vary: one value, or a list of values to run each of."""


class Kept(Model):
    """Options that are the same for all runs of a sweep."""

    convergence_frames: tuple[Annotated[int, Field(ge=1)], ...] | None = None
    """Frames whose convergence is measured; null is the first, the middle and the last."""
    strain_range: float | None = Field(default=None, gt=0, le=10)
    """Strain at the ends of a recording's colour scale (0.1 is 10 %); null takes it from where the run ends."""
    record: bool = True
    """Whether a Rerun recording is written for each run."""
    pictures: bool = True
    """Whether pictures are drawn from the recordings."""
    judge: bool = False
    """Whether an oracle judges each step's answer in the rows: for `springbench report`, on small meshes."""
    timing: Literal["exclusive", "shared", "rough"] = "exclusive"
    """exclusive: while a run is timed, nothing else of springbench's computes on the machine; shared: several are timed
    at once, each on cores of its own, and their rows say so; rough: no pass is there to be timed, the steps are done
    once and looked at, and their times are of that: for what is not about times, without recordings."""
    time_limit: float | None = Field(default=3600.0, gt=0, le=1e7)
    """Wall time [s] that a run may take, all of it; null is any. One that takes longer is ended, and is a row."""
    memory_limit: float | None = Field(default=None, gt=0, le=1e6)
    """Memory [GiB] that a run may take beyond what a process has anyway; null is any."""


class Options(Kept, Varied):
    """Options of a sweep's runs."""


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
    """A solver's name and all of its parameters, defaults included. stated: what the class of somebody's own states,
    as `harness.base.stated` has it, its `packages` among it; nothing for shipped ones."""

    name: str
    parameters: Mapping[str, Any]
    stated: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def columns(self) -> dict[str, Any]:
        """The columns of what it states of itself; the class of somebody's own is not imported for them."""
        if not isinstance(self.name, Plugin):
            return stated(self.name)
        return {name: value for name, value in self.stated.items() if name != "packages"}

    @property
    def minimises(self) -> bool:
        """See `solvers.registry.minimises`."""
        own = isinstance(self.name, Plugin)
        return bool(self.stated.get("minimises", True)) if own else minimises(load(EVERY[self.name]))

    @property
    def packages(self) -> tuple[str, ...]:
        """The distributions of others that it is an interface to."""
        return tuple(self.stated.get("packages", ())) if isinstance(self.name, Plugin) else packages(self.name)


class RunSpec(Kept, Chosen):
    """One run, made with `model_construct` of what was checked before.

    size: 0 where the mesh comes from a file; frames, time_step (which is the scene's own here) and first_guess are
    resolved.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    sweep: str
    scene_name: str
    scene: SkipValidation[SceneSpec]
    size: int
    solver: SkipValidation[SolverSpec]

    def but(self, **other: Any) -> RunSpec:
        """The same run with other values."""
        return self.model_copy(update=other)

    @property
    def title(self) -> str:
        """The run in words."""
        return f"{self.scene_name}{f' {self.size}' if self.size else ''} {self.solver.name}"

    @property
    def passes(self) -> int:
        """How often the steps are done: to warm up, to be timed, and to be looked at."""
        return 1 if self.timing == "rough" else self.rounds + 2

    def identity(self) -> str:
        """All that determines the run's result and timing on one machine, as canonical JSON; pictures come later, from
        the recording, and limits only say when to give up."""
        left_out = ("sweep", "scene_name", "pictures", "time_limit", "memory_limit")
        settings = {name: value for name, value in self if name not in left_out}
        settings |= {"scene": self.scene.digest, "solver": [identity(self.solver.name), dict(self.solver.parameters)]}
        settings["integrator"] = identity(self.integrator)
        if self.timing == "exclusive":  # as it always was before there was another
            del settings["timing"]
        if self.accuracy is None:
            del settings["accuracy"]
        return json.dumps(settings, sort_keys=True, separators=(",", ":"))

    def run_id(self, machine: str) -> str:
        """The run's name on a machine, 12 hex digits of SHA-256; names of sweep and scene are no part."""
        return hashlib.sha256(f"{machine} {self.identity()}".encode()).hexdigest()[:12]

    def label(self, machine: str) -> str:
        """The run's name in the names of its files."""
        return f"{self.scene_name}-{self.size}-{safe_name(self.solver.name)}-{self.run_id(machine)}"

    def own(self) -> list[Plugin]:
        """Somebody's own code in the run: the solver, the integrator, the mesh, effects."""
        return found([self.solver.name, self.integrator, *(plugin for plugin, _ in self.scene.own.values())])

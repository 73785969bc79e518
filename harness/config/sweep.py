"""Models of a validated sweep: its options and its runs."""

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
"""The shipped reports by name; each is a function `report(rows, folder)` that returns the files it wrote."""

EVERY_REPORT = Table("springbench.reports", REPORTS)
"""All reports that a sweep can name."""

if TYPE_CHECKING:
    ReportName = str
else:
    ReportName = named_in(EVERY_REPORT)


class Varied(lists(*OPTIONS)):
    """Options that a sweep can vary: one value, or a list of values."""


class Kept(Model):
    """Options that all runs of a sweep share."""

    convergence_frames: tuple[Annotated[int, Field(ge=1)], ...] | None = None
    """Frames whose convergence is measured; null is the first, the middle and the last."""
    strain_range: float | None = Field(default=None, gt=0, le=10)
    """Strain at the ends of a recording's colour scale (0.1 is 10 %); null uses the strain at the end of the run."""
    record: bool = True
    """Whether a Rerun recording is written for each run."""
    pictures: bool = True
    """Whether pictures are drawn from the recordings."""
    judge: bool = False
    """Whether the reference evaluator verifies each step's result in the rows, for `springbench report`; for small
    meshes."""
    timing: Literal["exclusive", "shared", "rough"] = "exclusive"
    """exclusive: while a run is timed, no other springbench process computes on the machine; shared: several runs are
    timed concurrently, each on reserved cores, and their rows state that; rough: there is no timed pass, the steps are
    computed once with instrumentation, and the times include it. rough is for questions other than times, without
    recordings.
    """
    time_limit: float | None = Field(default=3600.0, gt=0, le=1e7)
    """Wall time [s] of a whole run; null is unlimited. A run that exceeds it is stopped, and its row records that."""
    memory_limit: float | None = Field(default=None, gt=0, le=1e6)
    """Memory [GiB] of a run, beyond what its process uses anyway; null is unlimited."""


class Options(Kept, Varied):
    """Options of a sweep's runs."""


def _without_defaults(schema: dict[str, Any]) -> None:
    """Remove the defaults of a sweep, which do not apply to entries."""
    for described in schema["properties"].values():
        described.pop("default", None)


class Include(Varied):
    """Runs in addition to the grid.

    An omitted key selects every scene, every solver, or an option's first value.
    """

    model_config = ConfigDict(json_schema_extra=_without_defaults)

    scene: Many[str] = ()
    """Names of scenes, the stems of their files."""
    size: Many[Size] = ()
    """Mesh sizes, which need not be among the sweep's."""
    solver: Many[str] = ()
    """Names of solvers that the sweep lists."""

    def stated(self, key: str) -> tuple[Any, ...]:
        """Return the values of a key, or none if the entry omits it."""
        return getattr(self, key) if key in self.model_fields_set else ()


class Exclude(Include):
    """Grid points to leave out: those that match all keys of the entry."""

    size_above: int | None = None
    """Matches sizes larger than this."""
    size_below: int | None = None
    """Matches sizes smaller than this."""


class SweepFields(Model):
    """A sweep: scenes, sizes, solvers and options; every combination is a run."""

    description: str = Field(default="", max_length=1000)
    """One sentence about the question that the sweep answers."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the sweep file."""
    sizes: tuple[Size, ...] = ()
    """Mesh sizes; may be left out if every scene has a default size or a mesh from a file."""
    solvers: tuple[str | dict[str, Any], ...] = Field(min_length=1)
    """Solvers: a name, or a mapping of `name` and the solver's parameters."""
    options: Options = Options()
    """Options; lists form a grid."""
    exclude: tuple[Exclude, ...] = ()
    """Grid points to leave out."""
    include: tuple[Include, ...] = ()
    """Runs in addition to the grid."""
    reports: tuple[ReportName, ...] = ()
    """Reports on the rows of all runs, in addition to the pictures."""


@dataclass(frozen=True, slots=True)
class SolverSpec:
    """A solver's name and all of its parameters, including defaults.

    stated: metadata of a user's class, as in `harness.base.stated`, with its `packages`; empty for
    shipped solvers.
    """

    name: str
    parameters: Mapping[str, Any]
    stated: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def columns(self) -> dict[str, Any]:
        """Metadata columns of the solver; the class of user code is not imported for them."""
        if not isinstance(self.name, Plugin):
            return stated(self.name)
        return {name: value for name, value in self.stated.items() if name != "packages"}

    @property
    def minimises(self) -> bool:
        """Whether the solver's iterates tend to a minimum, as in `solvers.registry.minimises`."""
        own = isinstance(self.name, Plugin)
        return bool(self.stated.get("minimises", True)) if own else minimises(load(EVERY[self.name]))

    @property
    def packages(self) -> tuple[str, ...]:
        """Third-party distributions that the solver is an interface to."""
        return tuple(self.stated.get("packages", ())) if isinstance(self.name, Plugin) else packages(self.name)


class RunSpec(Kept, Chosen):
    """One run, built with `model_construct` from validated values.

    size: 0 if the mesh comes from a file. frames, time_step (that of the scene here) and initial_guess are resolved.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    sweep: str
    scene_name: str
    scene: SkipValidation[SceneSpec]
    size: int
    solver: SkipValidation[SolverSpec]

    def but(self, **other: Any) -> RunSpec:
        """Return a copy of the run with other values of some options."""
        return self.model_copy(update=other)

    @property
    def title(self) -> str:
        """Description of the run."""
        return f"{self.scene_name}{f' {self.size}' if self.size else ''} {self.solver.name}"

    @property
    def passes(self) -> int:
        """Number of passes over the steps: warm-up, timed rounds, and instrumentation."""
        return 1 if self.timing == "rough" else self.rounds + 2

    def identity(self) -> str:
        """Build canonical JSON of everything that determines the run's result and timing on one machine.

        Pictures are drawn later from the recording, and limits only determine when a run is stopped; both are excluded.
        """
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
        """Compute the run's id on a machine, 12 hex digits of SHA-256.

        It is independent of the names of sweep and scene.
        """
        return hashlib.sha256(f"{machine} {self.identity()}".encode()).hexdigest()[:12]

    def label(self, machine: str) -> str:
        """Build the stem of the run's file names."""
        return f"{self.scene_name}-{self.size}-{safe_name(self.solver.name)}-{self.run_id(machine)}"

    def own(self) -> list[Plugin]:
        """Find the user code of the run: solver, integrator, mesh and effects."""
        return found([self.solver.name, self.integrator, *(plugin for plugin, _ in self.scene.own.values())])

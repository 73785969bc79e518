"""Models of a validated sweep: its options and its runs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field, SkipValidation
from springbench.harness.atomic_files import sanitise_name
from springbench.harness.config.run_options import RUN_OPTIONS, RunOptions, build_list_model
from springbench.harness.results.solver_metadata import list_packages, read_solver_metadata
from springbench.harness.scenes.scene_spec import MeshSize, SceneSpec, build_name_type
from springbench.harness.schema.base_model import ConfigModel, OneOrMany
from springbench.solvers.plugins.plugin_discovery import PluginName, PluginTable, identify_code, select_plugins
from springbench.solvers.registry import SOLVER_TABLE, is_minimiser, load_target

SHIPPED_REPORTS: dict[str, str] = {
    "certificates": "springbench.harness.report.intersection_certificates:write_certificates",
    "medians": "springbench.harness.report.median_times:write_medians",
    "timing": "springbench.harness.report.timing_plot:write_timing_plot",
}
"""The shipped reports by name; each is a function `report(rows, folder)` that returns the files it wrote."""

REPORT_TABLE = PluginTable("springbench.reports", SHIPPED_REPORTS)
"""All reports that a sweep can name."""

if TYPE_CHECKING:
    ReportName = str
else:
    ReportName = build_name_type(REPORT_TABLE)


class VariedOptions(build_list_model(*RUN_OPTIONS)):
    """Options that a sweep can vary: one value, or a list of values."""


class FixedOptions(ConfigModel):
    """Options that all runs of a sweep share."""

    convergence_frames: tuple[Annotated[int, Field(ge=1)], ...] | None = None
    """Frames whose convergence is measured; null is the first, the middle and the last."""
    strain_range: float | None = Field(default=None, gt=0, le=10)
    """Strain at the ends of a recording's colour scale (0.1 is 10 %); null uses the strain at the end of the run."""
    record: bool = True
    """Whether a Rerun recording is written for each run."""
    pictures: bool = True
    """Whether pictures are drawn from the recordings."""
    verify: bool = False
    """Whether the reference evaluator verifies each step's result in the rows, for `springbench report`; for small
    meshes."""
    timing: Literal["exclusive", "shared", "none"] = "exclusive"
    """exclusive: while a run is timed, no other springbench process computes on the machine; shared: several runs are
    timed concurrently, each on reserved cores, and their rows state that; none: there is no timed pass, the steps are
    computed once with instrumentation, and the times include it. none is for questions other than times, without
    recordings.
    """
    time_limit: float | None = Field(default=3600.0, gt=0, le=1e7)
    """Wall time [s] of a whole run; null is unlimited. A run that exceeds it is stopped, and its row records that."""
    memory_limit: float | None = Field(default=None, gt=0, le=1e6)
    """Memory [GiB] of a run, beyond what its process uses anyway; null is unlimited."""


class SweepOptions(FixedOptions, VariedOptions):
    """Options of a sweep's runs."""


def _remove_defaults(schema: dict[str, Any]) -> None:
    """Remove the defaults of a sweep, which do not apply to entries."""
    for described in schema["properties"].values():
        described.pop("default", None)


class IncludeEntry(VariedOptions):
    """Runs in addition to the grid.

    An omitted key selects every scene, every solver, or an option's first value.
    """

    model_config = ConfigDict(json_schema_extra=_remove_defaults)

    scene: OneOrMany[str] = ()
    """Names of scenes, the stems of their files."""
    size: OneOrMany[MeshSize] = ()
    """Mesh sizes, which need not be among the sweep's."""
    solver: OneOrMany[str] = ()
    """Names of solvers that the sweep lists."""

    def get_values(self, key: str) -> tuple[Any, ...]:
        """Return the values of a key, or none if the entry omits it."""
        return getattr(self, key) if key in self.model_fields_set else ()


class ExcludeEntry(IncludeEntry):
    """Grid points to leave out: those that match all keys of the entry."""

    size_above: int | None = None
    """Matches sizes larger than this."""
    size_below: int | None = None
    """Matches sizes smaller than this."""


class SweepConfig(ConfigModel):
    """A sweep: scenes, sizes, solvers and options; every combination is a run."""

    description: str = Field(default="", max_length=1000)
    """One sentence about the question that the sweep answers."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the sweep file, or names of shipped scenes."""
    sizes: tuple[MeshSize, ...] = ()
    """Mesh sizes; may be left out if every scene has a default size or a mesh from a file."""
    solvers: tuple[str | dict[str, Any], ...] = Field(min_length=1)
    """Solvers: a name, or a mapping of `name` and the solver's parameters."""
    options: SweepOptions = SweepOptions()
    """Options; lists form a grid."""
    exclude: tuple[ExcludeEntry, ...] = ()
    """Grid points to leave out."""
    include: tuple[IncludeEntry, ...] = ()
    """Runs in addition to the grid."""
    reports: tuple[ReportName, ...] = ()
    """Reports on the rows of all runs, in addition to the pictures."""


@dataclass(frozen=True, slots=True)
class SolverSpec:
    """A solver's name and parameters.

    Attributes:
        name: name of a shipped solver, or of user code.
        parameters: all parameters including defaults; for user code those that the config states.
        metadata: metadata of a user's class, as in `springbench.harness.results.solver_metadata`, with its
            `packages`; empty for shipped solvers.
    """

    name: str
    parameters: Mapping[str, Any]
    metadata: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def metadata_columns(self) -> dict[str, Any]:
        """Metadata columns of the solver; the class of user code is not imported for them."""
        if not isinstance(self.name, PluginName):
            return read_solver_metadata(self.name)
        return {name: value for name, value in self.metadata.items() if name != "packages"}

    @property
    def is_minimiser(self) -> bool:
        """Whether the solver's iterates tend to a minimum, as in `springbench.solvers.registry.is_minimiser`."""
        own = isinstance(self.name, PluginName)
        return (
            bool(self.metadata.get("is_minimiser", True)) if own else is_minimiser(load_target(SOLVER_TABLE[self.name]))
        )

    @property
    def third_party_packages(self) -> tuple[str, ...]:
        """Third-party distributions that the solver is an interface to."""
        return (
            tuple(self.metadata.get("packages", ())) if isinstance(self.name, PluginName) else list_packages(self.name)
        )


class RunSpec(FixedOptions, RunOptions):
    """One run, built with `model_construct` from validated values.

    Frames, time step and initial guess are resolved: none of them is None.

    Attributes:
        sweep: name of the sweep.
        scene_name: name of the scene, the stem of its file.
        scene: the scene, with the time step of the run.
        size: mesh size; 0 if the mesh is from a file.
        solver: the solver with its parameters.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    sweep: str
    scene_name: str
    scene: SkipValidation[SceneSpec]
    size: int
    solver: SkipValidation[SolverSpec]

    def replace_options(self, **other: Any) -> RunSpec:
        """Return a copy of the run with other values of some options."""
        return self.model_copy(update=other)

    @property
    def title(self) -> str:
        """Description of the run."""
        return f"{self.scene_name}{f' {self.size}' if self.size else ''} {self.solver.name}"

    @property
    def num_passes(self) -> int:
        """Number of passes over the steps: warm-up, timed rounds, and instrumentation."""
        return 1 if self.timing == "none" else self.rounds + 2

    def build_identity(self) -> str:
        """Build canonical JSON of everything that determines the run's result and timing on one machine.

        Names, pictures and limits are excluded. Pictures are drawn later, and a limit only determines whether the run
        is stopped.
        """
        left_out = ("sweep", "scene_name", "pictures", "time_limit", "memory_limit")
        settings = {name: value for name, value in self if name not in left_out}
        settings |= {
            "scene": self.scene.scene_digest,
            "solver": [identify_code(self.solver.name), dict(self.solver.parameters)],
        }
        settings["integrator"] = identify_code(self.integrator)
        if self.timing == "exclusive":  # defaults are omitted, so that results without these options remain valid
            del settings["timing"]
        if self.error_target is None:
            del settings["error_target"]
        return json.dumps(settings, sort_keys=True, separators=(",", ":"))

    def compute_run_id(self, machine: str) -> str:
        """Compute the run's id on a machine, 12 hex digits of SHA-256.

        It is independent of the names of sweep and scene.
        """
        return hashlib.sha256(f"{machine} {self.build_identity()}".encode()).hexdigest()[:12]

    def build_file_stem(self, machine: str) -> str:
        """Build the stem of the run's file names."""
        return f"{self.scene_name}-{self.size}-{sanitise_name(self.solver.name)}-{self.compute_run_id(machine)}"

    def find_plugins(self) -> list[PluginName]:
        """Find the user code of the run: solver, integrator, mesh and effects."""
        return select_plugins([self.solver.name, self.integrator, *self.scene.find_plugins()])

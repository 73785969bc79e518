"""Models of a validated accuracy config: convergence curves and work studies.

Curves are measured on step snapshots, work on whole trajectories.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from pydantic import Field
from springbench.harness.atomic_files import sanitise_name
from springbench.harness.config.run_options import STEP_OPTIONS, ThreadCount, build_list_model, build_single_model
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.scenes.scene_spec import FrameCount, InitialGuess, IntegratorName, MeshSize, SceneSpec
from springbench.harness.schema.base_model import ConfigModel, OneOrMany
from springbench.solvers.plugins.plugin_discovery import PluginName, identify_code, select_plugins

SnapshotName = Literal["early", "middle", "peak"] | FrameCount
"""A snapshot of the scene that is found from its own run, or the number of a frame."""


def format_snapshot(moment: str | int) -> str:
    """Format a snapshot for rows: early, middle, peak or frame-k."""
    return f"frame-{moment}" if isinstance(moment, int) else moment


TimeLimit = Annotated[float, Field(gt=0, le=1e5)]


class AccuracyStudyConfig(build_list_model("integrator", "time_step"), build_single_model(rounds=3)):
    """Fields of every study; all combinations of its lists are measured."""

    scene: OneOrMany[str] = ()
    """Names of scenes, the stems of their files; all of them if left out."""
    size: OneOrMany[MeshSize] = ()
    """Mesh sizes; each scene's default if left out."""
    solver: OneOrMany[str] = ()
    """Names of solvers that the config lists; all of them if left out."""
    threads: ThreadCount = 1
    """Number of threads of Numba and of BLAS; never automatic, because another number is another measurement."""
    time_limit: TimeLimit = 5.0
    """Seconds that a solver may take for one curve, or one simulation."""


class CurveStudyConfig(
    AccuracyStudyConfig,
    build_list_model(initial_guess=("previous", "inertial")),
    build_single_model(max_iterations=2000),
):
    """Convergence of minimising solvers on step snapshots; a curve ends at convergence."""

    snapshot: OneOrMany[SnapshotName] = ("early", "middle", "peak")
    """Steps to take snapshots of: moments found from the scene's run, or numbers of frames."""
    recordings: bool = False
    """Whether the solve from the first initial guess is recorded, to view its iterates on the mesh."""


class WorkStudyConfig(AccuracyStudyConfig, build_list_model(*STEP_OPTIONS)):
    """Error and wall time of whole trajectories."""

    t_end: Annotated[float, Field(gt=0, le=1e4)] = 1.0
    """Simulated time [s]; a multiple of every time step."""


class AccuracyConfig(ConfigModel):
    """An accuracy config: scenes, solvers and studies."""

    description: str = Field(default="", max_length=1000)
    """One sentence about the question that the config answers."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the config, or names of shipped scenes."""
    solvers: tuple[str | dict[str, Any], ...] = Field(min_length=1)
    """Solvers: a name, or a mapping of `name` and the solver's parameters."""
    curves: tuple[CurveStudyConfig, ...] = ()
    """Studies of convergence; if two include the same solve, the settings of the first apply."""
    work: tuple[WorkStudyConfig, ...] = ()
    """Studies of work; if two include the same simulation, the settings of the first apply."""


@dataclass(frozen=True, slots=True)
class BenchmarkCase:
    """A scene at a mesh size, with an integrator and a time step.

    The time step is that of `scene`.
    """

    scene_name: str
    scene: SceneSpec
    size: int
    integrator: IntegratorName

    def build_identity(self) -> list[Any]:
        """Build plain data that determines the motion."""
        return [self.scene.scene_digest, self.size, identify_code(self.integrator)]

    def find_plugins(self) -> list[PluginName]:
        """Find the user code of the case: integrator, mesh and effects."""
        return select_plugins([self.integrator, *self.scene.find_plugins()])

    @property
    def title(self) -> str:
        """Description of the case."""
        return f"{self.scene_name} {self.size}" if self.size else self.scene_name


@dataclass(frozen=True, slots=True)
class MeasurementSettings:
    """Measurement settings of a unit, as in `AccuracyStudyConfig`."""

    threads: int
    rounds: int
    time_limit: float


@dataclass(frozen=True, slots=True)
class CurveSpec:
    """Specification of the curves of one solver on one step snapshot."""

    case: BenchmarkCase
    snapshot: str | int
    solver: SolverSpec
    initial_guesses: tuple[InitialGuess, ...]
    max_iterations: int
    recordings: bool
    measurement: MeasurementSettings

    def describe_point(self) -> list[Any]:
        """Describe what is measured as plain data, without the measurement settings."""
        return [
            "curve",
            *self.case.build_identity(),
            self.snapshot,
            identify_code(self.solver.name),
            dict(self.solver.parameters),
        ]

    def find_plugins(self) -> list[PluginName]:
        """Find the user code that is measured: that of the case, and the solver."""
        return [*self.case.find_plugins(), *select_plugins([self.solver.name])]

    def compute_unit_id(self, machine: str) -> str:
        """Compute 12 hex digits from everything that determines result and timing."""
        how = [asdict(self.measurement), self.initial_guesses, self.max_iterations, self.recordings]
        return _compute_hash([machine, self.describe_point(), how])

    def build_file_stem(self) -> str:
        """Build the stem of its file.

        It is the same for other measurement settings, so that a new measurement replaces the file.
        """
        solver = sanitise_name(self.solver.name)
        return (
            f"{self.case.scene_name}-{self.case.size}-{self.snapshot}-{solver}-{_compute_hash(self.describe_point())}"
        )

    def build_problem_stem(self) -> str:
        """Build the stem of the file of the step itself."""
        problem = [*self.case.build_identity(), self.snapshot]
        return f"{self.case.scene_name}-{self.case.size}-{self.snapshot}-{_compute_hash(problem)}"


@dataclass(frozen=True, slots=True)
class WorkSpec:
    """Specification of one simulation up to t_end [s].

    Options: the values of `STEP_OPTIONS`, in their order.
    """

    case: BenchmarkCase
    t_end: float
    solver: SolverSpec
    options: Mapping[str, Any]
    measurement: MeasurementSettings

    def describe_point(self) -> list[Any]:
        """Describe what is measured as plain data, without the measurement settings."""
        stop = [*self.options.values(), self.measurement.threads]
        solver = [identify_code(self.solver.name), dict(self.solver.parameters)]
        return ["work", *self.case.build_identity(), self.t_end, *solver, *stop]

    def find_plugins(self) -> list[PluginName]:
        """Find the user code that is measured: that of the case, and the solver."""
        return [*self.case.find_plugins(), *select_plugins([self.solver.name])]

    def compute_unit_id(self, machine: str) -> str:
        """Compute 12 hex digits from everything that determines result and timing."""
        return _compute_hash([machine, self.describe_point(), asdict(self.measurement)])

    def build_file_stem(self) -> str:
        """Build the stem of its file.

        It is the same for other measurement settings, so that a new measurement replaces the file.
        """
        return (
            f"{self.case.scene_name}-{self.case.size}-work-{sanitise_name(self.solver.name)}-"
            f"{_compute_hash(self.describe_point())}"
        )


def _compute_hash(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]

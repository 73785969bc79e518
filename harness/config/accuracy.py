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

from harness.base.files import safe_name
from harness.base.model import Many, Model
from harness.config.options import OF_STEPS, Threads, lists, single
from harness.config.sweep import SolverSpec
from harness.scenes.spec import FirstGuess, Frames, IntegratorName, SceneSpec, Size
from solvers.plugins import identity

Moment = Literal["early", "middle", "violent"] | Frames
"""A snapshot of the scene that is found from its own run, or the number of a frame."""


def moment_name(moment: str | int) -> str:
    """Format a snapshot for rows: early, middle, violent or frame-k."""
    return f"frame-{moment}" if isinstance(moment, int) else moment


TimeLimit = Annotated[float, Field(gt=0, le=1e5)]


class Study(lists("integrator", "time_step"), single(rounds=3)):
    """Fields of every study; all combinations of its lists are measured."""

    scene: Many[str] = ()
    """Names of scenes, the stems of their files; all of them if left out."""
    size: Many[Size] = ()
    """Mesh sizes; each scene's default if left out."""
    solver: Many[str] = ()
    """Names of solvers that the config lists; all of them if left out."""
    threads: Threads = 1
    """Number of threads of Numba and of BLAS; never automatic, because another number is another measurement."""
    time_limit: TimeLimit = 5.0
    """Seconds that a solver may take for one curve, or one simulation."""


class CurveStudy(Study, lists(first_guess=("current", "inertial")), single(iterations=2000)):
    """Convergence of minimising solvers on step snapshots; a curve ends at convergence."""

    moment: Many[Moment] = ("early", "middle", "violent")
    """Steps to take snapshots of: moments found from the scene's run, or numbers of frames."""
    recordings: bool = False
    """Whether the solve from the first initial guess is recorded, to view its iterates on the mesh."""


class WorkStudy(Study, lists(*OF_STEPS)):
    """Error and wall time of whole trajectories."""

    horizon: Annotated[float, Field(gt=0, le=1e4)] = 1.0
    """Simulated time [s]; a multiple of every time step."""


class AccuracyFields(Model):
    """An accuracy config: scenes, solvers and studies."""

    description: str = Field(default="", max_length=1000)
    """One sentence about the question that the config answers."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the config."""
    solvers: tuple[str | dict[str, Any], ...] = Field(min_length=1)
    """Solvers: a name, or a mapping of `name` and the solver's parameters."""
    curves: tuple[CurveStudy, ...] = ()
    """Studies of convergence; if two include the same solve, the settings of the first apply."""
    work: tuple[WorkStudy, ...] = ()
    """Studies of work; if two include the same simulation, the settings of the first apply."""


@dataclass(frozen=True, slots=True)
class Case:
    """A scene at a mesh size, with an integrator and a time step.

    The time step is that of `scene`.
    """

    scene_name: str
    scene: SceneSpec
    size: int
    integrator: IntegratorName

    def identity(self) -> list[Any]:
        """Build plain data that determines the motion."""
        return [self.scene.digest, self.size, identity(self.integrator)]

    @property
    def title(self) -> str:
        """Description of the case."""
        return f"{self.scene_name} {self.size}" if self.size else self.scene_name


@dataclass(frozen=True, slots=True)
class How:
    """Measurement settings of a unit, as in `Study`."""

    threads: int
    rounds: int
    time_limit: float


@dataclass(frozen=True, slots=True)
class CurveSpec:
    """Specification of the curves of one solver on one step snapshot."""

    case: Case
    moment: str | int
    solver: SolverSpec
    first_guesses: tuple[FirstGuess, ...]
    iterations: int
    recordings: bool
    how: How

    def point(self) -> list[Any]:
        """Describe what is measured as plain data, without the measurement settings."""
        return ["curve", *self.case.identity(), self.moment, identity(self.solver.name), dict(self.solver.parameters)]

    def unit_id(self, machine: str) -> str:
        """Compute 12 hex digits from everything that determines result and timing."""
        how = [asdict(self.how), self.first_guesses, self.iterations, self.recordings]
        return _hash([machine, self.point(), how])

    def label(self) -> str:
        """Build the stem of its file.

        It is the same for other measurement settings, so that a new measurement replaces the file.
        """
        solver = safe_name(self.solver.name)
        return f"{self.case.scene_name}-{self.case.size}-{self.moment}-{solver}-{_hash(self.point())}"

    def problem_label(self) -> str:
        """Build the stem of the file of the step itself."""
        problem = [*self.case.identity(), self.moment]
        return f"{self.case.scene_name}-{self.case.size}-{self.moment}-{_hash(problem)}"


@dataclass(frozen=True, slots=True)
class WorkSpec:
    """Specification of one simulation up to horizon [s].

    Options: the values of `OF_STEPS`, in their order.
    """

    case: Case
    horizon: float
    solver: SolverSpec
    options: Mapping[str, Any]
    how: How

    def point(self) -> list[Any]:
        """Describe what is measured as plain data, without the measurement settings."""
        stop = [*self.options.values(), self.how.threads]
        solver = [identity(self.solver.name), dict(self.solver.parameters)]
        return ["work", *self.case.identity(), self.horizon, *solver, *stop]

    def unit_id(self, machine: str) -> str:
        """Compute 12 hex digits from everything that determines result and timing."""
        return _hash([machine, self.point(), asdict(self.how)])

    def label(self) -> str:
        """Build the stem of its file.

        It is the same for other measurement settings, so that a new measurement replaces the file.
        """
        return f"{self.case.scene_name}-{self.case.size}-work-{safe_name(self.solver.name)}-{_hash(self.point())}"


def _hash(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]

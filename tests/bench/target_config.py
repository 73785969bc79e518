"""Performance targets of `springbench targets`: errors, baselines and target ratios of cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple, Self

from pydantic import Field, PositiveFloat, model_validator
from springbench.harness.config.config_loader import check_file_name, read_scenes
from springbench.harness.config.run_options import IterationLimit, RelativeTolerance
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.scene_spec import IntegratorName, MeshSize, SceneSpec
from springbench.harness.schema.base_model import ConfigModel, OneOrMany
from springbench.harness.schema.yaml_loader import read_yaml


class PerformanceTarget(ConfigModel):
    """A performance target: an error at t_end, and the baseline of its cost.

    The cheapest variant of the baseline is compared.
    """

    scene: OneOrMany[str]
    """Names of scenes, the stems of their files."""
    size: OneOrMany[MeshSize] | None = None
    """Mesh sizes; each scene's default if left out."""
    horizon: Annotated[float, Field(gt=0, le=1e4)]
    """Simulated time [s]."""
    error: OneOrMany[Annotated[float, Field(gt=0, lt=1)]]
    """Error relative to the displacement at the end; each of several values is a target of its own."""
    peer: str | None = None
    """Baseline: a third-party integrator, by name (`springbench run SCENE --error E --compare` lists them)."""
    integrator: OneOrMany[IntegratorName] | None = None
    """Baseline instead of `peer`: fixed step sizes by these integrators ..."""
    solver: OneOrMany[str] = ()
    """... these solvers ..."""
    tolerance: OneOrMany[RelativeTolerance] = (1e-1, 1e-2, 1e-4)
    """... and these tolerances; the step size is reduced until the error is the requested one."""
    iterations: IterationLimit = 500
    """Iteration limit of such a step."""
    graded: bool = False
    """Whether errors are measured against the reference solution; then the requested error must be met, too."""
    wanted: PositiveFloat
    """Target ratio of processor time to that of the baseline."""

    @model_validator(mode="after")
    def _check_alternatives(self) -> Self:
        if (self.peer is None) == (self.integrator is None) or (self.integrator is None) != (not self.solver):
            raise ValueError("wants either a `peer`, or `integrator` and `solver`, to be held against")
        return self


class TargetsConfig(ConfigModel):
    """A config of performance targets and their scenes."""

    description: str = Field(default="", max_length=1000)
    """One sentence about the question that the config answers."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the config."""
    goals: tuple[PerformanceTarget, ...] = Field(min_length=1)
    """The targets, in the order of their execution."""


class TargetCase(NamedTuple):
    """A target for one scene, one mesh size (None for the default) and one error."""

    target: PerformanceTarget
    scene: str
    size: int | None
    error: float


@dataclass(frozen=True, slots=True)
class TargetPlan:
    """A validated config: its name, its scenes, and its individual targets."""

    name: str
    scenes: dict[str, SceneSpec]
    goals: Sequence[TargetCase]


def load_targets(path: Path, libraries: Sequence[str], solvers: Sequence[str]) -> TargetPlan:
    """Load performance targets from a YAML file.

    Args:
        path: the file.
        libraries: names of available third-party integrators.
        solvers: names of available solvers.
    Raises:
        InputError: for all mistakes.
    """
    document = read_yaml(path)
    if "goals" not in document.data:
        raise InputError(InputMistake("has no `goals`; `springbench run` does scenes and sweeps", path))
    check_file_name(document)
    fields, scenes = document.validate_data(TargetsConfig, document.data), read_scenes(document)
    for i, goal in enumerate(fields.goals if fields else ()):
        for key, names, known in (
            ("scene", goal.scene, list(scenes)),
            ("solver", goal.solver, solvers),
            ("peer", (goal.peer,) if goal.peer else (), libraries),
        ):
            for name in names:
                if name not in known:
                    document.add_mistake(f"came {name!r}; wanted one of {', '.join(known)}", ("goals", i, key))
    if fields is None or document.mistakes:
        raise document.build_error()
    every = [
        TargetCase(goal, *one) for goal in fields.goals for one in product(goal.scene, goal.size or (None,), goal.error)
    ]
    return TargetPlan(path.stem, scenes, every)

"""Performance targets of `springbench goals`: errors, baselines and target ratios of cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple, Self

from pydantic import Field, PositiveFloat, model_validator

from harness.base.errors import InputError, Mistake
from harness.base.model import Many, Model
from harness.base.yaml import read_yaml
from harness.config.load import check_name, scenes_of
from harness.config.options import Iterations, Tolerance
from harness.scenes.spec import IntegratorName, SceneSpec, Size


class Goal(Model):
    """A performance target: an error at horizon, and the baseline of its cost.

    The cheapest variant of the baseline is compared.
    """

    scene: Many[str]
    """Names of scenes, the stems of their files."""
    size: Many[Size] | None = None
    """Mesh sizes; each scene's default if left out."""
    horizon: Annotated[float, Field(gt=0, le=1e4)]
    """Simulated time [s]."""
    error: Many[Annotated[float, Field(gt=0, lt=1)]]
    """Error relative to the displacement at the end; each of several values is a target of its own."""
    peer: str | None = None
    """Baseline: a third-party integrator, by name (`springbench run SCENE --error E --peers` lists them)."""
    integrator: Many[IntegratorName] | None = None
    """Baseline instead of `peer`: fixed step sizes by these integrators ..."""
    solver: Many[str] = ()
    """... these solvers ..."""
    tolerance: Many[Tolerance] = (1e-1, 1e-2, 1e-4)
    """... and these tolerances; the step size is reduced until the error is the requested one."""
    iterations: Iterations = 500
    """Iteration limit of such a step."""
    graded: bool = False
    """Whether errors are measured against the reference solution; then the requested error must be met, too."""
    wanted: PositiveFloat
    """Target ratio of processor time to that of the baseline."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.peer is None) == (self.integrator is None) or (self.integrator is None) != (not self.solver):
            raise ValueError("wants either a `peer`, or `integrator` and `solver`, to be held against")
        return self


class GoalsFields(Model):
    """A config of performance targets and their scenes."""

    description: str = Field(default="", max_length=1000)
    """One sentence about the question that the config answers."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the config."""
    goals: tuple[Goal, ...] = Field(min_length=1)
    """The targets, in the order of their execution."""


class OneGoal(NamedTuple):
    """A target for one scene, one mesh size (None for the default) and one error."""

    goal: Goal
    scene: str
    size: int | None
    error: float


@dataclass(frozen=True, slots=True)
class Goals:
    """A validated config: its name, its scenes, and its individual targets."""

    name: str
    scenes: dict[str, SceneSpec]
    goals: Sequence[OneGoal]


def load_goals(path: Path, peers: Sequence[str], solvers: Sequence[str]) -> Goals:
    """Load performance targets from a YAML file.

    Args:
        path: the file.
        peers: names of available third-party integrators.
        solvers: names of available solvers.
    Raises:
        InputError: for all mistakes.
    """
    document = read_yaml(path)
    if "goals" not in document.data:
        raise InputError(Mistake("has no `goals`; `springbench run` does scenes and sweeps", path))
    check_name(document)
    fields, scenes = document.check(GoalsFields, document.data), scenes_of(document)
    for i, goal in enumerate(fields.goals if fields else ()):
        for key, names, known in (
            ("scene", goal.scene, list(scenes)),
            ("solver", goal.solver, solvers),
            ("peer", (goal.peer,) if goal.peer else (), peers),
        ):
            for name in names:
                if name not in known:
                    document.report(f"came {name!r}; wanted one of {', '.join(known)}", ("goals", i, key))
    if fields is None or document.mistakes:
        raise document.error()
    every = [
        OneGoal(goal, *one) for goal in fields.goals for one in product(goal.scene, goal.size or (None,), goal.error)
    ]
    return Goals(path.stem, scenes, every)

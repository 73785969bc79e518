"""What `springbench goals` reads: errors, what else each is to be had by, and the part of its cost that is wanted."""

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
    """An error of scenes at their horizon, and the cheapest of something else to hold it against."""

    scene: Many[str]
    """Names of scenes, the stems of their files."""
    size: Many[Size] | None = None
    """Mesh sizes; each scene's default if left out."""
    horizon: Annotated[float, Field(gt=0, le=1e4)]
    """Simulated time [s]."""
    error: Many[Annotated[float, Field(gt=0, lt=1)]]
    """Relative to the displacement at the horizon; of several, each is a goal."""
    peer: str | None = None
    """Another library's integrator, by name (`springbench run SCENE --error E --peers` has them all)."""
    integrator: Many[IntegratorName] | None = None
    """Or steps of one length by these integrators ..."""
    solver: Many[str] = ()
    """... these solvers ..."""
    tolerance: Many[Tolerance] = (1e-1, 1e-2, 1e-4)
    """... and these tolerances: the steps are shortened until the error is the one asked."""
    iterations: Iterations = 500
    """Iteration limit of such a step."""
    graded: bool = False
    """Whether errors are those by the reference; then the one that was asked for has to be kept to, too."""
    wanted: PositiveFloat
    """The part of its processor time that is wanted."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.peer is None) == (self.integrator is None) or (self.integrator is None) != (not self.solver):
            raise ValueError("wants either a `peer`, or `integrator` and `solver`, to be held against")
        return self


class GoalsFields(Model):
    """Goals, and the scenes that they name."""

    description: str = Field(default="", max_length=1000)
    """One sentence about what the config asks."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the config."""
    goals: tuple[Goal, ...] = Field(min_length=1)
    """One after the other."""


class OneGoal(NamedTuple):
    """A goal with the name of one scene, one size, None for the default, and one error."""

    goal: Goal
    scene: str
    size: int | None
    error: float


@dataclass(frozen=True, slots=True)
class Goals:
    """A checked config: its name, its scenes, and its goals one by one."""

    name: str
    scenes: dict[str, SceneSpec]
    goals: Sequence[OneGoal]


def load_goals(path: Path, peers: Sequence[str], solvers: Sequence[str]) -> Goals:
    """The config in a YAML file; peers, solvers: the names that there are. Raises InputError."""
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

"""Configs of performance targets: errors, baselines and target ratios of cost."""

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
from springbench.harness.experiments.error_control.third_party_integrators import THIRD_PARTY_INTEGRATORS
from springbench.harness.scenes.scene_spec import IntegratorName, MeshSize, SceneSpec
from springbench.harness.schema.base_model import ConfigModel, OneOrMany
from springbench.harness.schema.yaml_loader import read_yaml
from springbench.solvers.registry import SOLVER_TABLE


class PerformanceTarget(ConfigModel):
    """A performance target: an error at t_end, and the baseline of its cost.

    The cheapest variant of the baseline is compared.
    """

    scene: OneOrMany[str]
    """Names of scenes, the stems of their files."""
    size: OneOrMany[MeshSize] | None = None
    """Mesh sizes; each scene's default if left out."""
    t_end: Annotated[float, Field(gt=0, le=1e4)]
    """Simulated time [s]."""
    error: OneOrMany[Annotated[float, Field(gt=0, lt=1)]]
    """Error relative to the displacement at the end; each of several values is a target of its own."""
    third_party: str | None = None
    """Baseline: a third-party integrator, by name (`springbench run SCENE --error E --compare` lists them)."""
    integrator: OneOrMany[IntegratorName] | None = None
    """Baseline instead of `third_party`: fixed step sizes by these integrators ..."""
    solver: OneOrMany[str] = ()
    """... these solvers ..."""
    rtol: OneOrMany[RelativeTolerance] = (1e-1, 1e-2, 1e-4)
    """... and these tolerances; the step size is reduced until the error is the requested one."""
    max_iterations: IterationLimit = 500
    """Iteration limit of such a step."""
    verify: bool = False
    """Whether errors are measured against the reference solution; then the requested error must be met, too."""
    target_ratio: PositiveFloat
    """Target ratio of processor time to that of the baseline."""

    @model_validator(mode="after")
    def _check_alternatives(self) -> Self:
        if (self.third_party is None) == (self.integrator is None) or (self.integrator is None) != (not self.solver):
            raise ValueError("expected a baseline: either `third_party`, or `integrator` and `solver`")
        return self


class TargetsConfig(ConfigModel):
    """A config of performance targets and their scenes."""

    description: str = Field(default="", max_length=1000)
    """One sentence about the question that the config answers."""
    scenes: tuple[str, ...] = Field(min_length=1)
    """Scene files (*.yaml, or *.json of the assignment), relative to the config."""
    targets: tuple[PerformanceTarget, ...] = Field(min_length=1)
    """The targets, in the order of their execution."""


class TargetCase(NamedTuple):
    """A target for one scene, one mesh size (None for the default) and one error."""

    target: PerformanceTarget
    scene: str
    size: int | None
    error: float


@dataclass(frozen=True, slots=True)
class TargetPlan:
    """A validated config: its name, its scenes, and its targets, one by one."""

    name: str
    scenes: dict[str, SceneSpec]
    cases: Sequence[TargetCase]


def load_targets(path: Path) -> TargetPlan:
    """Load performance targets from a YAML file.

    Raises:
        InputError: for all mistakes.
    """
    document = read_yaml(path)
    if "targets" not in document.data:
        raise InputError(InputMistake("has no `targets`; `springbench run` runs scenes and sweeps", path))
    check_file_name(document)
    fields, scenes = document.validate_data(TargetsConfig, document.data), read_scenes(document)
    for i, target in enumerate(fields.targets if fields else ()):
        third_party = (target.third_party,) if target.third_party else ()
        for key, names, known in (
            ("scene", target.scene, scenes),
            ("solver", target.solver, SOLVER_TABLE),
            ("third_party", third_party, THIRD_PARTY_INTEGRATORS),
        ):
            for name in names:
                if name not in known:
                    document.add_mistake(
                        f"unknown name {name!r}; expected one of {', '.join(known)}", ("targets", i, key)
                    )
    if fields is None or document.mistakes:
        raise document.build_error()
    cases = [
        TargetCase(target, *values)
        for target in fields.targets
        for values in product(target.scene, target.size or (None,), target.error)
    ]
    return TargetPlan(path.stem, scenes, cases)

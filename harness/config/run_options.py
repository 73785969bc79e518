"""Options of a run, defined once.

`RunOptions` determines the lists of a sweep and of an accuracy study, the options of the command line, and the keys
that entries of a sweep match. It also determines the short descriptions of runs, columns of their rows, and their hash.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, NamedTuple, get_type_hints

from pydantic import Field, create_model
from springbench.harness.scenes.scene_spec import FrameCount, InitialGuess, IntegratorName, TimeStep
from springbench.harness.schema.base_model import ConfigModel, OneOrMany, read_field_descriptions

AUTO: Literal["auto"] = "auto"

IterationLimit = Annotated[int, Field(ge=1, le=100_000)]
RelativeTolerance = Annotated[float, Field(gt=0, lt=1)] | None
RelativeError = Annotated[float, Field(gt=0, lt=1)] | None
ThreadCount = Annotated[int, Field(ge=1, le=1024)]
RoundCount = Annotated[int, Field(ge=1, le=1000)]


class RunOption(NamedTuple):
    """Properties of an option in addition to its type and description.

    Attributes:
        short_format: format of its value in short descriptions.
        column: column of rows, "" for none.
        null_meaning: meaning of null, for options whose default the scene defines.
    """

    short_format: str
    column: str = ""
    null_meaning: str = ""


_NULL_IS_SCENE_VALUE = "null takes the scene's"


class RunOptions(ConfigModel):
    """Options of a run that can be varied, one value of each."""

    max_iterations: Annotated[IterationLimit, RunOption("{} it.", "max_iterations")] = 50
    """Iteration limit of a step."""
    rtol: Annotated[RelativeTolerance | Literal["auto"], RunOption("tol. {}", "residual_rtol")] = None
    """Relative tolerance of a step's iterations; null performs all of them. auto: the remaining residual adds at most a
    tenth to the step's own local error, estimated by an embedded method or by differences of the velocity.
    """
    integrator: Annotated[IntegratorName, RunOption("{}", "integrator")] = "implicit-euler"
    """Time integrator."""
    time_step: Annotated[TimeStep, RunOption("dt {:.3g}", "time_step", _NULL_IS_SCENE_VALUE)]
    """Time step [s]."""
    initial_guess: Annotated[
        InitialGuess,
        RunOption(
            "{}",
            "initial_guess",
            "null is `assignment` for JSON scenes, `extrapolated` for integrators that evaluate "
            "forces at their stages, else `previous`",
        ),
    ]
    """Initial guess of a step's iteration. coarse-to-fine: the solution of the same step on a mesh of half the size,
    which is solved first, within the step's time.
    """
    threads: Annotated[ThreadCount | Literal["auto"], RunOption("{} thr.", "threads")] = 1
    """Threads of Numba and of BLAS; auto: the number of idle cores."""
    frames: Annotated[FrameCount, RunOption("{} frames", "", _NULL_IS_SCENE_VALUE)]
    """Number of steps."""
    rounds: Annotated[RoundCount, RunOption("{} rounds")] = 2
    """Number of repetitions of the timed part."""
    error_target: Annotated[RelativeError, RunOption("error {}", "error_requested")] = None
    """Target for the relative error of the final positions. It selects integrator, steps and tolerance for the solver;
    null uses the given values.
    """


DEFAULT_SOLVER: Final = "hybrid"
DEFAULT_STOP_RULE: dict[str, Any] = {"max_iterations": 500, "rtol": 1e-4}
"""Default stop rule of a scene that is run without a sweep, or from Python: the default solver iterates to a tolerance.

A sweep has the defaults of `RunOptions`, which are those of the assignment.
"""

ERROR_TARGET_OPTIONS: tuple[str, ...] = ("integrator", "max_iterations", "rtol", "initial_guess")
"""Options that an error target selects."""


RUN_OPTIONS: dict[str, RunOption] = {
    name: option
    for name, field in RunOptions.model_fields.items()
    for option in field.metadata
    if isinstance(option, RunOption)
}
"""The options by name."""

SCENE_OPTIONS = tuple(name for name, option in RUN_OPTIONS.items() if option.null_meaning)
"""Options whose default the scene defines."""


STEP_OPTIONS: tuple[str, ...] = ("initial_guess", "max_iterations", "rtol")
"""Options that define how a step is solved, for any kind of step."""

_TYPE_HINTS, _DESCRIPTIONS = get_type_hints(RunOptions, include_extras=True), read_field_descriptions(RunOptions)


def describe_option(name: str) -> str:
    """Describe an option in one sentence."""
    description, null = _DESCRIPTIONS[name].removesuffix("."), RUN_OPTIONS[name].null_meaning
    return f"{description}; {null}." if null else f"{description}."


def build_list_model(*names: str, **usual: tuple[Any, ...]) -> Any:
    """Build a model with a value or a list of values for each option.

    Args:
        names: options with the defaults of `RunOptions`.
        usual: further options, with the defaults given here.
    """
    fields: dict[str, Any] = {}
    for name in dict.fromkeys((*names, *usual)):
        of_scene = name in SCENE_OPTIONS and name not in usual
        values = usual.get(name, (None if of_scene else RunOptions.model_fields[name].default,))
        item = _TYPE_HINTS[name] | None if of_scene else _TYPE_HINTS[name]
        says = describe_option(name) if of_scene else _DESCRIPTIONS[name]
        fields[name] = (OneOrMany[item], Field(default=values, description=says))
    return create_model("Lists", __base__=ConfigModel, **fields)


def build_single_model(**usual: Any) -> Any:
    """Build a model with one value of each option, with the defaults given here."""
    fields: dict[str, Any] = {
        name: (_TYPE_HINTS[name], Field(default=value, description=_DESCRIPTIONS[name]))
        for name, value in usual.items()
    }
    return create_model("Single", __base__=ConfigModel, **fields)

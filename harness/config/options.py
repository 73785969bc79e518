"""Options of a run, defined once.

`Chosen` determines the lists of a sweep and of an accuracy study, the options of the command line, and the keys
that entries of a sweep match. It also determines the short descriptions of runs, columns of their rows, and their hash.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, NamedTuple, get_type_hints

from pydantic import Field, create_model

from harness.base.model import Many, Model, meanings
from harness.scenes.spec import FirstGuess, Frames, IntegratorName, TimeStep

AUTO: Literal["auto"] = "auto"

Iterations = Annotated[int, Field(ge=1, le=100_000)]
Tolerance = Annotated[float, Field(gt=0, lt=1)] | None
Error = Annotated[float, Field(gt=0, lt=1)] | None
Threads = Annotated[int, Field(ge=1, le=1024)]
Rounds = Annotated[int, Field(ge=1, le=1000)]


class Option(NamedTuple):
    """Attributes of an option in addition to its type and description.

    short: format of its value in short descriptions.
    column: column of rows, "" for none.
    null: meaning of null, for options that a scene defines otherwise.
    """

    short: str
    column: str = ""
    null: str = ""


_OF_SCENE = "null takes the scene's"


class Chosen(Model):
    """Options of a run that can be varied, one value of each."""

    iterations: Annotated[Iterations, Option("{} it.", "max_iterations")] = 50
    """Iteration limit of a step."""
    tolerance: Annotated[Tolerance | Literal["auto"], Option("tol. {}", "tolerance")] = None
    """Relative tolerance of a step's iterations; null performs all of them. auto: the remaining residual adds at most a
    tenth to the step's own local error, estimated by an embedded method or by differences of the velocity.
    """
    integrator: Annotated[IntegratorName, Option("{}", "integrator")] = "implicit-euler"
    """Time integrator."""
    time_step: Annotated[TimeStep, Option("dt {:.3g}", "time_step", _OF_SCENE)]
    """Time step [s]."""
    first_guess: Annotated[
        FirstGuess,
        Option(
            "{}",
            "first_guess",
            "null is `assignment` for JSON scenes, `motion` (extrapolated positions) for integrators that evaluate "
            "forces at their stages, else `current`",
        ),
    ]
    """Initial guess of a step's iteration. coarse: the solution of the same step on a mesh of half the size, which is
    solved first, within the step's time.
    """
    threads: Annotated[Threads | Literal["auto"], Option("{} thr.", "threads")] = 1
    """Threads of Numba and of BLAS; auto: the number of idle cores."""
    frames: Annotated[Frames, Option("{} frames", "", _OF_SCENE)]
    """Number of steps."""
    rounds: Annotated[Rounds, Option("{} rounds")] = 2
    """Number of repetitions of the timed part."""
    accuracy: Annotated[Error, Option("error {}", "asked")] = None
    """Target for the relative error of the final positions. It selects integrator, steps and tolerance for the solver;
    null uses the given values.
    """


DEFAULT_SOLVER: Final = "hybrid"
DEFAULT_STOP: dict[str, Any] = {"iterations": 500, "tolerance": 1e-4}
"""Default stop rule of a single scene, without a sweep and in Python: the recommended solver is run to a tolerance. The
defaults of a sweep, those of `Chosen`, are the assignment's.
"""

OF_ERROR: tuple[str, ...] = ("integrator", "iterations", "tolerance", "first_guess")
"""Options that an error target selects."""


OPTIONS: dict[str, Option] = {
    name: option
    for name, field in Chosen.model_fields.items()
    for option in field.metadata
    if isinstance(option, Option)
}
"""The options by name."""

OF_SCENE = tuple(name for name, option in OPTIONS.items() if option.null)
"""Options whose default the scene defines."""


OF_STEPS: tuple[str, ...] = ("first_guess", "iterations", "tolerance")
"""Options that define how a step is solved, for any kind of step."""

_HINTS, _SAYS = get_type_hints(Chosen, include_extras=True), meanings(Chosen)


def meaning(name: str) -> str:
    """Describe an option in one sentence."""
    said, null = _SAYS[name].removesuffix("."), OPTIONS[name].null
    return f"{said}; {null}." if null else f"{said}."


def lists(*names: str, **usual: tuple[Any, ...]) -> Any:
    """Build a model with a value or a list of values for each option.

    Args:
        names: options with their usual defaults.
        usual: more options, with the defaults given here.
    """
    fields: dict[str, Any] = {}
    for name in dict.fromkeys((*names, *usual)):
        of_scene = name in OF_SCENE and name not in usual
        values = usual.get(name, (None if of_scene else Chosen.model_fields[name].default,))
        item = _HINTS[name] | None if of_scene else _HINTS[name]
        says = meaning(name) if of_scene else _SAYS[name]
        fields[name] = (Many[item], Field(default=values, description=says))
    return create_model("Lists", __base__=Model, **fields)


def single(**usual: Any) -> Any:
    """Build a model with one value of each option, with the defaults given here."""
    fields: dict[str, Any] = {
        name: (_HINTS[name], Field(default=value, description=_SAYS[name])) for name, value in usual.items()
    }
    return create_model("Single", __base__=Model, **fields)

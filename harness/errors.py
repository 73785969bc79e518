"""Exceptions of the project: mistakes in the input, and failures of a run."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path


class SpringbenchError(Exception):
    """Base of the errors that the command line reports without a traceback.

    Example:
        >>> try:
        ...     springbench.load_scene("no-such-scene.yaml")
        ... except springbench.SpringbenchError as error:
        ...     error.exit_code
        2
    """

    exit_code = 1


class RunFailed(SpringbenchError):
    """A run ended without a result.

    Example:
        >>> springbench.RunFailed("step 3: the positions are not finite").exit_code
        1
    """


@dataclass(frozen=True, slots=True)
class InputMistake:
    """One mistake in an input: its problem with a remedy, file, line and key.

    Example:
        >>> print(springbench.InputMistake("got -1; expected a number above 0", Path("scene.yaml"), 3, "mass"))
        scene.yaml:3: mass: got -1; expected a number above 0
    """

    problem: str
    file: Path | None = None
    line: int | None = None
    key: str = ""

    def __str__(self) -> str:
        place = "" if self.file is None else f"{self.file}:{self.line}: " if self.line else f"{self.file}: "
        return f"{place}{self.key + ': ' if self.key else ''}{self.problem}"


class InputError(SpringbenchError):
    """All mistakes in the user's input.

    Example:
        >>> mistakes = [springbench.InputMistake("is missing", key=key) for key in ("mass", "frames")]
        >>> print(springbench.InputError(mistakes))
        mass: is missing
        frames: is missing
    """

    exit_code = 2

    def __init__(self, mistakes: InputMistake | str | Sequence[InputMistake]) -> None:
        if isinstance(mistakes, str):
            mistakes = InputMistake(mistakes)
        self.mistakes: tuple[InputMistake, ...] = (mistakes,) if isinstance(mistakes, InputMistake) else tuple(mistakes)
        super().__init__("\n".join(map(str, self.mistakes)))


def format_allowed_names(got: object, allowed: Iterable[str]) -> str:
    """Format the allowed names, and the closest one as a suggestion for a typo.

    Args:
        got: name that the user gave.
        allowed: valid names.

    Returns:
        `one of a, b, c; did you mean 'b'?`, as the end of a message.
    """
    names = sorted(allowed)
    near = difflib.get_close_matches(str(got), names, n=1)
    return f"one of {', '.join(names)}" + (f"; did you mean {near[0]!r}?" if near else "")

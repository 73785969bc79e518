"""Config documents: plain data with line numbers, validated by models with all mistakes collected."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from harness.base.errors import InputError, Mistake, did_you_mean

MAX_MISTAKES = 100

Key = tuple[str | int, ...]
"""Location of a value: the mapping keys and list indices that lead to it."""

_CAME = "; should be "

M = TypeVar("M", bound=BaseModel)


def _nothing(said: str) -> None:
    pass


@dataclass(frozen=True, slots=True)
class OwnCode:
    """Policy for user code that a config names.

    opens: whether the code is imported here; otherwise only its files identify it.
    tell: called with a description before each import.
    stated: metadata of each solver class by solver name, as far as it was read before.
    kept: whether cached parameters of shipped solvers may be used.
    """

    opens: bool = True
    tell: Callable[[str], None] = _nothing
    stated: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])
    kept: bool = False


IMPORTED = OwnCode()
"""Import user code."""
UNOPENED = OwnCode(opens=False)
"""Do not import user code; treat it as files."""


@dataclass(slots=True)
class Document:
    """A config as plain data, with line numbers and the mistakes found so far.

    own: policy for code that the config names.
    """

    path: Path
    data: dict[str, Any]
    lines: dict[Key, int] = field(default_factory=dict[Key, int])
    mistakes: list[Mistake] = field(default_factory=list[Mistake])
    own: OwnCode = IMPORTED

    def report(self, problem: str, at: Key = ()) -> None:
        """Add a mistake at a key.

        A key that is not in the file gets the line of its parent mapping.
        """
        line = next((self.lines[at[:k]] for k in range(len(at), -1, -1) if at[:k] in self.lines), None)
        self.mistakes.append(Mistake(problem, self.path, line, key_text(at)))

    def check(self, model: type[M], data: Any, at: Key = ()) -> M | None:
        """Validate data with a model and add its mistakes to the document.

        The data is validated as strict JSON. A list may represent a tuple, but no boolean or text a number.

        Args:
            model: pydantic model.
            data: plain data.
            at: location of the data in the document.
        Returns: the model instance, or None if there are mistakes.
        """
        try:
            return model.model_validate_json(json.dumps(data), strict=True, context={"folder": self.path.parent})
        except ValidationError as error:
            problems: dict[Key, list[str]] = {}
            for detail in error.errors()[: MAX_MISTAKES + 1]:
                if detail["type"] == "too_short" and detail["input"]:
                    continue  # the list is short because its items were refused, which is reported
                key = _place(detail, data)
                problems.setdefault(key, []).append(_problem(detail, model, key))
            for key, said in problems.items():
                came = said[0].partition(_CAME)[0] + _CAME  # members of a union all say what came
                others = [problem.removeprefix(came) for problem in said[1:]]
                self.report(" or ".join([said[0], *others]), at + key)
            return None

    def with_paths(self, model: type[BaseModel], data: dict[str, Any], at: Key) -> dict[str, Any]:
        """Resolve file names relative to the config's folder; a missing file is a mistake."""
        names = [k for k, f in model.model_fields.items() if f.annotation is Path and isinstance(data.get(k), str)]
        for key in names:
            data = data | {key: str(self.path.parent / data[key])}
            if not os.path.isfile(data[key]):
                self.report(f"there is no file {quote(data[key])}", (*at, key))
        return data

    def choose(self, data: Any, table: Mapping[str, Any], tag: str, at: Key) -> tuple[str, dict[str, Any]] | None:
        """Split a mapping into the name under its tag and its other keys.

        Args:
            data: value that should be a mapping.
            table: known names.
            tag: key that selects the name, such as `kind`.
            at: location of the data in the document.
        Returns: (name, other keys), or None after a mistake was added.
        """
        if not is_mapping(data) or not isinstance(data.get(tag), str):
            place = (*at, tag) if is_mapping(data) and tag in data else at
            self.report(f"should be a mapping with a `{tag}`, {did_you_mean('', table)}", place)
            return None
        if data[tag] not in table:
            self.report(f"unknown {tag} {quote(data[tag])}; expected {did_you_mean(data[tag], table)}", (*at, tag))
            return None
        return data[tag], {key: value for key, value in data.items() if key != tag}

    def error(self) -> InputError:
        """Return an error with all mistakes (at most MAX_MISTAKES), sorted by line."""
        found = sorted(self.mistakes, key=lambda mistake: (str(mistake.file), mistake.line or 0))
        more = [Mistake("... and more; mend these first", self.path)] if len(found) > MAX_MISTAKES else []
        return InputError(found[:MAX_MISTAKES] + more)


def key_text(at: Key) -> str:
    """Format a key as users write it: `effects[2].weight`."""
    text = "".join(f"[{k}]" if isinstance(k, int) else f".{k if k.isprintable() else ascii(k)}" for k in at)
    return text.removeprefix(".")[:200]


def is_mapping(data: object) -> TypeGuard[dict[str, Any]]:
    """Return whether config data is a mapping; its keys are text."""
    return isinstance(data, dict)


def is_list(data: object) -> TypeGuard[list[Any]]:
    """Return whether config data is a list."""
    return isinstance(data, list)


def quote(value: object) -> str:
    """Format a value as JSON, truncated to 60 characters for a message."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _place(detail: ErrorDetails, data: Any) -> Key:
    """Return the key that a validation error refers to.

    The names of union members in its location are omitted.
    """
    key: Key = ()
    for step in detail["loc"]:
        if _holds(data, step):
            key, data = (*key, step), data[step]
    return (*key, detail["loc"][-1]) if detail["type"] == "missing" and is_mapping(data) else key


def _holds(data: Any, step: str | int) -> bool:
    return step in data if is_mapping(data) else is_list(data) and step in range(len(data))


def _problem(detail: ErrorDetails, model: type[BaseModel], key: Key) -> str:
    """Describe the given value and the expected one."""
    kind, said = detail["type"], detail["msg"]
    if kind == "missing":
        return "is missing" if isinstance(detail["loc"][-1], str) else "has too few items"
    if kind == "extra_forbidden":
        owner = _models_at(model, detail["loc"][:-1])[:1]
        allowed = owner[0].model_fields if owner else ()
        return "unknown key; " + (f"expected {did_you_mean(key[-1], allowed)}" if allowed else "remove it")
    if kind == "value_error":
        return said.removeprefix("Value error, ")
    if kind.startswith("union_tag"):
        kinds = [one.model_fields["kind"].default for one in _models_at(model, detail["loc"])]
        came = detail.get("ctx", {}).get("tag")
        if came is not None:
            return f"unknown kind {quote(came)}; expected {did_you_mean(came, kinds)}"
        return f"came {quote(detail['input'])}{_CAME}a mapping with a `kind`, {did_you_mean('', kinds)}"
    wanted = said.removeprefix("Input should be ").replace("a valid array", "a list")
    return f"came {quote(detail['input'])}{_CAME}{wanted}"


def _models_at(model: type[BaseModel], location: Key) -> list[type[BaseModel]]:
    """Return the models at an error's location.

    A member of a union is selected by its kind; without a kind all members are returned.
    """
    members = [model]
    for step in location:
        if isinstance(step, int):
            continue
        if not members:
            break
        if len(members) > 1:
            members = [one for one in members if one.model_fields["kind"].default == step]
        else:
            given = members[0].model_fields.get(step)
            members = list(_models(given.annotation)) if given else []
    return members


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)

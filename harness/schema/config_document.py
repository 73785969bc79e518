"""Config documents: plain data with line numbers, validated by models with all mistakes collected."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails
from springbench.harness.errors import InputError, InputMistake, format_allowed_names

MAX_MISTAKES = 100

ConfigKey = tuple[str | int, ...]
"""Location of a value: the mapping keys and list indices that lead to it."""

_EXPECTED_PREFIX = "; should be "

M = TypeVar("M", bound=BaseModel)


def _ignore_message(message: str) -> None:
    pass


@dataclass(frozen=True, slots=True)
class UserCodePolicy:
    """Policy for user code that a config names.

    Attributes:
        imports_code: whether the code is imported in this process; otherwise only its files identify it.
        on_import: called with a description before each import.
        solver_metadata: metadata of solver classes by solver name, if it was read before.
    """

    imports_code: bool = True
    on_import: Callable[[str], None] = _ignore_message
    solver_metadata: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])


IMPORT_USER_CODE = UserCodePolicy()
"""Import user code."""
SKIP_USER_CODE = UserCodePolicy(imports_code=False)
"""Do not import user code; identify it by its files."""


@dataclass(slots=True)
class ConfigDocument:
    """A config as plain data, with line numbers and the mistakes found so far.

    Attributes:
        path: file of the config.
        data: plain data of the file.
        lines: line of each key.
        mistakes: mistakes found so far.
        user_code: policy for code that the config names.
    """

    path: Path
    data: dict[str, Any]
    lines: dict[ConfigKey, int] = field(default_factory=dict[ConfigKey, int])
    mistakes: list[InputMistake] = field(default_factory=list[InputMistake])
    user_code: UserCodePolicy = IMPORT_USER_CODE

    def add_mistake(self, problem: str, at: ConfigKey = ()) -> None:
        """Add a mistake at a key.

        A key that is not in the file gets the line of its parent mapping.

        Args:
            problem: description of the mistake, with its remedy.
            at: location in the document; empty for the document as a whole.
        """
        line = next((self.lines[at[:k]] for k in range(len(at), -1, -1) if at[:k] in self.lines), None)
        self.mistakes.append(InputMistake(problem, self.path, line, format_key(at)))

    def add_errors(self, error: InputError) -> None:
        """Add the mistakes of an error.

        A mistake without a file is located in this document by its key.
        """
        for mistake in error.mistakes:
            if mistake.file is None:
                self.add_mistake(mistake.problem, parse_key(mistake.key))
            else:
                self.mistakes.append(mistake)

    def validate_data(self, model: type[M], data: Any, at: ConfigKey = ()) -> M | None:
        """Validate data with a model and add its mistakes to the document.

        The data is validated as strict JSON: a list may represent a tuple, but a boolean or a text is no number.

        Args:
            model: pydantic model.
            data: plain data.
            at: location of the data in the document.

        Returns:
            The model instance, or None if there are mistakes.
        """
        try:
            return model.model_validate_json(json.dumps(data), strict=True, context={"folder": self.path.parent})
        except ValidationError as error:
            problems: dict[ConfigKey, list[str]] = {}
            for detail in error.errors()[: MAX_MISTAKES + 1]:
                if detail["type"] == "too_short" and detail["input"]:
                    continue  # the list is short because its items were rejected, which is reported
                key = _locate_error(detail, data)
                problems.setdefault(key, []).append(_describe_problem(detail, model, key))
            for key, messages in problems.items():
                got = messages[0].partition(_EXPECTED_PREFIX)[0] + _EXPECTED_PREFIX  # all members of a union quote it
                others = [problem.removeprefix(got) for problem in messages[1:]]
                self.add_mistake(" or ".join([messages[0], *others]), at + key)
            return None

    def resolve_paths(self, model: type[BaseModel], data: dict[str, Any], at: ConfigKey) -> dict[str, Any]:
        """Resolve file names relative to the config's folder; a missing file is a mistake.

        Args:
            model: pydantic model, whose fields of the type Path are file names.
            data: plain data of the model, not modified.
            at: location of the data in the document.

        Returns:
            The data with the resolved names.
        """
        kinds: tuple[Any, ...] = (Path, Path | None)
        paths = [k for k, f in model.model_fields.items() if f.annotation in kinds]
        names = [k for k in paths if isinstance(data.get(k), str)]
        for key in names:
            data = data | {key: str(self.path.parent / data[key])}
            if not os.path.isfile(data[key]):
                self.add_mistake(f"there is no file {quote_value(data[key])}", (*at, key))
        return data

    def split_by_tag(
        self, data: Any, table: Mapping[str, Any], tag: str, at: ConfigKey
    ) -> tuple[str, dict[str, Any]] | None:
        """Split a mapping into the name under its tag and its other keys.

        Args:
            data: value that should be a mapping.
            table: known names.
            tag: key that selects the name, such as `kind`.
            at: location of the data in the document.

        Returns:
            (name, other keys), or None after a mistake was added.
        """
        if not is_mapping(data) or not isinstance(data.get(tag), str):
            place = (*at, tag) if is_mapping(data) and tag in data else at
            self.add_mistake(f"should be a mapping with a `{tag}`, {format_allowed_names('', table)}", place)
            return None
        if data[tag] not in table:
            self.add_mistake(
                f"unknown {tag} {quote_value(data[tag])}; expected {format_allowed_names(data[tag], table)}", (*at, tag)
            )
            return None
        return data[tag], {key: value for key, value in data.items() if key != tag}

    def build_error(self) -> InputError:
        """Return an error with all mistakes (at most MAX_MISTAKES), sorted by line."""
        found = sorted(self.mistakes, key=lambda mistake: (str(mistake.file), mistake.line or 0))
        more = [InputMistake("... and more; mend these first", self.path)] if len(found) > MAX_MISTAKES else []
        return InputError(found[:MAX_MISTAKES] + more)


def format_key(at: ConfigKey) -> str:
    """Format a key as users write it: `effects[2].weight`."""
    text = "".join(f"[{k}]" if isinstance(k, int) else f".{k if k.isprintable() else ascii(k)}" for k in at)
    return text.removeprefix(".")[:200]


def parse_key(text: str) -> ConfigKey:
    """Parse a key that `format_key` formatted; its names contain neither dots nor brackets."""
    return tuple(int(index) if index else name for index, name in re.findall(r"\[(\d+)\]|([^.\[\]]+)", text))


def is_mapping(data: object) -> TypeGuard[dict[str, Any]]:
    """Return whether config data is a mapping; its keys are text."""
    return isinstance(data, dict)


def is_list(data: object) -> TypeGuard[list[Any]]:
    """Return whether config data is a list."""
    return isinstance(data, list)


def quote_value(value: object) -> str:
    """Format a value as JSON, truncated to 60 characters for a message."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _locate_error(detail: ErrorDetails, data: Any) -> ConfigKey:
    """Return the key that a validation error refers to.

    The names of union members in its location are omitted.
    """
    key: ConfigKey = ()
    for step in detail["loc"]:
        if _has_key(data, step):
            key, data = (*key, step), data[step]
    return (*key, detail["loc"][-1]) if detail["type"] == "missing" and is_mapping(data) else key


def _has_key(data: Any, step: str | int) -> bool:
    return step in data if is_mapping(data) else is_list(data) and step in range(len(data))


def _describe_problem(detail: ErrorDetails, model: type[BaseModel], key: ConfigKey) -> str:
    """Describe the given value and the expected one."""
    kind, message = detail["type"], detail["msg"]
    if kind == "missing":
        return "is missing" if isinstance(detail["loc"][-1], str) else "has too few items"
    if kind == "extra_forbidden":
        owner = _models_at(model, detail["loc"][:-1])[:1]
        allowed = owner[0].model_fields if owner else ()
        return "unknown key; " + (f"expected {format_allowed_names(key[-1], allowed)}" if allowed else "remove it")
    if kind == "value_error":
        return message.removeprefix("Value error, ")
    if kind.startswith("union_tag"):
        kinds = [one.model_fields["kind"].default for one in _models_at(model, detail["loc"])]
        got = detail.get("ctx", {}).get("tag")
        if got is not None:
            return f"unknown kind {quote_value(got)}; expected {format_allowed_names(got, kinds)}"
        expected = f"a mapping with a `kind`, {format_allowed_names('', kinds)}"
        return f"got {quote_value(detail['input'])}{_EXPECTED_PREFIX}{expected}"
    expected = message.removeprefix("Input should be ").replace("a valid array", "a list")
    return f"got {quote_value(detail['input'])}{_EXPECTED_PREFIX}{expected}"


def _models_at(model: type[BaseModel], location: ConfigKey) -> list[type[BaseModel]]:
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
            members = list(_iterate_models(given.annotation)) if given else []
    return members


def _iterate_models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _iterate_models(inner)

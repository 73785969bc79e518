"""Config files: YAML to plain data that remembers its lines, and data to models with every mistake at once.

Only the plain values of YAML 1.2 are read (mappings, lists, text, numbers, booleans, null): a tag or a
directive is refused, and so is a file that exceeds the limits below once its aliases are expanded.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from harness.base.errors import InputError, Mistake, did_you_mean

MAX_BYTES, MAX_NODES, MAX_DEPTH = 2**18, 100_000, 32
MAX_MISTAKES = 100

Key = tuple[str | int, ...]
"""Where a value stands: the keys of mappings and the indices of lists on the way to it."""

_CAME = "; should be "

M = TypeVar("M", bound=BaseModel)


@dataclass(slots=True)
class Document:
    """A config as plain data, the line of each key, and the mistakes found in it so far.

    opens: whether code that the config names is imported; else it is told by its files alone.
    """

    path: Path
    data: dict[str, Any]
    lines: dict[Key, int] = field(default_factory=dict)
    mistakes: list[Mistake] = field(default_factory=list)
    opens: bool = True

    def report(self, problem: str, at: Key = ()) -> None:
        """Note a mistake at a key; a key that is not in the file gets the line of the mapping around it."""
        line = next((self.lines[at[:k]] for k in range(len(at), -1, -1) if at[:k] in self.lines), None)
        self.mistakes.append(Mistake(problem, self.path, line, key_text(at)))

    def check(self, model: type[M], data: Any, at: Key = ()) -> M | None:
        """`data`, which stands at `at`, as a `model`; None after its mistakes were noted.

        It is validated as strict JSON: a list may stand for a tuple, but no boolean or text for a number.
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

    def choose(self, data: Any, table: Mapping[str, Any], tag: str, at: Key) -> tuple[str, dict[str, Any]] | None:
        """Split the mapping `data` into the name under its key `tag`, one of `table`, and its other keys."""
        if not isinstance(data, dict) or not isinstance(data.get(tag), str):
            place = (*at, tag) if isinstance(data, dict) and tag in data else at
            self.report(f"should be a mapping with a `{tag}`, {did_you_mean('', table)}", place)
            return None
        if data[tag] not in table:
            self.report(f"unknown {tag} {quote(data[tag])}; expected {did_you_mean(data[tag], table)}", (*at, tag))
            return None
        return data[tag], {key: value for key, value in data.items() if key != tag}

    def error(self) -> InputError:
        """All mistakes (the first MAX_MISTAKES of them), sorted by line."""
        found = sorted(self.mistakes, key=lambda mistake: (str(mistake.file), mistake.line or 0))
        more = [Mistake("... and more; mend these first", self.path)] if len(found) > MAX_MISTAKES else []
        return InputError(found[:MAX_MISTAKES] + more)


def read_bytes(path: Path) -> bytes:
    """The content of a config; InputError when it is missing, no plain file, unreadable or too large."""
    try:
        if path.exists() and not path.is_file():
            raise InputError(Mistake("is not a file; give a scene or a sweep (*.yaml, *.json)", path))
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(Mistake(f"cannot be read: {reason}", path)) from error
    if len(raw) > MAX_BYTES:
        raise InputError(Mistake(f"is larger than {MAX_BYTES} bytes; a config is small", path))
    return raw


def read_yaml(path: Path) -> Document:
    """Read a YAML file that holds one mapping; InputError with the line for everything else."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise InputError(Mistake("is not text in UTF-8", path, line)) from error
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("%"):
            raise InputError(Mistake("YAML directives (%) are not allowed; remove the line", path, number))
    yaml = YAML(typ="safe", pure=True)
    yaml.max_depth = MAX_DEPTH
    try:
        node = yaml.compose(text)
    except ReaderError as error:
        at = int(error.position)
        problem = f"holds the character {chr(error.character)!r}, which is not allowed"
        raise InputError(Mistake(problem, path, text.count("\n", 0, at) + 1)) from error
    except (YAMLError, ValueError) as error:
        line = error.problem_mark.line + 1 if isinstance(error, MarkedYAMLError) and error.problem_mark else None
        parts = [getattr(error, name, None) for name in ("context", "problem")]
        problem = ", ".join(filter(None, parts)) or "cannot be parsed"
        raise InputError(Mistake(f"is not YAML: {problem}", path, line)) from error
    document = Document(path, {})
    if not isinstance(node, MappingNode):
        document.lines = {(): node.start_mark.line + 1} if node else {}
        document.report("should hold a mapping of keys to values; it is " + ("a value" if node else "empty"))
    else:
        document.data = _Converter(document).convert(node, (), 0)
    if document.mistakes:
        raise document.error()
    return document


_SCALARS: dict[str, Callable[[str], Any]] = {
    "str": str,
    "timestamp": str,
    "null": lambda text: None,
    "bool": lambda text: text.lower() == "true",
    "int": lambda text: _integer(text.replace("_", "")),
    "float": lambda text: _number(text.replace("_", "")),
}
_CORE = "tag:yaml.org,2002:"


def _integer(text: str) -> int:
    value = int(text, {"0x": 16, "0o": 8}.get(text.lstrip("+-")[:2], 10))
    if abs(value) >= 2**63:
        raise ValueError("too large")
    return value


def _number(text: str) -> float | int:
    """A float; 1e5, a whole number without a point, may also stand where an integer is wanted."""
    value = float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    return int(value) if "." not in text and abs(value) < 2**53 and value.is_integer() else value


class _Converter:
    """Turns composed nodes into plain data; the nodes are counted each time an alias repeats them."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.nodes = 0

    def convert(self, node: Node, at: Key, depth: int) -> Any:
        document, line = self.document, node.start_mark.line + 1
        self.nodes += 1
        if self.nodes > MAX_NODES or depth > MAX_DEPTH:
            problem = f"is too large: at most {MAX_NODES} values, nested {MAX_DEPTH} deep, aliases expanded"
            raise InputError(Mistake(problem, document.path, line, key_text(at)))
        document.lines.setdefault(at, line)
        if isinstance(node, MappingNode) and node.tag == f"{_CORE}map":
            return dict(self.items(node, at, depth))
        if isinstance(node, SequenceNode) and node.tag == f"{_CORE}seq":
            return [self.convert(item, (*at, i), depth + 1) for i, item in enumerate(node.value)]
        scalar = _SCALARS.get(str(node.tag).removeprefix(_CORE))
        if not isinstance(node, ScalarNode) or scalar is None:
            document.report(f"the YAML tag {quote(str(node.tag))} is not allowed; write a plain value", at)
            return None
        try:
            node.value.encode()  # escapes can spell lone surrogates, which no later writer could write
            return scalar(node.value)
        except ValueError:
            document.report(f"cannot read the value {quote(node.value)}", at)
            return None

    def items(self, node: MappingNode, at: Key, depth: int) -> Iterator[tuple[str, Any]]:
        first: dict[str, int] = {}
        for name, value in node.value:
            line, self.nodes = name.start_mark.line + 1, self.nodes + 1
            if not isinstance(name, ScalarNode):
                self.document.report("the keys of a mapping should be plain words", at)
            elif name.value in first:
                self.document.lines[*at, name.value] = line
                self.document.report(f"duplicate key; it is first given in line {first[name.value]}", (*at, name.value))
            else:
                first[name.value] = self.document.lines[*at, name.value] = line
                yield name.value, self.convert(value, (*at, name.value), depth + 1)


def key_text(at: Key) -> str:
    """A key as users write it: `effects[2].weight`."""
    text = "".join(f"[{k}]" if isinstance(k, int) else f".{k if k.isprintable() else ascii(k)}" for k in at)
    return text.removeprefix(".")[:200]


def quote(value: object) -> str:
    """A value as JSON, cut to a length that fits a message."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _place(detail: ErrorDetails, data: Any) -> Key:
    """The key in `data` that an error is about; names of union members in its location are passed over."""
    key: Key = ()
    for step in detail["loc"]:
        if isinstance(data, (dict, list)) and step in (data if isinstance(data, dict) else range(len(data))):
            key, data = (*key, step), data[step]  # pyright: ignore[reportArgumentType, reportCallIssue]
    return (*key, detail["loc"][-1]) if detail["type"] == "missing" and isinstance(data, dict) else key


def _problem(detail: ErrorDetails, model: type[BaseModel], key: Key) -> str:
    """What came and what was wanted."""
    kind, said = detail["type"], detail["msg"]
    if kind == "missing":
        return "is missing" if isinstance(detail["loc"][-1], str) else "has too few items"
    if kind == "extra_forbidden":
        owner = _model_at(model, detail["loc"][:-1])
        allowed = owner.model_fields if owner else ()
        return "unknown key; " + (f"expected {did_you_mean(key[-1], allowed)}" if allowed else "remove it")
    if kind == "value_error":
        return said.removeprefix("Value error, ")
    wanted = said.removeprefix("Input should be ").replace("a valid array", "a list")
    return f"came {quote(detail['input'])}{_CAME}{wanted}"


def _model_at(model: type[BaseModel], location: Key) -> type[BaseModel] | None:
    """The model of the mapping at an error's location, which names the member of a union by its kind."""
    members = [model]
    for step in location:
        if isinstance(step, int):
            continue
        if len(members) > 1:
            members = [one for one in members if one.model_fields["kind"].default == step]
        else:
            given = members[0].model_fields.get(step)
            members = list(_models(given.annotation)) if given else []
        if not members:
            return None
    return members[0]


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)

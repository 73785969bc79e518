# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# ruamel.yaml has no types of its nodes and marks.
"""YAML loader that returns plain data with line numbers.

It reads only the plain values of YAML 1.2 (mappings, lists, text, numbers, booleans, null). It rejects tags,
directives, and files that exceed the limits below after the expansion of aliases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError
from springbench.harness.atomic_files import HEAD_BYTES, describe_misnamed_file
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.schema.config_document import ConfigDocument, ConfigKey, format_key, quote_value

MAX_YAML_BYTES, MAX_NODES, MAX_DEPTH = 2**18, 100_000, 32


def read_config_bytes(path: Path) -> bytes:
    """Read the content of a config.

    Raises:
        InputError: if it is missing, irregular, unreadable or too large.
    """
    try:
        if path.exists() and not path.is_file():
            raise InputError(InputMistake("is not a file; give a scene or a sweep (*.yaml, *.json)", path))
        with path.open("rb") as file:
            raw = file.read(MAX_YAML_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(InputMistake(f"cannot be read: {reason}", path)) from error
    if len(raw) > MAX_YAML_BYTES:
        raise InputError(InputMistake(f"is larger than {MAX_YAML_BYTES} bytes; a config is small", path))
    if problem := describe_misnamed_file(raw[:HEAD_BYTES], len(raw)):
        raise InputError(InputMistake(problem, path))
    return raw


def read_yaml(path: Path) -> ConfigDocument:
    """Read a YAML file that contains one mapping.

    Raises:
        InputError: with the line, for any other content.
    """
    try:
        text = read_config_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise InputError(InputMistake("is not text in UTF-8", path, line)) from error
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("%"):
            raise InputError(InputMistake("YAML directives (%) are not allowed; remove the line", path, number))
    yaml = YAML(typ="safe", pure=True)
    yaml.max_depth = MAX_DEPTH
    try:
        node = yaml.compose(text)
    except ReaderError as error:
        at = int(error.position)
        problem = f"contains the character {chr(error.character)!r}, which is not allowed"
        raise InputError(InputMistake(problem, path, text.count("\n", 0, at) + 1)) from error
    except (YAMLError, ValueError) as error:
        mark = error.problem_mark if isinstance(error, MarkedYAMLError) else None
        parts = [getattr(error, name, None) for name in ("context", "problem")]
        problem = ", ".join(filter(None, parts)) or "cannot be parsed"
        if mark:
            problem = _explain_parse_error(problem, text.splitlines()[mark.line : mark.line + 1], mark.column)
        raise InputError(InputMistake(f"is not YAML: {problem}", path, mark.line + 1 if mark else None)) from error
    document = ConfigDocument(path, {})
    if not isinstance(node, MappingNode):
        document.lines = {(): node.start_mark.line + 1} if node else {}
        document.add_mistake("should contain a mapping of keys to values; it is " + ("a value" if node else "empty"))
    else:
        document.data = _NodeConverter(document).convert_node(node, (), 0)
    if document.mistakes:
        raise document.build_error()
    return document


def _explain_parse_error(problem: str, lines: list[str], column: int) -> str:
    """Explain a parse error and its remedy, or return the parser's own words.

    Args:
        problem: message of the parser.
        lines: the line of the error, or none.
        column: position in the line.
    """
    line = lines[0] if lines else ""
    if "cannot start any token" in problem and line[column:]:
        return f"a value cannot begin with {line[column]!r}; put the value in quotes"
    if "undefined alias" in problem:
        return f"{problem}; put the value in quotes if the * belongs to it"
    flow = "got ':'" in problem  # in {} or [], where a comma or a bracket ends the value
    if not flow and "mapping values are not allowed" not in problem:
        return problem
    begin = 1 + max(line.rfind(mark, 0, column) for mark in ",{[") if flow else 0
    end = min((at for mark in ",}]" if (at := line.find(mark, column)) >= 0), default=len(line)) if flow else len(line)
    key, colon, value = line[begin:end].partition(":")
    key, value = key.strip().lstrip("- "), value.partition(" #")[0].strip()
    if begin + len(line[begin:end].partition(":")[0]) >= column or not colon:
        return "a key stands where the line above has not ended; give both the same indent, and each key a colon"
    mark = "'" if set(value) & set('"\\') else '"'
    return f"the value of `{key[:40]}` contains a colon; put it in quotes, {key[:40]}: {mark}{value[:80]}{mark}"


_SCALAR_PARSERS: dict[str, Callable[[str], Any]] = {
    "str": str,
    "timestamp": str,
    "null": lambda text: None,
    "bool": lambda text: text.lower() == "true",
    "int": lambda text: _parse_integer(text.replace("_", "")),
    "float": lambda text: _parse_number(text.replace("_", "")),
}
_CORE_TAG_PREFIX = "tag:yaml.org,2002:"


def _parse_integer(text: str) -> int:
    value = int(text, {"0x": 16, "0o": 8}.get(text.lstrip("+-")[:2], 10))
    if abs(value) >= 2**63:
        raise ValueError("too large")
    return value


def _parse_number(text: str) -> float | int:
    """Parse a float.

    A whole number without a decimal point, such as 1e5, becomes an integer, so that integer fields accept it.
    """
    value = float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    return int(value) if "." not in text and abs(value) < 2**53 and value.is_integer() else value


def parse_scalar(text: str) -> Any:
    """Parse a text as a plain YAML value: number, null, boolean or text."""
    tag = YAML(typ="safe", pure=True).resolver.resolve(ScalarNode, text, (True, False))
    try:
        return _SCALAR_PARSERS[str(tag).removeprefix(_CORE_TAG_PREFIX)](text)
    except (KeyError, ValueError):
        return text


class _NodeConverter:
    """Converts composed nodes to plain data; nodes are counted each time an alias repeats them."""

    def __init__(self, document: ConfigDocument) -> None:
        self.document = document
        self.num_nodes = 0

    def convert_node(self, node: Node, at: ConfigKey, depth: int) -> Any:
        document, line = self.document, node.start_mark.line + 1
        self.num_nodes += 1
        if self.num_nodes > MAX_NODES or depth > MAX_DEPTH:
            problem = f"is too large: at most {MAX_NODES} values, nested {MAX_DEPTH} deep, aliases expanded"
            raise InputError(InputMistake(problem, document.path, line, format_key(at)))
        document.lines.setdefault(at, line)
        if isinstance(node, MappingNode) and node.tag == f"{_CORE_TAG_PREFIX}map":
            return dict(self.iterate_items(node, at, depth))
        if isinstance(node, SequenceNode) and node.tag == f"{_CORE_TAG_PREFIX}seq":
            return [self.convert_node(item, (*at, i), depth + 1) for i, item in enumerate(node.value)]
        scalar = _SCALAR_PARSERS.get(str(node.tag).removeprefix(_CORE_TAG_PREFIX))
        if not isinstance(node, ScalarNode) or scalar is None:
            document.add_mistake(f"the YAML tag {quote_value(str(node.tag))} is not allowed; write a plain value", at)
            return None
        try:
            node.value.encode()  # escapes can encode lone surrogates, which cannot be written to a file later
            return scalar(node.value)
        except ValueError:
            document.add_mistake(f"cannot read the value {quote_value(node.value)}", at)
            return None

    def iterate_items(self, node: MappingNode, at: ConfigKey, depth: int) -> Iterator[tuple[str, Any]]:
        first: dict[str, int] = {}
        for name, value in node.value:
            line, self.num_nodes = name.start_mark.line + 1, self.num_nodes + 1
            if not isinstance(name, ScalarNode):
                self.document.add_mistake("the keys of a mapping should be plain words", at)
            elif name.value in first:
                self.document.lines[*at, name.value] = line
                self.document.add_mistake(
                    f"duplicate key; it is first given in line {first[name.value]}", (*at, name.value)
                )
            else:
                first[name.value] = self.document.lines[*at, name.value] = line
                yield name.value, self.convert_node(value, (*at, name.value), depth + 1)

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow's stubs have incomplete types of columns.
"""Validation of row values from untrusted files: names become files, text becomes links and JSON.

A rule belongs to a column name, for all kinds of rows. A column without a rule may contain any value of its type. Null
is always valid; readers state the columns that they require.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from springbench.harness.atomic_files import is_file_name

MAX_TEXT_LENGTH = 100_000
"""Maximum length of a text, in characters."""

_MAX_QUOTED_LENGTH = 60
"""Maximum number of characters of a value that a message quotes."""


class TextRule(NamedTuple):
    """Rule of a text column: a predicate, and a description of valid values."""

    is_valid: Callable[[str], bool]
    expected: str


class ValueRange(NamedTuple):
    """Range of finite numbers from low to high, inclusive."""

    low: float
    high: float

    @property
    def expected_range(self) -> str:
        """Description of the range."""
        return f"a number from {self.low:g} to {self.high:g}"


def _is_id(text: str) -> bool:
    return re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._ -]{0,127}", text) is not None


def _is_line(text: str) -> bool:
    return 0 < len(text) <= 300 and all(letter.isprintable() for letter in text)


def _is_word(text: str) -> bool:
    return re.fullmatch(r"[a-z][a-z -]{0,40}", text) is not None


def is_path_below(text: str) -> bool:
    """Return whether a text is a relative path to a file inside a folder."""
    return not text or (not text.startswith("/") and all(map(is_file_name, PurePosixPath(text).parts)))


def _reject_constant(constant: str) -> None:
    raise ValueError(f"{constant} is no JSON")


def _parse_object(text: str) -> dict[str, Any] | None:
    """Parse a JSON object; return None for any other text."""
    try:
        found = json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _is_object(text: str) -> bool:
    return _parse_object(text) is not None


def _is_citation(text: str) -> bool:
    found = _parse_object(text) or {}
    lines = [found.get(name) for name in ("authors", "title")]
    doi, year = found.get("doi"), found.get("year")
    known = all(isinstance(line, str) and _is_line(line) for line in lines)
    return known and isinstance(doi, str) and re.fullmatch(r"[!-~]{0,200}", doi) is not None and type(year) is int


TEXT_RULES: dict[str, TextRule] = {
    **dict.fromkeys(("run_id", "unit_id"), TextRule(_is_id, "letters, digits, spaces and any of `._-`, at most 128")),
    **dict.fromkeys(("scene", "sweep"), TextRule(is_file_name, "the stem of a file's name")),
    **dict.fromkeys(("solver", "integrator", "phase"), TextRule(_is_line, "one line of at most 300 characters")),
    **dict.fromkeys(("status", "kind"), TextRule(_is_word, "a word in small letters")),
    "parameters": TextRule(_is_object, "a JSON object"),
    "citation": TextRule(_is_citation, "a JSON object with authors, year, title and doi"),
    "recording_path": TextRule(is_path_below, "a path in the folder of the results"),
}
"""Rules of text columns, by column name."""


def _is_short(text: str) -> bool:
    return len(text) <= MAX_TEXT_LENGTH


_LENGTH_RULE = TextRule(_is_short, f"at most {MAX_TEXT_LENGTH:,} characters")

VALUE_RANGES: dict[str, ValueRange] = {
    **dict.fromkeys(("size", "frame", "round", "vertices", "springs"), ValueRange(0, 1e12)),
    **dict.fromkeys(("num_iterations", "max_iterations", "num_stages", "rounds", "frames"), ValueRange(0, 1e12)),
    **dict.fromkeys(("threads", "num_concurrent_runs", "cores"), ValueRange(0, 1e6)),
    **dict.fromkeys(
        ("seconds", "cpu_seconds", "cold_seconds", "t_end", "seconds_per_simulated_second"), ValueRange(0, 1e12)
    ),
    **dict.fromkeys(("added_seconds", "added_seconds_low", "added_seconds_high"), ValueRange(-1e12, 1e12)),
    **dict.fromkeys(("residual_rtol", "error_requested", "error_estimated", "memory_gib"), ValueRange(0, 1e12)),
    "time_step": ValueRange(1e-12, 1e9),
    "mean_rest_length": ValueRange(1e-300, 1e300),
    **dict.fromkeys(("machine_bandwidth", "machine_flops_per_second", "machine_step_seconds"), ValueRange(0, 1e30)),
}
"""Ranges of numeric columns, by column name."""


class InvalidValue(NamedTuple):
    """An invalid value: its row, its column, the value and the expected values."""

    row: int
    column: str
    value: Any
    expected: str

    def __str__(self) -> str:
        got = repr(self.value[:_MAX_QUOTED_LENGTH] if isinstance(self.value, str) else self.value)
        return (
            f"got {got if len(got) <= _MAX_QUOTED_LENGTH else got[:_MAX_QUOTED_LENGTH] + '…'}; expected {self.expected}"
        )


def find_invalid_values(table: pa.Table) -> Iterator[InvalidValue]:
    """Find all invalid values of a table, column by column."""
    for field in table.schema:
        column = table[field.name]
        if pa.types.is_string(field.type) or pa.types.is_large_string(field.type):
            yield from _find_invalid_texts(field.name, column, TEXT_RULES.get(field.name, _LENGTH_RULE))
        elif field.name in VALUE_RANGES and (pa.types.is_integer(field.type) or pa.types.is_floating(field.type)):
            yield from _find_invalid_numbers(field.name, column, VALUE_RANGES[field.name])


def _find_invalid_texts(name: str, column: Any, rule: TextRule) -> Iterator[InvalidValue]:
    longer = pc.max(pc.binary_length(column)).as_py() or 0
    if rule is _LENGTH_RULE and longer <= MAX_TEXT_LENGTH:
        return
    bad = [text for text in column.unique().to_pylist() if text is not None and not _is_valid_text(text, rule)]
    if bad:
        expectation = rule.expected if max(map(len, bad)) <= MAX_TEXT_LENGTH else _LENGTH_RULE.expected
        rows = pc.is_in(column, pa.array(bad, column.type)).to_numpy(zero_copy_only=False)
        yield from (InvalidValue(int(row), name, column[int(row)].as_py(), expectation) for row in np.flatnonzero(rows))


def _is_valid_text(text: str, rule: TextRule) -> bool:
    return len(text) <= MAX_TEXT_LENGTH and rule.is_valid(text)


def _find_invalid_numbers(name: str, column: Any, allowed: ValueRange) -> Iterator[InvalidValue]:
    values = pc.cast(column, pa.float64(), safe=False).to_numpy(zero_copy_only=False)  # NaN for null
    known = ~column.is_null(nan_is_null=False).to_numpy()
    outside = known & ~((values >= allowed.low) & (values <= allowed.high))
    for row in np.flatnonzero(outside).tolist():
        yield InvalidValue(row, name, column[row].as_py(), allowed.expected_range)

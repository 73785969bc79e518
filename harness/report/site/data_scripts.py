"""Data as scripts that a page from the file system can load.

Each script passes one value by name.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from springbench.harness.atomic_files import atomic_write, is_file_name, is_outdated

_PROTOTYPE_KEY = re.compile(r'(?<!\\)"__proto__":')
"""A JSON key that a script would interpret as the object's prototype."""
_CALL = "springbench.setData("
"""Start of a script, which calls the function of `static/base.js`."""


def write_script(path: Path, name: str, value: Any) -> Path:
    """Write `springbench.setData(name, value)` to a file and return its path.

    Args:
        path: target file.
        name: name of the value.
        value: value that can be represented as JSON.

    Raises:
        ValueError: if the value cannot be represented as JSON.
    """
    return write_json_script(path, name, json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":")))


def write_json_script(path: Path, name: str, value: str) -> Path:
    """Write a script for a value that is already JSON, and return its path.

    Args:
        path: target file.
        name: name of the value.
        value: JSON.

    Raises:
        WriteError: if the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    value = _PROTOTYPE_KEY.sub('["__proto__"]:', value)
    with atomic_write(path) as partial:
        partial.write_text(f"{_CALL}{json.dumps(name)}, {value});\n", encoding="utf-8")
    return path


def is_script_outdated(path: Path, sources: Iterable[Path], start: str = _CALL) -> bool:
    """Return whether a script is missing, older than a source, or of another version.

    Args:
        path: the script.
        sources: files that it is made from, which must exist.
        start: first characters of a script of this version.
    """
    if is_outdated(path, sources):
        return True
    with path.open("rb") as file:
        return file.read(len(start.encode())) != start.encode()


def script_path(folder: Path, name: str) -> Path:
    """Return the path of the script with this name in a folder.

    Args:
        folder: folder of the scripts.
        name: file name without suffix.

    Raises:
        ValueError: if the name is not a valid file name.
    """
    if not is_file_name(name):
        raise ValueError(f"{name!r} is no file's name")
    return folder / f"{name}.js"


def round_number(value: Any) -> float | int | None:
    """Round to five digits, more than the page displays; None for missing or non-finite values."""
    if value is None or isinstance(value, int):
        return value
    return float(f"{value:.5g}") if math.isfinite(value) else None


def round_numbers(values: Iterable[Any]) -> list[float | int | None]:
    """Round each value to five digits; None for missing or non-finite values."""
    return [round_number(value) for value in values]


def encode_column(values: Sequence[Any]) -> Any:
    """Encode a column for the page.

    Numbers are rounded (`round_number`). Strings become a list of distinct ones, `values`, and `indices`; the index of
    a missing string is -1.
    """
    if str not in set(map(type, values)):
        return round_numbers(values)
    known = [word for word, _ in Counter(v for v in values if v is not None).most_common()]
    places = {word: k for k, word in enumerate(known)}
    return {"values": known, "indices": [places.get(value, -1) for value in values]}

"""Data as scripts that a page from the file system may load: each hands one value over by its name."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from harness.base.files import is_file_name, replacing

_PROTOTYPE = re.compile(r'(?<!\\)"__proto__":')
"""A key of JSON that a script would take for the object's prototype."""


def write(path: Path, name: str, value: Any) -> Path:
    """Write `springbench.give(name, value)`; what is no JSON raises ValueError. Returns the path."""
    return write_text(path, name, json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":")))


def write_text(path: Path, name: str, value: str) -> Path:
    """The same of a value that is JSON already. Raises CannotWrite."""
    path.parent.mkdir(parents=True, exist_ok=True)
    value = _PROTOTYPE.sub('["__proto__"]:', value)
    with replacing(path) as partial:
        partial.write_text(f"springbench.give({json.dumps(name)}, {value});\n", encoding="utf-8")
    return path


def below(folder: Path, name: str) -> Path:
    """The script of a name in a folder. Raises ValueError for what is no file's name."""
    if not is_file_name(name):
        raise ValueError(f"{name!r} is no file's name")
    return folder / f"{name}.js"


def number(value: Any) -> float | int | None:
    """To five digits, which is more than a page shows; None for what is missing or not finite."""
    if value is None or isinstance(value, int):
        return value
    return float(f"{value:.5g}") if math.isfinite(value) else None


def numbers(values: Iterable[Any]) -> list[float | int | None]:
    """The same of each."""
    return [number(value) for value in values]


def column(values: Sequence[Any]) -> Any:
    """A column as the page reads it: numbers as they are; words as a list of different ones, `of`, and where, `at`."""
    if str not in set(map(type, values)):
        return numbers(values)
    known = [word for word, _ in Counter(v for v in values if v is not None).most_common()]
    places = {word: k for k, word in enumerate(known)}
    return {"of": known, "at": [places.get(value, -1) for value in values]}

"""Reader of the JSON scenes of the University of Toronto mass-spring assignment."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import FailFast, Field, ValidationError
from springbench.harness.errors import InputError, InputMistake, format_allowed_names
from springbench.harness.scenes.mesh.spring_network import check_mesh_file
from springbench.harness.schema.base_model import ConfigModel, read_field_descriptions

MAX_SCENE_BYTES = 2**22
"""Maximum size of a scene file: it names a mesh, and at most half a million pins."""


class AssignmentJson(ConfigModel):
    """Keys of a scene; `b` counts vertices from 1."""

    obj: str = Field(min_length=1)
    """Path of the OBJ file, relative to the JSON file."""
    k: float = Field(ge=0)
    """Stiffness of every spring [N/m]."""
    m: float | None = Field(default=None, gt=0)
    """Mass of every vertex [kg]; by default from the areas of the faces at density 1."""
    b: Annotated[list[int], FailFast()]
    """Pinned vertices, each once."""
    png: str | None = None
    """A texture, for viewers."""


def read_assignment_json(path: Path) -> AssignmentJson:
    """Read a scene from a JSON file.

    Raises:
        InputError: for an invalid file, with the file, line and key of each mistake.
    """
    check_mesh_file(path, max_bytes=MAX_SCENE_BYTES)
    try:
        text = path.read_text(encoding="utf-8-sig").rstrip()
        data = json.loads(text, object_pairs_hook=_reject_repeated_keys)
    except json.JSONDecodeError as error:
        hint = "" if error.doc.endswith("}") else "; the file does not end with }: was it cut?"
        raise InputError(InputMistake(f"is no JSON: {error.msg}{hint}", path, error.lineno)) from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(InputMistake(f"cannot be read as JSON: {error}", path)) from None
    if not isinstance(data, dict):
        problem = f"a scene is a JSON object with the keys obj, k and b, got a {type(data).__name__}"
        raise InputError(InputMistake(problem, path))
    try:
        return AssignmentJson.model_validate(data, strict=True)
    except ValidationError as error:
        raise InputError([_convert_error(path, detail) for detail in error.errors()[:20]]) from None


def find_key_line(path: Path, key: str) -> int | None:
    """Return the line of a key in a JSON file, for messages.

    Args:
        path: file in UTF-8 with one flat JSON object.
        key: key as it is written in the file.

    Returns:
        The line, counted from 1; None if the file lacks the key.
    """
    text = path.read_text(encoding="utf-8-sig")
    match = re.search(rf'"{re.escape(key)}"\s*:', text)
    return text.count("\n", 0, match.start()) + 1 if match else None


def _reject_repeated_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a JSON object; reject repeated keys."""
    result = dict(pairs)
    if len(result) < len(pairs):
        twice = next(key for k, (key, _) in enumerate(pairs) if key in dict(pairs[:k]))
        raise ValueError(f"the key {twice!r} occurs twice")
    return result


def _convert_error(path: Path, detail: Any) -> InputMistake:
    """Convert a pydantic error to a mistake."""
    key = str(detail["loc"][0])[:80]
    problem = f"{detail['msg']}, got {str(detail['input'])[:80]!r}"
    if detail["type"] == "extra_forbidden":
        problem = f"unknown key; expected {format_allowed_names(key, AssignmentJson.model_fields)}"
    elif detail["type"] == "missing":
        problem = f"is missing: {read_field_descriptions(AssignmentJson)[key]}"
    return InputMistake(problem, path, find_key_line(path, key), ".".join(map(str, detail["loc"]))[:80])

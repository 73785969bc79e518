"""Reader of the JSON scenes of the University of Toronto mass-spring assignment."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import FailFast, Field, ValidationError

from harness.base.errors import InputError, Mistake, did_you_mean
from harness.base.model import Model, meanings
from harness.scenes.mesh.cells import check_file

MAX_BYTES = 2**22
"""Maximum size of a scene file: it names a mesh, and at most half a million pins."""


class SceneJson(Model):
    """Keys of a scene. `b` counts vertices from 1."""

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


def read_scene_json(path: Path) -> SceneJson:
    """Read a scene from a JSON file; raise InputError with file, line and key of each mistake."""
    check_file(path, most=MAX_BYTES)
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=_once)
    except json.JSONDecodeError as error:
        raise InputError(Mistake(f"is no JSON: {error.msg}", path, error.lineno)) from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(Mistake(f"cannot be read as JSON: {error}", path)) from None
    if not isinstance(data, dict):
        problem = f"a scene is a JSON object with the keys obj, k and b, came a {type(data).__name__}"
        raise InputError(Mistake(problem, path))
    try:
        return SceneJson.model_validate(data, strict=True)
    except ValidationError as error:
        raise InputError([_mistake(path, detail) for detail in error.errors()[:20]]) from None


def line_of(path: Path, key: str) -> int | None:
    """Return the line of a key in a file with one flat JSON object, for messages."""
    text = path.read_text(encoding="utf-8-sig")
    match = re.search(rf'"{re.escape(key)}"\s*:', text)
    return text.count("\n", 0, match.start()) + 1 if match else None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a JSON object; reject repeated keys."""
    result = dict(pairs)
    if len(result) < len(pairs):
        twice = next(key for k, (key, _) in enumerate(pairs) if key in dict(pairs[:k]))
        raise ValueError(f"the key {twice!r} comes twice")
    return result


def _mistake(path: Path, detail: Any) -> Mistake:
    """Convert a pydantic error to a mistake."""
    key = str(detail["loc"][0])[:80]
    problem = f"{detail['msg']}, came {str(detail['input'])[:80]!r}"
    if detail["type"] == "extra_forbidden":
        problem = f"unknown key; wanted {did_you_mean(key, SceneJson.model_fields)}"
    elif detail["type"] == "missing":
        problem = f"is missing: {meanings(SceneJson)[key]}"
    return Mistake(problem, path, line_of(path, key), ".".join(map(str, detail["loc"]))[:80])

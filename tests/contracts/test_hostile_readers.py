"""Whatever a file contains, a reader's answer is a message within limits, and nothing else is touched."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contracts.attempts import Outcome, attempt
from tests.contracts.hostile import scene
from tests.contracts.hostile_readers import ARRAYS, CONFIGS, MESHES, OTHER_FILES, big, frames

QUICK = {"crossed.obj", "list-of-4e9.ply", "includes-what-lies-outside.inp", "a-pickle.npz", "a-colon.yaml"}
CASES = [*MESHES, *ARRAYS, *CONFIGS]


def outcome(folder: Path, name: str) -> Outcome:
    """What `list` says to a case, in a folder next to a mesh that it must not read."""
    inside, config = folder / "inside", name
    inside.mkdir()
    (folder / "outside.inp").write_text("*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n*ELEMENT, TYPE=S3\n1, 1, 2, 3\n")
    for other, text in OTHER_FILES.items():
        (inside / other).write_text(text)
    if name not in CONFIGS:
        config = "hostile.yaml"
        mesh = scene(mesh=f"{{kind: file, path: {name}}}", effects="[{kind: springs, stretch: 1}]")
        (inside / config).write_text(mesh if name in MESHES else frames(name))
    content, _ = {**MESHES, **ARRAYS, **CONFIGS}[name]
    content = big() if name == "a-bomb.npz" else content
    (inside / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return attempt(inside, ["list", config])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.long], id=name) for name in CASES]
)
def test_a_hostile_file_is_refused_with_the_reason(tmp_path: Path, name: str) -> None:
    found = outcome(tmp_path, name)
    assert not found.error
    assert "Traceback" not in found.said
    assert found.code == 2, found.said
    assert not found.outside
    assert any(file in found.said for file in (name, "hostile.yaml", *OTHER_FILES))
    assert {**MESHES, **ARRAYS, **CONFIGS}[name][1].lower() in found.said.lower()
    assert len(found.said) < 5000, "a message that fits a screen"

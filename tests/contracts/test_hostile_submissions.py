"""Whatever others' positions, matrices, meshes and published results contain, the answer is a message within limits."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import pytest

from tests.contracts.attempts import attempt
from tests.contracts.hostile_submissions import CASES, FILES, LINKS, PIPES
from tests.rare_cases import mark_rare_cases

QUICK = ["half-a-vertex.csv", "of-1e12-entries/Q.mtx", "no-machines"]


def write_files(folder: Path, line: str) -> None:
    """Write the files of a command line; one that stands in a folder which the line names, too."""
    words = {part for word in shlex.split(line) for part in (word, *Path(word).parts)} | {"good.yaml", "quad.obj"}
    for name in (*FILES, *LINKS, *PIPES):
        if not words & {name, Path(name).parts[0]}:
            continue
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name in LINKS:
            path.symlink_to(LINKS[name])
        elif name in PIPES:
            os.mkfifo(path)
        else:
            content = FILES[name]
            content = content() if callable(content) else content
            path.write_bytes(content if isinstance(content, bytes) else content.encode())


@pytest.mark.parametrize("name", mark_rare_cases(CASES, QUICK))
def test_a_hostile_submission_ends_with_a_message(name: str, tmp_path: Path):
    case = CASES[name]
    inside = tmp_path / "inside"
    inside.mkdir()
    write_files(inside, case.line)
    found = attempt(inside, shlex.split(case.line))
    assert not found.error, found.error
    assert "Traceback" not in found.said
    assert found.code == case.code or (case.code is None and found.code in (0, 1)), found.said
    assert case.words.lower() in found.said.lower()
    if found.code == 2:
        assert not found.outside
        assert len(found.said) < 5000, "a message that fits a screen"
    assert [path.name for path in tmp_path.iterdir()] == ["inside"], "nothing is written outside"

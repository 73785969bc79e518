"""Whatever a file or a command line contains, the answer is a message within limits, and nothing is left outside."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from springbench.harness.results import parquet_rows

from tests.contracts.attempts import Outcome, attempt
from tests.contracts.hostile import QUAD, scene, sweep
from tests.contracts.hostile_meshes import MESHES
from tests.contracts.hostile_more import COMMANDS, GATES, QUERIES, SCENES, SCENES_JSON, SOLVERS


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a scene, a sweep, an OBJ, a pipe, a link to a device, and odd names."""
    (tmp_path / "good.yaml").write_text(scene())
    (tmp_path / "sweep.yaml").write_text(sweep())
    (tmp_path / "quad.obj").write_text(QUAD + "f 1 2 3\n")
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "device.npz").symlink_to("/dev/full")
    os.mkfifo(tmp_path / "pipe")
    return tmp_path


def require_message(outcome: Outcome, code: int, *needles: str) -> None:
    """The command ended by itself, with a message that names what it should, and touched nothing but results."""
    assert not outcome.error, outcome.error
    assert "Traceback" not in outcome.said
    assert outcome.code == code, outcome.said
    assert not outcome.outside
    for needle in needles:
        assert needle.lower() in outcome.said.lower()
    assert len(outcome.said) < 5000, "a message that fits a screen"


def write(path: Path, content: str | bytes) -> None:
    path.write_bytes(content if isinstance(content, bytes) else content.encode(errors="surrogatepass"))


@pytest.mark.parametrize("name", MESHES)
def test_a_hostile_mesh_is_refused_by_name(folder: Path, name: str) -> None:
    write(folder / name, MESHES[name])
    write(folder / "hostile.yaml", scene(mesh=f"{{kind: file, path: {name}}}", effects="[{kind: springs, stretch: 1}]"))
    require_message(attempt(folder, ["list", "hostile.yaml"]), 2, name)


@pytest.mark.parametrize("case", SCENES_JSON)
def test_a_hostile_assignment_is_refused_by_name(folder: Path, case: str) -> None:
    write(folder / "hostile.json", SCENES_JSON[case])
    require_message(attempt(folder, ["list", "hostile.json"]), 2)


@pytest.mark.parametrize("case", GATES)
def test_a_hostile_benchmark_is_refused_by_name(folder: Path, case: str) -> None:
    write(folder / "hostile.json", GATES[case])
    require_message(
        attempt(folder, ["regress", "hostile.json", "--baseline", "hostile.json"]),
        2,
        "hostile.json",
        "pytest-benchmark",
    )


@pytest.mark.parametrize("case", QUERIES)
def test_a_hostile_query_is_refused(folder: Path, case: str) -> None:
    (folder / "results" / "a" / "rows").mkdir(parents=True)
    parquet_rows.write_rows(folder / "results" / "a" / "rows" / "a.parquet", [{"sweep": "a", "seconds": 0.5}])
    require_message(attempt(folder, ["query", QUERIES[case]]), 2, "query")


@pytest.mark.parametrize("case", COMMANDS)
def test_a_hostile_command_line_is_refused(folder: Path, case: str) -> None:
    arguments, code, needle = COMMANDS[case]
    require_message(attempt(folder, arguments), code, needle)


@pytest.mark.parametrize("case", SCENES)
def test_a_hostile_scene_is_refused_with_its_key(folder: Path, case: str) -> None:
    content, needle = SCENES[case]
    write(folder / "hostile.yaml", content)
    require_message(attempt(folder, ["list", "hostile.yaml"]), 2, "hostile.yaml", needle)


@pytest.mark.parametrize("case", SOLVERS)
def test_a_hostile_parameter_is_refused_with_its_key(folder: Path, case: str) -> None:
    content, needle = SOLVERS[case]
    write(folder / "hostile.yaml", content)
    require_message(attempt(folder, ["list", "hostile.yaml"]), 2, "hostile.yaml", needle)

"""Whatever a config contains, the command line answers with the place of the mistake, exit code 2, and no file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from springbench.harness.cli.main import app
from typer.testing import CliRunner

from tests.contracts.hostile import JSONS, OTHER_FILES, QUAD, SCENES, SWEEPS, scene, sweep


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of configs and meshes, sound and broken, and an empty folder of results."""
    for name in ("configs", "configs/folder", "results"):
        (tmp_path / name).mkdir()
    configs = tmp_path / "configs"
    for name, content in OTHER_FILES.items():
        (configs / name).write_text(content)
    (configs / "quad.obj").write_text(QUAD + "f 1 2 3\n")
    (configs / "junk.obj").write_bytes(bytes(range(128, 256)) * 8)
    (configs / "loop.yaml").symlink_to(configs / "loop.yaml")
    return tmp_path


def refusal(folder: Path, config: Path, *options: str, command: str = "run") -> list[str]:
    """The lines that the command line answers a config with, after it has exited with 2 and left no file."""
    before = sorted(folder.rglob("*"))
    arguments = [command, str(config), "--results", str(folder / "results"), *options]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2, (result.output, result.exception)
    assert "Traceback" not in result.output
    assert sorted(folder.rglob("*")) == before
    return result.output.strip().splitlines()


def one(lines: list[str], *needles: str) -> None:
    """There is one message, and it names all that is required."""
    assert len(lines) == 1, lines
    assert len(lines[0]) < 1500, "a message that fits a screen"
    for needle in needles:
        assert needle in lines[0]


def place(line: int | None) -> str:
    return f":{line}: " if line else ": "


@pytest.mark.parametrize("case", SCENES)
def test_a_hostile_scene_is_refused_with_its_place(folder: Path, case: str) -> None:
    content, needle, line = SCENES[case]
    config = folder / "configs" / "hostile.yaml"
    config.write_bytes(content if isinstance(content, bytes) else content.encode())
    lines = refusal(folder, config)
    one(lines, needle, str(folder / "configs"), place(line))


@pytest.mark.parametrize("case", SWEEPS)
def test_a_hostile_sweep_is_refused_with_its_place(folder: Path, case: str) -> None:
    content, needle, line = SWEEPS[case]
    config = folder / "configs" / "hostile.yaml"
    config.write_text(content)
    lines = refusal(folder, config, command="list")
    one(lines, needle, str(folder / "configs"), place(line))


@pytest.mark.parametrize("case", JSONS)
def test_a_hostile_assignment_is_refused(folder: Path, case: str) -> None:
    content, needle = JSONS[case]
    config = folder / "configs" / "hostile.json"
    config.write_text(content)
    one(refusal(folder, config), needle or "hostile.json")


@pytest.mark.parametrize("name", ["none.yaml", "folder", "loop.yaml", "none.json", "folder/none/none.yaml", "x" * 300])
def test_a_path_that_is_no_file_is_refused(folder: Path, name: str) -> None:
    one(refusal(folder, folder / "configs" / name), name)


@pytest.mark.parametrize(
    "name", ["-x.yaml", ".yaml", "a b.yaml", "a;b.yaml", "ü.yaml", "x" * 65 + ".yaml", "a\nb.yaml"]
)
@pytest.mark.parametrize("content", [scene(), sweep()], ids=["scene", "sweep"])
def test_a_file_whose_name_cannot_name_results_is_refused(folder: Path, name: str, content: str) -> None:
    config = folder / "configs" / name
    config.write_text(content)
    assert "name" in " ".join(refusal(folder, config))


def test_a_pipe_is_refused_instead_of_waited_for(folder: Path) -> None:
    os.mkfifo(folder / "configs" / "pipe.yaml")
    one(refusal(folder, folder / "configs" / "pipe.yaml"), "pipe.yaml", "is not a file")


@pytest.mark.parametrize(
    ("options", "needle"),
    [
        (["--solver", "numbat"], "did you mean 'numba'"),
        (["--size", "0"], "sizes[0]"),
        (["--max-iterations", "-1"], "options.max_iterations"),
        (["--rtol", "nan"], "options.rtol"),
        (["--initial-guess", "best"], "options.initial_guess"),
        (["--threads", "0"], "options.threads"),
    ],
    ids=str,
)
def test_a_hostile_option_is_refused(folder: Path, options: list[str], needle: str) -> None:
    one(refusal(folder, folder / "configs" / "good.yaml", *options), needle)


def test_options_that_a_sweep_sets_itself_are_refused(folder: Path) -> None:
    one(refusal(folder, folder / "configs" / "sweep.yaml", "--size", "8"), "sweep.yaml", "is a sweep")


def test_a_flood_of_mistakes_is_cut_short(folder: Path) -> None:
    config = folder / "configs" / "flood.yaml"
    config.write_text(scene() + "".join(f"key{i}: 0\n" for i in range(500)))
    lines = refusal(folder, config)
    assert len(lines) == 101
    assert "and more" in lines[-1]


def test_all_mistakes_of_a_sweep_and_its_scenes_come_at_once_in_the_order_of_their_lines(folder: Path) -> None:
    configs = folder / "configs"
    (configs / "bad.yaml").write_text(scene(mass="-1", frames="x", effects="[{kind: pins, parts: [1]}]"))
    (configs / "worse.yaml").write_text(sweep(scenes="[bad.yaml, none.yaml]", sizes="[0]", solvers="[x, y]", z="1"))
    lines = refusal(folder, configs / "worse.yaml")
    keys = [line.split(": ")[2] for line in lines]
    assert keys == [
        *("mass", "frames", "effects[0].parts[0]"),
        *("scenes[1]", "sizes[0]", "solvers[0].name", "solvers[1].name", "z"),
    ]

"""Shipped configs are found by name wherever a config or a scene is named, and never in place of a file."""

from __future__ import annotations

from pathlib import Path

import pytest
import springbench
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.shipped_configs import (
    SHIPPED_FOLDER,
    get_config_name,
    list_shipped_configs,
    locate_config,
    resolve_scene_path,
)
from springbench.harness.errors import InputError
from typer.testing import CliRunner

ROOT = Path(__file__).resolve().parents[2]

SWEEP = "scenes: [hanging-cloth, hard/geometry-line]\nsizes: [4]\nsolvers: [sparse]\n"


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_shipped_config_has_a_name():
    files = {path.relative_to(ROOT / "configs") for path in (ROOT / "configs").rglob("*.yaml")}
    named = {path.relative_to(SHIPPED_FOLDER) for path in list_shipped_configs().values()}
    assert named == {path for path in files if path.parts[0] != "templates"}


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("quickstart", "quickstart.yaml"),
        ("hanging-cloth", "scenes/hanging-cloth.yaml"),
        ("scenes/hanging-cloth", "scenes/hanging-cloth.yaml"),
        ("hard/geometry-line", "hard/geometry-line.yaml"),
        ("liu2013", "liu2013.yaml"),  # a config and a scene have this name
        ("scenes/liu2013", "scenes/liu2013.yaml"),
    ],
)
def test_a_name_finds_its_file(name: str, file: str):
    assert locate_config(name) == SHIPPED_FOLDER / file


def test_the_name_of_a_path_finds_that_path_again():
    for path in list_shipped_configs().values():
        assert locate_config(get_config_name(path)) == path
    assert get_config_name(SHIPPED_FOLDER / "scenes" / "net.yaml") == "net"
    assert get_config_name(Path("mine.yaml")) == "mine.yaml"


def test_a_folder_of_this_name_hides_no_config_and_a_file_does(empty_folder: Path):
    (empty_folder / "quickstart").mkdir()
    assert locate_config("quickstart") == SHIPPED_FOLDER / "quickstart.yaml"
    (empty_folder / "net").write_text("")
    assert locate_config("net") == Path("net")


@pytest.mark.parametrize("name", ["missing.yaml", "/missing", "../quickstart", "."])
def test_what_can_only_be_a_path_is_a_path(name: str):
    assert locate_config(name) == Path(name)


def test_a_wrong_name_gets_the_nearest_right_one():
    with pytest.raises(InputError, match=r"quickstrat: is neither a file nor .* did you mean 'quickstart'"):
        locate_config("quickstrat")


def test_a_sweep_names_shipped_scenes(empty_folder: Path):
    sweep = empty_folder / "mine.yaml"
    sweep.write_text(SWEEP)
    assert [run.scene_name for run in load_config(sweep).list_runs()] == ["hanging-cloth", "geometry-line"]
    sweep.write_text(SWEEP.replace("hanging-cloth", "hanging-cloht"))
    with pytest.raises(InputError, match=r"mine.yaml:1: scenes\[0\]: .* did you mean .hanging-cloth"):
        load_config(sweep)


def test_a_scene_in_the_folder_of_the_sweep_has_priority_over_a_shipped_one(empty_folder: Path):
    (empty_folder / "net").write_text("")
    assert resolve_scene_path("net", empty_folder) == empty_folder / "net"
    assert resolve_scene_path("net", empty_folder / "elsewhere") == SHIPPED_FOLDER / "scenes" / "net.yaml"


def test_scripts_load_a_scene_by_name():
    assert springbench.load_scene("net").path == SHIPPED_FOLDER / "scenes" / "net.yaml"


def test_list_describes_shipped_configs():
    answer = CliRunner().invoke(app, ["list", "--shipped"])
    assert answer.exit_code == 0
    assert all(
        get_config_name(path).removeprefix("scenes/") in answer.output for path in list_shipped_configs().values()
    )
    assert "  hanging-cloth     A level cloth" in answer.output
    assert CliRunner().invoke(app, ["list", "--shipped", "quickstart"]).exit_code == 2

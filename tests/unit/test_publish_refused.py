"""What is published lies in the folder of results or in a config's folder; all else is refused by name."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from springbench.harness.errors import InputError
from springbench.harness.experiments.archive.publication import publish_results

from tests.contracts.hostile import scene
from tests.synthetic_run_rows import write_dummy_runs

SWEEP = "scenes: [cloth.yaml]\nsizes: [4]\nsolvers: [sparse]\n"
OWN = "{kind: './mine.py:Mesh', path: PATH}"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder with a sweep and its results, and a file outside of both."""
    home = tmp_path / "home"
    home.mkdir()
    (home / "cloth.yaml").write_text(scene())
    (home / "sweep.yaml").write_text(SWEEP)
    for name in ("mine.py", "data.txt"):
        (home / name).write_text(name)
    write_dummy_runs(home / "results" / "sweep", 1)
    (home / "results" / "sweep" / ".config").write_text("../../sweep.yaml\n")
    (tmp_path / "secret").write_text("secret")
    return home


def publish_files(home: Path, said: Callable[[str], None] = lambda line: None) -> dict[str, bytes]:
    """The files of the results' archive."""
    publish_results(home / "results", home.parent / "x.zip", said)
    with zipfile.ZipFile(home.parent / "x.zip") as packed:
        return {name: packed.read(name) for name in packed.namelist()}


def link_file(home: Path, place: str, to: str) -> None:
    (home / place).parent.mkdir(exist_ok=True)
    (home / place).symlink_to(to)


def add_file_by_name(home: Path, name: bytes) -> None:
    (home / "results" / "sweep" / "report").mkdir()
    with open(os.path.join(os.fsencode(home / "results" / "sweep" / "report"), name), "w"):
        pass


def move_scene(home: Path) -> None:
    (home.parent / "cloth.yaml").write_text(scene())
    (home / "sweep.yaml").write_text(SWEEP.replace("cloth", "../cloth"))


REFUSED_FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a link in the results": (
        lambda home: link_file(home, "results/sweep/report/a.png", "/etc/passwd"),
        r"/a\.png: leads",
    ),
    "a link to a folder": (
        lambda home: link_file(home, "results/sweep/recordings", "/etc"),
        "recordings: leads to /etc",
    ),
    "rows that are a link": (
        lambda home: (
            (home / "results/sweep/rows").rename(home.parent / "rows"),
            link_file(home, "results/sweep/rows", "../../../rows"),
        ),
        "sweep/rows: leads to",
    ),
    "a broken link": (
        lambda home: link_file(home, "results/sweep/report/a.png", "none"),
        r"a\.png: is a link to what is no file",
    ),
    "a scene elsewhere": (move_scene, r"cloth\.yaml: lies outside of"),
    "a scene that is a link": (
        lambda home: (
            (home / "cloth.yaml").rename(home.parent / "a.yaml") and link_file(home, "cloth.yaml", "../a.yaml")
        ),
        r"cloth\.yaml: leads to .*a\.yaml, which lies outside",
    ),
    "a parameter of a mesh of one's own": (
        lambda home: (home / "cloth.yaml").write_text(scene(mesh=OWN.replace("PATH", "../secret"))),
        "secret: lies outside of",
    ),
    "a parameter that is an absolute path": (
        lambda home: (home / "cloth.yaml").write_text(scene(mesh=OWN.replace("PATH", "/etc/passwd"))),
        "/etc/passwd: lies outside of",
    ),
    "a name that is no UTF-8": (lambda home: add_file_by_name(home, b"\xff.png"), r"\.png: its name is no UTF-8"),
    "a name of two lines": (lambda home: add_file_by_name(home, b"a\nb.png"), "its name .* breaks a line"),
}


@pytest.mark.parametrize("kind", REFUSED_FILES)
def test_a_file_outside_of_the_folders_is_refused_by_name(kind: str, home: Path):
    change, said = REFUSED_FILES[kind]
    change(home)
    with pytest.raises(InputError, match=said):
        publish_files(home)
    assert not (home.parent / "x.zip").exists()


@pytest.mark.parametrize("config", ["/etc/passwd", "../../../secret", "x" * 5000, "\0", "../../data.txt"])
def test_a_file_that_is_no_config_is_not_published_as_one(config: str, home: Path):
    (home / "results" / "sweep" / ".config").write_text(config)
    said: list[str] = []
    assert not [name for name in publish_files(home, said.append) if name.startswith("configs/")]
    assert "its runs cannot be repeated" in said[0]


def test_effects_and_meshes_of_ones_own_are_published_with_the_files_that_they_name(home: Path):
    effects = "[{kind: './mine.py:Effect', also: data.txt}]"
    (home / "cloth.yaml").write_text(scene(mesh=OWN.replace("PATH", "data.txt"), effects=effects))
    link_file(home, "results/sweep/report/a.txt", "../rows/../.config")  # which stays in the results
    found = publish_files(home)
    assert {f"configs/sweep/{name}" for name in ("cloth.yaml", "data.txt", "mine.py", "sweep.yaml")} <= set(found)
    assert found["configs/sweep/data.txt"] == b"data.txt"
    assert found["results/sweep/report/a.txt"] == b"../../sweep.yaml\n"
    assert len(publish_files(home)) == len(found), "an archive is not part of the next one"


def test_files_from_before_1980_and_after_2107_are_published(home: Path):
    for name, time in (("old", -1e9), ("new", 1e10)):
        path = home / "results" / "sweep" / name
        path.touch()
        os.utime(path, (time, time))
    publish_files(home)
    with zipfile.ZipFile(home.parent / "x.zip") as packed:
        years = [packed.getinfo(f"results/sweep/{name}").date_time[0] for name in ("old", "new")]
    assert years == [1980, 2107]


@pytest.mark.parametrize("archive", ["missing/x.zip", "folder.zip", "x.tar"])
def test_where_no_archive_can_be_written_is_the_users_mistake(archive: str, home: Path):
    (home / "folder.zip").mkdir()
    with pytest.raises(InputError, match="--output"):
        publish_results(home / "results", home / archive, print)

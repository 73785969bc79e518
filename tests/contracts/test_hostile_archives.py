"""Archives and results from elsewhere: a message within limits, and nothing is read, written or left elsewhere."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.contracts.attempts import Outcome, attempt
from tests.contracts.hostile_archives import CHANGES, FOLDERS, RAW, Content, archive, good_archive, good_results

QUICK = {"a way elsewhere", "entries that overlap", "a unit that is a device", "pipe"}
"""Of each kind of fault one; the others are tried by `pytest -m long`."""


def each(names: object) -> list[object]:
    """The names, those marked as long that are not quick."""
    return [n if n in QUICK else pytest.param(n, marks=pytest.mark.long) for n in names]  # type: ignore[attr-defined]


def require_message(outcome: Outcome, *codes: int) -> None:
    assert not outcome.error, outcome.error
    assert "Traceback" not in outcome.said
    assert outcome.code in codes, outcome.said
    assert not outcome.outside


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Content:
    return good_archive(tmp_path_factory.mktemp("good"))


@pytest.mark.parametrize("name", each(CHANGES))
def test_a_hostile_archive_is_not_confirmed(name: str, good: Content, tmp_path: Path):
    archive(name, good, tmp_path / "x.zip")
    require_message(attempt(tmp_path, ["verify-archive", "x.zip", "--seed", "1"]), 1, 2, 3)


@pytest.mark.parametrize("name", each(RAW))
def test_an_archive_of_another_program_is_refused(name: str, tmp_path: Path):
    (tmp_path / "x.zip").write_bytes(RAW[name]())
    require_message(attempt(tmp_path, ["verify-archive", "x.zip"]), 1, 2)


@pytest.mark.parametrize(
    "what", ["/dev/zero", "/dev/null", "pipe", "folder", "none", "loop", "/dev/zero/a", "a" * 5000]
)
def test_a_path_that_is_not_a_file_is_refused(what: str, tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    require_message(attempt(tmp_path, ["verify-archive", what]), 2)


@pytest.mark.parametrize("name", each(FOLDERS))
def test_all_commands_report_hostile_results(name: str, tmp_path: Path):
    def build_folder(number: int) -> Path:
        folder = tmp_path / str(number)
        folder.mkdir()
        good_results(folder)
        FOLDERS[name](folder)
        shutil.copytree(tmp_path / "clean" / "results", folder / "clean")
        return folder

    (tmp_path / "clean").mkdir()
    good_results(tmp_path / "clean")
    for number, arguments in enumerate(
        (
            ["compact", "results"],
            ["merge", "clean", "results", "-o", "results/../results-merged"],
            ["publish", "results", "-o", "results-published.zip"],
            ["regress", "results", "--baseline", "clean"],
            ["query", "SELECT count(*) FROM rows", "--results", "results"],
        )
    ):
        outcome = attempt(build_folder(number), arguments)
        assert not outcome.error, (arguments, outcome.error)
        assert "Traceback" not in outcome.said
        assert outcome.code in (0, 1, 2, 3), (arguments, outcome.said)
        assert all(place.startswith(("results-merged", "results-published")) for place in outcome.outside), arguments
        with_link = tmp_path / str(number) / "results-merged" / "sweep" / "pictures" / "a.png"
        assert not with_link.exists(), "a link out of the results is not followed"

"""The table of planted errors fits the sources as they are; `python -m tests.mutations` plants them."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from tests.mutations.__main__ import summarise_outcomes
from tests.mutations.base import ROOT, Mutation, StaleMutation
from tests.mutations.planted import TABLE
from tests.mutations.runner import PYTEST, SourceCopy, examine


def test_there_are_sixty_of_them_and_each_has_a_name_of_its_own():
    assert len(TABLE) >= 60
    assert len({mutation.name for mutation in TABLE}) == len(TABLE)
    assert len({(mutation.file, mutation.fragment, mutation.replacement, mutation.tests) for mutation in TABLE}) == len(
        TABLE
    )


@pytest.mark.parametrize("mutation", TABLE, ids=lambda mutation: mutation.name)
def test_each_can_be_planted_and_names_tests_that_exist(mutation: Mutation):
    changed = mutation.apply(ROOT)
    if mutation.file.endswith(".py"):
        ast.parse(changed)
    assert changed != (ROOT / mutation.file).read_text()
    for test in mutation.tests:
        path, _, name = test.partition("::")
        assert f"def {name or 'test_'}" in (ROOT / path).read_text()


def test_pytest_accepts_the_command_that_runs_the_tests():
    command = [sys.executable, *PYTEST, "--collect-only", "tests/unit/test_round_off.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_fragment_that_is_missing_or_repeated_is_refused(tmp_path: Path):
    mutation = replace(TABLE[0], file="here.py", fragment="x = 1")
    with pytest.raises(StaleMutation, match=r"there is no here\.py"):
        mutation.apply(tmp_path)
    for text, times in (("y = 1\n", 0), ("x = 1\nx = 1\n", 2)):
        (tmp_path / "here.py").write_text(text)
        with pytest.raises(StaleMutation, match=f"stands {times} times in here.py"):
            mutation.apply(tmp_path)


def test_bytecode_of_the_source_without_an_error_does_not_hide_it(tmp_path: Path):
    """The error leaves the length as it is, and the file's time would be the same within a second."""

    class Small(SourceCopy):
        def __init__(self) -> None:
            self._root, self._compiled, self._num_planted = tmp_path, tmp_path, 0

    (tmp_path / "small.py").write_text("x = 1\n")
    copy, mutation = Small(), replace(TABLE[0], file="small.py", fragment="x = 1", replacement="x = 2")

    def import_module() -> tuple[int, str]:
        return copy.run_command(mutation, ["-c", "import small; print(small.x)"], 60.0)

    found = [import_module()]
    for _ in range(2):
        with copy.plant_mutation(mutation):
            found.append(import_module())
        found.append(import_module())
    assert found == [(0, "1\n"), (0, "2\n"), (0, "1\n"), (0, "2\n"), (0, "1\n")]
    assert list((tmp_path / "__pycache__").iterdir()), "bytecode is written"


class ChanceFailures(SourceCopy):
    """Tests with known results: the first failure is by chance, the second by the error."""

    def __init__(self) -> None:
        self.planted_now, self.whole = False, 0

    @contextmanager
    def plant_mutation(self, mutation: Mutation) -> Iterator[None]:
        self.planted_now = True
        yield
        self.planted_now = False

    def run_command(self, mutation: Mutation, command: list[str], limit: float) -> tuple[int, str]:
        if "tests/unit" in command:
            self.whole += 1
            failed = "test_found" if "--deselect=test_chance[a b]" in command else "test_chance[a b]"
            return 1, f"FAILED {failed} - why"
        return int(self.planted_now and "test_found" in command), "1 passed"


def test_a_test_of_the_whole_suite_that_fails_by_chance_catches_nothing():
    copy = ChanceFailures()
    found = examine(copy, TABLE[0], "", whole=True)
    assert (found.tests, found.failed, copy.whole) == ("caught", "test_found", 2)


def test_the_test_that_caught_it_last_time_is_run_first():
    class RecordingFailures(ChanceFailures):
        def __init__(self) -> None:
            super().__init__()
            self.commands: list[str] = []

        def run_command(self, mutation: Mutation, command: list[str], limit: float) -> tuple[int, str]:
            self.commands.append(command[-1])
            return int(len(self.commands) != 2), f"FAILED {command[-1]} - why"

    mutation, copy = TABLE[0], RecordingFailures()
    before = f"{mutation.tests[0]}::test_before"
    assert examine(copy, mutation, "", failed_before=before).failed == before
    assert examine(copy, mutation, "", failed_before=before).failed == mutation.tests[-1], "it no longer catches it"
    assert examine(copy, mutation, "", failed_before="tests/other.py::test_other").failed == mutation.tests[-1]
    assert copy.commands == [before, before, mutation.tests[-1], mutation.tests[-1]]


def test_a_time_out_catches_nothing_and_is_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A busy machine is slow too, so a time-out says nothing about the error."""
    for path, text in (("waits.py", "import time\ntime.sleep(600)\n"), ("ends.py", "raise SystemExit(1)\n")):
        (tmp_path / path).write_text(text)

    class Waiting(SourceCopy):
        def __init__(self) -> None:
            self._root, self._compiled = tmp_path, tmp_path

        @contextmanager
        def plant_mutation(self, mutation: Mutation) -> Iterator[None]:
            yield

        def run_command(self, mutation: Mutation, command: list[str], limit: float) -> tuple[int, str]:
            return super().run_command(mutation, ["waits.py" if "pytest" in command else "ends.py"], 0.5)

    found = examine(Waiting(), TABLE[0], "")
    assert (found.tests, found.is_decided, found.is_caught) == ("timed out", False, False)
    caught = replace(found, tests="caught")
    assert (caught.is_decided, caught.is_caught) == (True, True)
    missed = replace(found, tests="survived")
    assert [summarise_outcomes(some) for some in ([caught], [found, missed], [caught, found])] == [0, 1, 3]
    assert f"1 of 2 caught; undecided, run again: {found.name}" in capsys.readouterr().out


def test_tests_that_are_all_skipped_decide_nothing():
    class WithoutBrowser(ChanceFailures):
        def run_command(self, mutation: Mutation, command: list[str], limit: float) -> tuple[int, str]:
            return 0, "12 skipped in 3.00s"

    found = examine(WithoutBrowser(), replace(TABLE[0], product=None), "")
    assert (found.tests, found.is_decided, found.is_caught) == ("skipped", False, False)
